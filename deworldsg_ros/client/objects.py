"""The answers of the client: objects, relations and hidden objects, as frozen values."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from deworldsg_ros.base.words import counted
from deworldsg_ros.client.boxes import Footprint, footprint
from deworldsg_ros.client.meanings import (
    colour_shares,
    is_class,
    room_kind,
    singular_forms,
    words_of,
)
from deworldsg_ros.graph.extent import box_of, surface_points
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import ClientError
from deworldsg_ros.scene.vocabulary import PREDICATES, plain, verb_of
from deworldsg_ros.wire import messages as wire


def predicate_names(asked: str) -> frozenset[str]:
    """The predicates that a name means: "on" means every way to be on something."""
    name = " ".join(words_of(asked))
    for names in PREDICATES:
        if name == names[0]:
            return frozenset(names)
    return frozenset({name})


# --- The answers of the client: objects, relations and hidden objects, as frozen values.

Point = tuple[float, float, float]

# What a room without a name is called, and why there may be none.
UNNAMED_ROOM = "room"
NO_ROOMS = (
    "none: rooms are found in the views of the camera, with the default association, some seconds "
    "after they were seen"
)
# An answer is sure from odds of two to one. Chosen, not measured.
SURE = 2 / 3


def odds_of(probability: float) -> str:
    """A probability as odds, in words: 0.75 is "3 : 1", 0.25 is "1 : 3"."""
    if probability >= 1.0 - 1e-9:
        return "certain"
    if probability <= 1e-9:
        return "none"
    odds = probability / (1.0 - probability)
    ratio = max(odds, 1.0 / odds)
    number = f"{ratio:.0f}" if ratio >= 9.95 else f"{ratio:.2g}"
    return f"{number} : 1" if odds >= 1 else f"1 : {number}"


@dataclass(frozen=True)
class SceneObject:
    """One object of the graph.

    Attributes:
        id: stable, never reused within one graph.
        label: most probable class; "object" if none is probable enough (`is_named`).
        classes: probabilities of the classes that the message lists, the best first.
        other_classes: probability of all classes that it does not list.
        existence: probability that this is an object at all; None = not estimated.
        position_m: centre of the box, world frame, metres.
        size_m: of the box along its axes; the third axis is up.
        orientation_xyzw: axes of the box to world.
        box_source: ``surface``, or ``gaussian`` if the message has no surface: then the box is the
            one of a uniform body with the object's covariance.
        mean_m, covariance_m2: the Gaussian of the visible surface, world frame.
        observations: number of frames that detected the object.
        first_seen_ns, last_seen_ns: stamps of the first and the last of these frames.
        entropy_nats: of the whole class distribution; None = not available.
        frame_id: the world frame.
        up: unit vector against gravity.
        state: the message of the object.
    """

    id: int
    label: str
    classes: tuple[wire.Belief, ...]
    other_classes: float
    existence: float | None
    position_m: Point
    size_m: Point
    orientation_xyzw: tuple[float, float, float, float]
    box_source: str
    mean_m: Point
    covariance_m2: tuple[Point, Point, Point]
    observations: int
    first_seen_ns: int
    last_seen_ns: int
    entropy_nats: float | None
    frame_id: str
    up: Point
    state: wire.NodeState = field(repr=False, compare=False)

    @property
    def name(self) -> str:
        """Label and id, for people: ``cup #13``."""
        return f"{self.label} #{self.id}"

    @property
    def probability(self) -> float:
        """Probability that this is an object, and of the class `label` if it is named."""
        if not self.is_named:
            return 1.0 if self.existence is None else self.existence
        return self._share(belief for belief in self.classes if belief.label == self.label)

    def probability_of(self, label: str) -> float:
        """Probability that this is an object of a class; "table" includes "dining table"."""
        return self._share(belief for belief in self.classes if is_class(label, belief.label))

    def _share(self, beliefs: Iterable[wire.Belief]) -> float:
        share = sum(belief.probability for belief in beliefs)
        return min(share, 1.0) * (1.0 if self.existence is None else self.existence)

    @property
    def is_sure(self) -> bool:
        """Whether `probability` is at least `SURE`."""
        return self.probability >= SURE

    @property
    def is_named(self) -> bool:
        """False if no class is probable enough for a name: `classes` are guesses then."""
        return self.state.named

    @property
    def is_labelled_by_hand(self) -> bool:
        """Whether an operator has set the label."""
        return self.state.label_provenance == "operator"

    @property
    def colour_lab(self) -> Point | None:
        """Mean colour of the surface, CIELAB: L*, a*, b*; None = not known."""
        lab = self.state.colour_lab
        return _point(lab) if isinstance(lab, list) else None

    @property
    def colour(self) -> str | None:
        """The basic colour name that fits best, e.g. "red"; None = not known."""
        return None if self.colour_lab is None else next(iter(colour_shares(self.colour_lab)))

    def probability_of_colour(self, name: str) -> float:
        """Probability of a name of `meanings.COLOURS` for the colour; 0 if it is not known."""
        lab = self.colour_lab
        return 0.0 if lab is None else colour_shares(lab).get(name, 0.0)

    @property
    def at_least(self) -> tuple[bool, bool, bool]:
        """Sides of `size_m` that no view shows to their end: the object may be longer."""
        box = self.state.box
        known = box.at_least if isinstance(box, wire.GravityBox) else None
        return (known[0], known[1], known[2]) if isinstance(known, list) else (False, False, False)

    @property
    def is_partly_seen(self) -> bool:
        """Whether any side of the box may be longer; false also if that is not known."""
        return any(self.at_least)

    @property
    def size_words(self) -> list[str]:
        """The sides of the box in centimetres, for people: ``≥ 41`` may be longer."""
        marks = ("≥ " if more else "" for more in self.at_least)
        return [f"{mark}{100 * side:.0f}" for mark, side in zip(marks, self.size_m)]

    @property
    def height_m(self) -> float:
        """Height of the centre of the box above the origin of the world frame."""
        return float(np.dot(self.position_m, self.up))

    @cached_property
    def surface_m(self) -> Float64:
        """The sampled surface points (n, 3), world frame, metres; n may be 0."""
        return surface_points(self.state)

    @cached_property
    def footprint(self) -> Footprint:
        """The box seen from above."""
        return footprint(self.position_m, self.size_m, self.orientation_xyzw, self.up)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; times in seconds."""
        return {
            "id": self.id,
            "label": self.label,
            "probability": round(self.probability, 3),
            "sure": self.is_sure,
            "named": self.is_named,
            "labelled_by_hand": self.is_labelled_by_hand,
            "classes": {belief.label: round(belief.probability, 3) for belief in self.classes},
            "other_classes": round(self.other_classes, 3),
            "existence": self.existence,
            "position_m": _rounded(self.position_m),
            "size_m": _rounded(self.size_m),
            "orientation_xyzw": _rounded(self.orientation_xyzw, 4),
            "at_least": list(self.at_least),
            "box_source": self.box_source,
            "colour": self.colour,
            "colour_lab": self.colour_lab,
            "frame_id": self.frame_id,
            "observations": self.observations,
            "first_seen_s": self.first_seen_ns / 1e9,
            "last_seen_s": self.last_seen_ns / 1e9,
        }


@dataclass(frozen=True)
class Relation:
    """A directed relation between two objects, as it was asked for.

    Attributes:
        subject, object: the two objects.
        predicate: as asked, or the most probable one.
        probability: that the predicate holds, given that both objects exist; whatever they are.
        predicates: probabilities of the predicates that the message lists, the best first.
        other_predicates: probability of all predicates that it does not list.
        provenance: ``visual`` (frames), ``prior`` (world model) or ``fused`` (both).
        observations: number of frames with visual evidence.
        shown: number of frames that showed both objects; None = not in the message.
        entropy_nats: of the visual distribution.
        measured_m: horizontal gap of both surfaces, bottom of the subject above the top of the
            object, and the opposite, metres; None = not in the message.
    """

    subject: SceneObject
    predicate: str
    object: SceneObject
    probability: float
    predicates: tuple[wire.Belief, ...]
    other_predicates: float
    provenance: str
    observations: int
    shown: int | None
    entropy_nats: float
    measured_m: Point | None = None

    @property
    def unrelated(self) -> float:
        """Probability that no predicate holds."""
        known = sum(belief.probability for belief in self.predicates) + self.other_predicates
        return min(max(1.0 - known, 0.0), 1.0)

    @property
    def triplet_probability(self) -> float:
        """Probability that `text` is true: it holds, and both exist and are what they are called.

        The product of the probabilities of relation, subject and object, as of the triplets of
        scene graphs.
        """
        return self.probability * self.subject.probability * self.object.probability

    @property
    def is_sure(self) -> bool:
        """Whether `triplet_probability` is at least `SURE`."""
        return self.triplet_probability >= SURE

    @property
    def text(self) -> str:
        """For people: ``cup #13 is on dining table #5``."""
        return f"{self.subject.name} {verb_of(self.predicate)} {self.object.name}"

    @property
    def evidence(self) -> str:
        """Where the probability comes from, in words."""
        source = {
            "visual": "seen",
            "prior": "judged by the world model, not seen",
            "fused": "seen, and judged by the world model",
        }[self.provenance]
        of = f" of {self.shown} that show both" if self.shown else ""
        frames = f" in {counted(self.observations, 'frame')}{of}" if self.observations else ""
        return source + (frames if self.provenance != "prior" else "")

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "subject": {"id": self.subject.id, "label": self.subject.label},
            "predicate": self.predicate,
            "object": {"id": self.object.id, "label": self.object.label},
            "probability": round(self.probability, 3),
            "triplet_probability": round(self.triplet_probability, 3),
            "sure": self.is_sure,
            "predicates": {item.label: round(item.probability, 3) for item in self.predicates},
            "other_predicates": round(self.other_predicates, 3),
            "unrelated": round(self.unrelated, 3),
            "provenance": self.provenance,
            "observations": self.observations,
        }


@dataclass(frozen=True)
class HiddenObject:
    """Something that was detected and is not in the graph.

    Attributes:
        label: most probable class.
        position_m: mean of its surface, world frame.
        existence: probability that it is an object.
        observations: number of frames that detected it.
        reason: why it is hidden, in words.
    """

    label: str
    position_m: Point
    existence: float
    observations: int
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "label": self.label,
            "position_m": _rounded(self.position_m),
            "existence": self.existence,
            "observations": self.observations,
            "reason": self.reason,
        }


@dataclass(frozen=True)
class Room:
    """A room: a part of the free space that walls and doorways bound.

    Attributes:
        id: stable; rooms and objects are numbered apart.
        label: the most probable kind, e.g. "kitchen", or the name that the operator gave; "room" if
            no kind is probable enough (`is_named`).
        kinds: probabilities of the kinds, by what is in the room, the best first.
        storey: 0 = the lowest.
        outline_m: corners on its floor, in order, world frame, metres.
        area_m2: of the floor, without what stands at its walls as high as these.
        doorways: the ids of the rooms that it opens to, with the place and the width of each.
        objects: ids of the objects in it, with the probability that each is.
        is_named: false if no kind is probable enough.
        is_named_by_hand: whether the operator gave the name.
    """

    id: int
    label: str
    kinds: tuple[wire.Belief, ...]
    storey: int
    outline_m: tuple[Point, ...]
    area_m2: float
    doorways: tuple[wire.Doorway, ...]
    objects: dict[int, float]
    is_named: bool
    is_named_by_hand: bool

    @property
    def name(self) -> str:
        """For people: ``kitchen (room 2)``, or ``room 2``."""
        return f"{self.label} (room {self.id})" if self.is_named else f"room {self.id}"

    @property
    def probability(self) -> float:
        """Probability that it is what its label says; 1 for a name by hand, and without one."""
        is_said = self.is_named_by_hand or not self.is_named
        return 1.0 if is_said else self.probability_of(self.label)

    def probability_of(self, name: str) -> float:
        """Probability that the room is called so: a kind, "room", "room 2", or the name by hand."""
        words = room_words(name)
        if self.is_named_by_hand and words == room_words(self.label):
            return 1.0
        own = [[UNNAMED_ROOM], [UNNAMED_ROOM, str(self.id)]]
        if any(form in own for form in singular_forms(words or [""])):
            return 1.0
        kind = room_kind(name)
        by_hand = room_kind(self.label) if self.is_named_by_hand else None
        if kind is None or by_hand is not None:
            return float(kind is not None and kind == by_hand)
        return sum(belief.probability for belief in self.kinds if belief.label == kind)

    @property
    def center_m(self) -> Point:
        """Mean of the corners of its outline, world frame, metres."""
        return _point(np.mean(self.outline_m, axis=0)) if self.outline_m else (0.0, 0.0, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "id": self.id,
            "label": self.label,
            "probability": round(self.probability, 3),
            "named": self.is_named,
            "named_by_hand": self.is_named_by_hand,
            "kinds": {belief.label: round(belief.probability, 3) for belief in self.kinds},
            "storey": self.storey,
            "area_m2": self.area_m2,
            "center_m": _rounded(self.center_m),
            "next_to": sorted({door.to for door in self.doorways}),
            "objects": {str(node_id): share for node_id, share in self.objects.items()},
        }


def room_words(name: str) -> list[str]:
    """The words of a room's name, without articles: questions have none, either."""
    return [word for word in words_of(name) if word not in ("the", "a", "an", "my", "our")]


class Rooms(tuple[Room, ...]):
    """The rooms of a graph, by id."""

    @classmethod
    def of_message(cls, states: Iterable[wire.RoomState]) -> Rooms:
        """The rooms of a message."""
        return cls(
            Room(
                id=room.id,
                label=room.label,
                kinds=tuple(room.kinds),
                storey=room.storey,
                outline_m=tuple(_point(corner) for corner in room.outline_m),
                area_m2=room.area_m2,
                doorways=tuple(room.doorways),
                objects={item.id: item.probability for item in room.objects},
                is_named=room.named,
                is_named_by_hand=room.label_provenance == "operator",
            )
            for room in states
        )

    def called(self, name: str) -> list[tuple[Room, float]]:
        """The rooms that may be called so, with the probability that they are, the best first."""
        found = [(room, room.probability_of(name)) for room in self]
        known = [pair for pair in found if pair[1] > 0.0]
        return sorted(known, key=lambda pair: (-pair[1], pair[0].id))

    def one(self, which: Room | int | str) -> Room:
        """The room with an id, or the one that is most probably called so.

        Raises:
            ClientError: if there is none.
        """
        if isinstance(which, Room):
            which = which.id
        found = (
            [room for room in self if room.id == which]
            if isinstance(which, int)
            else [room for room, _ in self.called(which)]
        )
        if not found:
            known = ", ".join(room.name for room in self) or NO_ROOMS
            raise ClientError(f"there is no room '{which}'; rooms: {known}")
        return found[0]

    def of(self, node_id: int) -> list[tuple[Room, float]]:
        """The rooms in which an object may be, with probabilities, the best first."""
        found = [(room, room.objects[node_id]) for room in self if node_id in room.objects]
        return sorted(found, key=lambda pair: (-pair[1], pair[0].id))

    def next_to(self, which: Room | int | str) -> list[Room]:
        """The rooms to which a doorway leads."""
        near = {door.to for door in self.one(which).doorways}
        return [room for room in self if room.id in near]


def scene_object(node: wire.NodeState, frame_id: str, up: Point) -> SceneObject:
    """The object of a message of any version."""
    box, source = _box(node, up)
    listed = sum(belief.probability for belief in node.classes)
    rest = node.remainder if isinstance(node.remainder, float) else max(1.0 - listed, 0.0)
    rows = np.array(node.covariance_m2, np.float64).reshape(3, 3).tolist()
    return SceneObject(
        id=node.id,
        label=node.label,
        classes=tuple(node.classes),
        other_classes=rest,
        existence=node.existence if isinstance(node.existence, (int, float)) else None,
        position_m=_point(box.center_m),
        size_m=_point(box.size_m),
        orientation_xyzw=(
            box.orientation_xyzw[0],
            box.orientation_xyzw[1],
            box.orientation_xyzw[2],
            box.orientation_xyzw[3],
        ),
        box_source=source,
        mean_m=_point(node.mean_m),
        covariance_m2=(_point(rows[0]), _point(rows[1]), _point(rows[2])),
        observations=node.observations,
        first_seen_ns=wire.ns_from_stamp(node.first_seen),
        last_seen_ns=wire.ns_from_stamp(node.last_seen),
        entropy_nats=node.entropy_nats,
        frame_id=frame_id,
        up=up,
        state=node,
    )


def relation_of(
    edge: wire.EdgeState, subject: SceneObject, object_: SceneObject, asked: str | None
) -> Relation:
    """The relation of a message, for a predicate that was asked, or for the most probable one."""
    predicate, probability = edge.predicate, edge.probability
    if asked is not None:
        names = predicate_names(asked)
        found = [item for item in edge.predicates if plain(item.label) in names]
        predicate = found[0].label if found else asked
        probability = min(sum(item.probability for item in found), 1.0)
    rest = edge.remainder if isinstance(edge.remainder, float) else 0.0
    measured = None
    if isinstance(edge.measured_m, list):
        gap_m, rise_m, fall_m = _point(edge.measured_m)
        is_swapped = subject.id != edge.subject
        measured = (gap_m, fall_m, rise_m) if is_swapped else (gap_m, rise_m, fall_m)
    return Relation(
        subject=subject,
        predicate=predicate,
        object=object_,
        probability=probability,
        predicates=tuple(edge.predicates),
        other_predicates=rest,
        provenance=edge.provenance,
        observations=edge.observations,
        shown=edge.shown if isinstance(edge.shown, int) else None,
        entropy_nats=edge.entropy_nats,
        measured_m=measured,
    )


def hidden_object(node: wire.HiddenNode) -> HiddenObject:
    """The hidden object of a message."""
    return HiddenObject(
        node.label, _point(node.mean_m), node.existence, node.observations, node.reason
    )


def _box(node: wire.NodeState, up: Point) -> tuple[wire.GravityBox, str]:
    """The box of a message, else one from its surface points, else from its Gaussian."""
    if isinstance(node.box, wire.GravityBox):
        return node.box, "surface"
    points = surface_points(node)
    if len(points):
        return box_of(points, up), "surface"
    # A uniform body of width w has the variance w² / 12. Eight corners have that of w² / 4.
    values, axes = np.linalg.eigh(np.array(node.covariance_m2).reshape(3, 3))
    half = axes * np.sqrt(3 * np.maximum(values, 0.0))
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
    return box_of(np.array(node.mean_m) + signs @ half.T, up), "gaussian"


def _point(values: Any) -> Point:
    x, y, z = values
    return float(x), float(y), float(z)


def _rounded(values: tuple[float, ...], decimals: int = 3) -> list[float]:
    return [round(value, decimals) + 0.0 for value in values]


# --- The graph as a networkx graph.


def to_networkx(objects: Iterable[SceneObject], relations: Iterable[Relation]) -> Any:
    """A networkx.MultiDiGraph: a node for each object id, an edge with the predicate as its key.

    Attributes are numbers and strings only, so that every writer of networkx takes them.

    Raises:
        ClientError: without the package networkx.
    """
    try:
        import networkx
    except ImportError as error:
        raise ClientError("networkx is not installed: pip install networkx") from error
    graph = networkx.MultiDiGraph()
    for item in objects:
        x, y, z = item.position_m
        length, width, height = item.size_m
        graph.add_node(
            item.id,
            label=item.label,
            probability=round(item.probability, 4),
            observations=item.observations,
            x=x,
            y=y,
            z=z,
            length=length,
            width=width,
            height=height,
        )
    for relation in relations:
        graph.add_edge(
            relation.subject.id,
            relation.object.id,
            key=relation.predicate,
            predicate=relation.predicate,
            probability=round(relation.probability, 4),
            provenance=relation.provenance,
            observations=relation.observations,
        )
    return graph


# --- The most probable chain of relations between two objects.


def cheapest_chain(
    edges: Mapping[tuple[int, int], wire.EdgeState], first: int, last: int
) -> list[wire.EdgeState]:
    """The edges of the chain with the largest product of probabilities; [] if there is none.

    Edges are used in both directions.
    """
    links: dict[int, list[tuple[float, int, wire.EdgeState]]] = {}
    for (a, b), edge in edges.items():
        # Of two equal chains, the shorter one.
        cost = 1e-6 - math.log(min(max(edge.probability, 1e-9), 1.0))
        links.setdefault(a, []).append((cost, b, edge))
        links.setdefault(b, []).append((cost, a, edge))
    costs = {first: 0.0}
    came: dict[int, tuple[int, wire.EdgeState]] = {}
    waiting = [(0.0, first)]
    while waiting:
        cost, node = heapq.heappop(waiting)
        for step, other, edge in links.get(node, ()):
            if cost + step < costs.get(other, math.inf):
                costs[other], came[other] = cost + step, (node, edge)
                heapq.heappush(waiting, (cost + step, other))
    chain: list[wire.EdgeState] = []
    while last != first and last in came:
        last, edge = came[last]
        chain.insert(0, edge)
    return chain
