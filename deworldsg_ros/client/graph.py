"""A scene graph to ask: from a file, or as a client copied it from the topics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from deworldsg_ros.base.words import counted, visible
from deworldsg_ros.client.boxes import Triple, box_of, footprint, gap_m, radius_of
from deworldsg_ros.client.changes import Changes, changes_by_id, changes_by_place
from deworldsg_ros.client.explain import (
    ANYTHING,
    Explanation,
    explain_absence,
    explain_no_relation,
    explain_object,
    explain_place,
    explain_relation,
    place_of,
)
from deworldsg_ros.client.goals import Goal, Robot, free_direction, goal_near
from deworldsg_ros.client.meanings import (
    KNOWN,
    is_called,
    is_class,
    meant_by,
    more_general,
    near_names,
    words_of,
)
from deworldsg_ros.client.next_view import NextView, next_view
from deworldsg_ros.client.objects import (
    HiddenObject,
    Point,
    Relation,
    Room,
    Rooms,
    SceneObject,
    cheapest_chain,
    hidden_object,
    predicate_names,
    relation_of,
    scene_object,
    to_networkx,
)
from deworldsg_ros.client.removal import Order, Removal, Removals, resting_on
from deworldsg_ros.graph.embeddings import Looks, embed_text, embeddings_path, read_embeddings
from deworldsg_ros.graph.extent import DEFAULT_UP
from deworldsg_ros.graph.floor_plan import CELL_M as PLAN_CELL_M
from deworldsg_ros.graph.floor_plan import FloorPlan, floor_plan
from deworldsg_ros.graph.graph_files import graph_path, read_graph
from deworldsg_ros.graph.provenance import SeenFrames, SeenSpace, read_seen, read_space
from deworldsg_ros.graph.rooms import RoomMap
from deworldsg_ros.graph.seen_cells import SeenCells, ViewCamera
from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.errors import ClientError
from deworldsg_ros.scene.vocabulary import SYMMETRIC, plain
from deworldsg_ros.wire import messages as wire

# --- Finds objects and relations of a large graph without a look at each; made when first used.

Pair = tuple[int, int]


class GraphIndex:
    """An index of one graph, which never changes.

    Args:
        nodes: by id.
        edges: by subject and object.
    """

    def __init__(
        self, nodes: Mapping[int, wire.NodeState], edges: Mapping[Pair, wire.EdgeState]
    ) -> None:
        self._nodes, self._edges = nodes, edges

    @property
    def labels(self) -> list[str]:
        """The most probable classes of all objects, sorted."""
        return sorted(self._by_label)

    def called(self, label: str) -> list[int]:
        """The objects whose most probable class is meant by a name."""
        return [i for name, ids in self._by_label.items() if is_class(label, name) for i in ids]

    def perhaps(self, label: str) -> list[int]:
        """The objects that list a class which is meant by a name."""
        known = {belief.label for node in self._nodes.values() for belief in node.classes}
        meant = {name for name in known if is_class(label, name)}
        return [
            i
            for i, node in self._nodes.items()
            if any(belief.label in meant for belief in node.classes)
        ]

    def around(self, point: Triple, reach_m: float) -> list[int]:
        """The objects whose boxes may be in reach of a point: all that are, and a few others."""
        ids, centers, radii = self._spheres
        distances = np.linalg.norm(centers - np.array(point), axis=1)
        return [ids[row] for row in np.flatnonzero(distances - radii <= reach_m)]

    def touching(self, ids: Iterable[int]) -> list[Pair]:
        """The relations from and to some objects, each once."""
        return list(dict.fromkeys(pair for i in ids for pair in self._by_end.get(i, ())))

    @cached_property
    def _by_label(self) -> dict[str, list[int]]:
        found: dict[str, list[int]] = {}
        for i, node in self._nodes.items():
            found.setdefault(node.label, []).append(i)
        return found

    @cached_property
    def _by_end(self) -> dict[int, list[Pair]]:
        found: dict[int, list[Pair]] = {}
        for pair in self._edges:
            for end in pair:
                found.setdefault(end, []).append(pair)
        return found

    @cached_property
    def _spheres(self) -> tuple[list[int], Float64, Float64]:
        centers = [box_of(node)[0] for node in self._nodes.values()]
        radii = [radius_of(node) for node in self._nodes.values()]
        return list(self._nodes), np.array(centers, np.float64).reshape(-1, 3), np.array(radii)


# --- A scene graph to ask: from a file, or as a client copied it from the topics.

# What an argument of a question may be: an object, its id, or the name of a class.
Which = SceneObject | int | str


NO_LOOKS = (
    "no object of the graph has an embedding: set perception.embedder, or use a detector that "
    "gives them; live, use SceneGraphClient(embeddings=True)"
)
# Characters of a name in an error, and of a name at all: words are compared with many others.
MOST_SHOWN, MAX_NAME = 60, 500
# Cells of a floor plan.
MIN_CELL_M, MAX_CELL_M = 0.01, 1.0


@dataclass(frozen=True)
class Understood:
    """How the name of a class was understood.

    Attributes:
        asked: the name.
        meant: the name that is used; another one if the graph has only a more general class.
        labels: the classes of the graph that it means, sorted.
    """

    asked: str
    meant: str
    labels: tuple[str, ...]

    @property
    def note(self) -> str | None:
        """For people: ``mug: taken as cup``; None if the name is that of each class."""
        if all(is_called(words_of(self.asked), label) for label in self.labels):
            return None
        return f"{self.asked}: taken as {', '.join(self.labels)}"


class SceneGraph:
    """A graph at one moment, for questions. It never changes.

    All positions are in the world frame `frame_id`, in metres.

    Args:
        message: of `/scene_graph`, or of a file.
        seen: from which frames its objects and relations come, for `explain`.

    Attributes:
        message: the message.
        frame_id: the world frame.
        stamp_ns: time of the newest frame.
        sequence: number of the update.
        up: unit vector against gravity; +z if the message does not tell it.
        space: the space that the camera has seen as free, for `goal_near`; None = not known.
        looks: embeddings of objects, for `similar`; None = there are none.
    """

    def __init__(self, message: wire.SceneGraphMessage, seen: Iterable[SeenFrames] = ()) -> None:
        self.message = message
        self._seen = {(item.node, item.other): item for item in seen}
        self.space: SeenSpace | None = None
        self.looks: Looks | None = None
        self.frame_id = message.frame_id
        self.stamp_ns = wire.ns_from_stamp(message.stamp)
        self.sequence = message.sequence
        up = message.up if isinstance(message.up, list) else DEFAULT_UP
        self.up: Point = (up[0], up[1], up[2])
        self._nodes = {node.id: node for node in message.nodes}
        self._edges = {(edge.subject, edge.object): edge for edge in message.edges}
        self._made: dict[int, SceneObject] = {}

    @classmethod
    def load(cls, path: str | Path) -> SceneGraph:
        """The graph of a file, or of the folder of a run, with its frames, its seen space and its
        embeddings if they are beside it.

        Raises:
            RefusedInput: if the file is missing or contains no scene graph, or its embeddings
                are damaged.
        """
        file = graph_path(Path(path))
        message = read_graph(file)
        graph = cls(message, read_seen(file, wire.ns_from_stamp(message.stamp)))
        graph.space = read_space(file)
        if embeddings_path(file).is_file():
            graph.looks = read_embeddings(embeddings_path(file), graph.stamp_ns)
        return graph

    @cached_property
    def rooms(self) -> Rooms:
        """The rooms; of a graph of an older release, found in its views; else there are none."""
        states = self.message.rooms
        if not isinstance(states, list):
            space = self.space or SeenSpace()
            states = RoomMap().found_in(space, self.up).states(self.message.nodes)
        return Rooms.of_message(states)

    def room_of(self, which: Which) -> Room | None:
        """The room in which an object most probably is; None = in none that is known."""
        found = self.rooms.of(self.one(which).id)
        return found[0][0] if found else None

    def __len__(self) -> int:
        return len(self._nodes)

    def __repr__(self) -> str:
        return (
            f"SceneGraph({counted(len(self), 'object')}, {counted(len(self._edges), 'relation')})"
        )

    def __getitem__(self, node_id: int) -> SceneObject:
        """The object with an id; raises ClientError if it is not in the graph."""
        if node_id not in self._nodes:
            raise ClientError(f"object {node_id} is not in the graph of {len(self)} objects")
        if node_id not in self._made:
            self._made[node_id] = scene_object(self._nodes[node_id], self.frame_id, self.up)
        return self._made[node_id]

    def __contains__(self, node_id: object) -> bool:
        return node_id in self._nodes

    def __iter__(self) -> Iterator[SceneObject]:
        return (self[node_id] for node_id in self._nodes)

    @property
    def labels(self) -> list[str]:
        """The classes of the objects, sorted."""
        return self._index.labels

    @property
    def hidden(self) -> list[HiddenObject] | None:
        """Objects that were detected and are not in the graph; None = the message has no list."""
        hidden = self.message.hidden
        return [hidden_object(node) for node in hidden] if isinstance(hidden, list) else None

    def understand(self, name: str) -> Understood:
        """How the name of a class is understood here.

        "table" means "dining table", too, "sofa" means "couch", "seat" every chair and couch. If
        the graph knows no mug, "mug" means "cup".

        Raises:
            ClientError: if nothing is called so; it names what is spelt alike.
        """
        if len(name) > MAX_NAME:
            raise ClientError(
                f"'{visible(name[:MOST_SHOWN])}…' is the name of no class: it has {len(name)} "
                f"characters, expected at most {MAX_NAME}"
            )
        found = self._understand(name)
        if found is not None:
            return found
        words = words_of(name)
        for known in (" ".join(words[at:]) for at in range(1, len(words))):
            if self._understand(known) is not None:
                unknown = " ".join(words[: -len(known.split())])
                raise ClientError(f"'{visible(unknown)}' is not understood; '{visible(known)}' is")
        alike = near_names(" ".join(words), self._known)
        akin = self._akin(" ".join(words))
        raise ClientError(
            f"'{visible(name[:MOST_SHOWN])}' is the name of no class; "
            + (f"spelt alike: {visible(', '.join(alike))}; " if alike else "")
            + (f"closest in meaning: {visible(', '.join(akin))}; " if akin else "")
            + f"classes of the graph: {visible(', '.join(self.labels)) or 'none'}"
        )

    def _akin(self, name: str) -> list[str]:
        """Classes of the closest meaning, if the embeddings are of a model that is here."""
        if self.looks is None or not name.strip():
            return []
        try:
            meant, *known = (embed_text(self.looks.model, text) for text in (name, *self.labels))
        except ClientError:
            return []
        cosines = [float(meant @ one / np.linalg.norm(one)) for one in known]
        best = sorted(zip(cosines, self.labels), reverse=True)
        return [label for _, label in best[:2]]

    def _understand(self, name: str) -> Understood | None:
        plain_name = " ".join(words_of(name))
        # What objects most probably are comes before what they may be.
        for known in (self.labels, self._known):
            for meant in (name, *more_general(plain_name)):
                labels = tuple(sorted(label for label in known if is_class(meant, label)))
                if labels:
                    return Understood(name, meant, labels)
        is_known = not KNOWN.isdisjoint(meant_by(plain_name))
        return Understood(name, name, ()) if is_known else None

    @cached_property
    def _known(self) -> frozenset[str]:
        """All classes that an object of the graph may have, also a hidden one."""
        listed = {belief.label for node in self._nodes.values() for belief in node.classes}
        return frozenset({*listed, *self.labels, *(item.label for item in self.hidden or ())})

    def _meant(self, which: Which | None) -> Which | None:
        return self.understand(which).meant if isinstance(which, str) else which

    def objects(
        self,
        label: str | None = None,
        *,
        near: Point | SceneObject | None = None,
        within: float | None = None,
        min_probability: float | None = None,
    ) -> list[SceneObject]:
        """Objects, the most probable first; with `near`, the nearest first.

        Args:
            label: class, e.g. "cup"; see `understand`.
            near: a point, or an object, which is not part of the answer.
            within: largest distance of the box from `near`, metres.
            min_probability: least probability of being an object of the class. By default an object
                is of its most probable class.

        Raises:
            ClientError: for a word that no class is called.
        """
        if near is None and within is not None:
            raise ClientError("within needs near: a point or an object")
        if label is not None:
            label = self.understand(label).meant
        items = map(self.__getitem__, self._candidates(label, near, within, min_probability))
        found = [item for item in items if _fits(item, label, min_probability)]
        if near is None:
            key = (lambda item: item.probability) if label is None else _chance(label)
            return sorted(found, key=lambda item: (-key(item), item.id))
        origin = near.id if isinstance(near, SceneObject) else None
        ranked = sorted((distance_m(item, near), item.id) for item in found if item.id != origin)
        return [self[i] for gap, i in ranked if within is None or gap <= within]

    def relations(
        self,
        subject: Which | None = None,
        predicate: str | None = None,
        object: Which | None = None,
        *,
        min_probability: float = 0.0,
    ) -> list[Relation]:
        """Relations, the most probable first.

        A symmetric relation such as *near* is found from both ends, and counts once.

        Args:
            subject: an object, its id, or a class; None = any.
            object: as subject.
            predicate: its name; "on" includes "standing on"; None = the most probable one.
            min_probability: that it holds.
        """
        subject, object = map(self._meant, (subject, object))
        is_subject, is_object = self._chooser(subject), self._chooser(object)
        names = None if predicate is None else predicate_names(predicate)
        found = []
        for a_id, b_id in self._pairs(subject, object):
            edge = self._edges[a_id, b_id]
            if a_id not in self._nodes or b_id not in self._nodes:
                continue
            if names is not None and not any(plain(i.label) in names for i in edge.predicates):
                continue
            a, b = self[a_id], self[b_id]
            item = relation_of(edge, a, b, predicate)
            if is_subject(a) and is_object(b):
                found.append(item)
            elif (
                (edge.mutual is True or plain(item.predicate) in SYMMETRIC)
                and (b_id, a_id) not in self._edges
                and is_subject(b)
                and is_object(a)
            ):
                found.append(relation_of(edge, b, a, predicate))
        found = [item for item in found if item.probability >= max(min_probability, 1e-9)]
        return sorted(found, key=lambda i: (-i.probability, i.subject.id, i.object.id))

    def relations_of(self, which: Which) -> list[Relation]:
        """All relations from and to an object, each once, the most probable first."""
        item = self.one(which)
        found = self.relations(item)
        known = {(i.object.id, i.predicate) for i in found if plain(i.predicate) in SYMMETRIC}
        found += [
            relation
            for relation in self.relations(None, None, item)
            if (relation.subject.id, relation.predicate) not in known
        ]
        return sorted(found, key=lambda i: -i.probability)

    def one(self, which: Which) -> SceneObject:
        """The object that is meant; of a class, the most probable one.

        Raises:
            ClientError: if there is none.
        """
        if isinstance(which, SceneObject):
            return self[which.id]
        if isinstance(which, int):
            return self[which]
        found = self.objects(which)
        if not found:
            known = ", ".join(self.labels) or "none"
            raise ClientError(f"no object of class '{which}'; classes of the graph: {known}")
        return found[0]

    def frames(self, subject_id: int, object_id: int = 0) -> SeenFrames | None:
        """The frames of an object, or of a relation; None = not known."""
        pair = (subject_id, object_id)
        return self._seen.get(pair, self._seen.get(pair[::-1]) if object_id else None)

    def edge(self, subject_id: int, object_id: int) -> wire.EdgeState | None:
        """The message of a directed edge; None = there is none."""
        return self._edges.get((subject_id, object_id))

    def on(self, support: Which, label: str | None = None) -> list[SceneObject]:
        """Objects that are on another one with a probability of at least one half."""
        found = self.relations(label, "on", support, min_probability=0.5)
        return list(dict.fromkeys(item.subject for item in found))

    def neighbours(self, of: Which, within: float = 1.0) -> list[tuple[SceneObject, float]]:
        """The other objects in reach of one, with the gap of the boxes in metres, nearest first."""
        center = self.one(of)
        found = self.objects(near=center, within=within)
        return [(item, gap_m(center.footprint, item.footprint)) for item in found]

    def path(self, start: Which, end: Which) -> list[Relation]:
        """The most probable chain of relations from one object to another; empty if there is none.

        Directions do not count: each relation is given as the graph has it.
        """
        chain = cheapest_chain(self._edges, self.one(start).id, self.one(end).id)
        return [relation_of(edge, self[edge.subject], self[edge.object], None) for edge in chain]

    def resting_on(self, support: Which) -> list[tuple[SceneObject, float]]:
        """What rests on an object, all the way up, with probabilities; see `removal`."""
        return resting_on(self, self.one(support))

    def if_removed(self, which: Which) -> Removal:
        """What moves if an object is taken away, with probabilities.

        Raises:
            ClientError: without the package mujoco (the extra ``physics``).
        """
        return self._removals.without(self.one(which))

    def order_to_take(self, which: Which) -> Order:
        """What to take first, so that nothing falls when an object is taken; see `if_removed`."""
        return self._removals.order(self.one(which))

    def order_to_clear(self, support: Which) -> Order:
        """In which order to take all that rests on an object, so that nothing falls."""
        return self._removals.clearing(self.one(support))

    @cached_property
    def _removals(self) -> Removals:
        return Removals(self)

    def free_direction(self, of: Which, towards: Point | None = None, room: float = 1.0) -> Point:
        """A horizontal direction in which an object has room; see `goals.free_direction`."""
        return free_direction(self.one(of), self, towards, room)

    def goal_near(
        self,
        of: Which,
        distance: float = 1.0,
        *,
        robot: Robot = Robot(),
        towards: Point | None = None,
        space: SeenSpace | None = None,
    ) -> Goal:
        """A pose from which an object is in view; see `goals.goal_near`."""
        target, seen = self.one(of), space or self.space
        return goal_near(
            target, self, distance, self.stamp_ns, robot=robot, towards=towards, space=seen
        )

    def next_view(
        self,
        *,
        robot: Robot = Robot(),
        start: Point | None = None,
        camera: ViewCamera | None = None,
        cells: SeenCells | None = None,
    ) -> NextView | None:
        """Where to look next; None = nothing is worth a look. See `next_view.next_view`."""
        return next_view(self, robot=robot, start=start, camera=camera, cells=cells)

    def seen_space(self) -> SeenSpace:
        """What the camera saw: depth images of different views; ClientError if not at hand."""
        if self.space is None or not len(self.space):
            raise ClientError(
                "the graph has no views of the camera: they are in scene_graph.space.npz beside "
                "the graph of a run, and in maps, and not on the topics"
            )
        return self.space

    def floor_plan(self, robot: Robot = Robot(), cell_m: float = PLAN_CELL_M) -> FloorPlan:
        """Where a robot can go, and where something is, as far as the camera saw it.

        Args:
            robot: what is higher than it, is not in its way; its width is left to the planner.
            cell_m: width of a cell, from 1 cm to 1 m.

        Raises:
            ClientError: without views of the camera, or for another width.
        """
        if not MIN_CELL_M <= cell_m <= MAX_CELL_M:
            raise ClientError(f"cells of {cell_m:g} m: expected {MIN_CELL_M:g} to {MAX_CELL_M:g}")
        plan = floor_plan(self.seen_space(), self.up, robot.height_m, cell_m=cell_m)
        if plan is None:
            raise ClientError("the views of the camera show nothing: no depth in any of them")
        return plan

    def take_embeddings(self, path: str | Path) -> None:
        """Take the embeddings of the map that was saved with this graph, or of another file.

        Raises:
            RefusedInput: ``unreadable_embeddings``.
        """
        self.looks = read_embeddings(Path(path))

    def embedding(self, which: Which) -> Float32 | None:
        """What an object looks like: a unit vector (D,); None if no frame has embedded it."""
        node_id = self.one(which).id
        return None if self.looks is None else self.looks.vectors.get(node_id)

    def similar(
        self, vector: Sequence[float] | Float32, k: int = 5
    ) -> list[tuple[SceneObject, float]]:
        """The k objects that look most like a vector (D,), with their cosines, the best first.

        Raises:
            ClientError: if no object has an embedding, or the vector does not fit.
        """
        if self.looks is None:
            raise ClientError(NO_LOOKS)
        try:
            ranked = self.looks.similar(vector)
        except ValueError as error:
            raise ClientError(str(error)) from error
        found = [(self[node_id], cosine) for node_id, cosine in ranked if node_id in self]
        return found[: max(k, 0)]

    def like(
        self, text: str, k: int = 5, *, model: str | None = None
    ) -> list[tuple[SceneObject, float]]:
        """The k objects that look most like a text, with the cosines, the best first.

        A cosine is no probability: those of CLIP are from 0.2 to 0.35, those of SigLIP near 0.1.

        Args:
            text: e.g. "something to drink from".
            k: greatest number of objects.
            model: folder or hub id of the model of the embeddings, if it is not their name here.

        Raises:
            ClientError: without embeddings, torch, transformers, or the model in the local cache.
        """
        if self.looks is None:
            raise ClientError(NO_LOOKS)
        return self.similar(embed_text(model or self.looks.model, text), k)

    def explain(self, what: Which | Relation | tuple[Which, Which]) -> Explanation:
        """Why something is in the graph, or is not: an object, a relation, a pair, or a class.

        Or what is known of a place: ``chair near (1.6, -0.5)``, see `explain.place_of`.
        """
        place = place_of(what, self.up) if isinstance(what, str) else None
        if place is not None:
            if place.label != ANYTHING:
                place = replace(place, label=self.understand(place.label).meant)
            return explain_place(place, list(self), self.hidden, self.space, self.up)
        if isinstance(what, tuple):
            a, b = self.one(what[0]), self.one(what[1])
            found = self.relations(a, None, b) or self.relations(b, None, a)
            if not found:
                return explain_no_relation(a, b)
            what = found[0]
        if isinstance(what, Relation):
            return explain_relation(what, self.frames(what.subject.id, what.object.id))
        if isinstance(what, str) and not self.objects(what):
            return explain_absence(what, self.hidden, list(self))
        item = self.one(what)
        return explain_object(item, self.relations_of(item), self.frames(item.id))

    def changes_since(self, before: SceneGraph) -> Changes:
        """Differences from an earlier graph, in the same world frame.

        Ids are compared if the earlier graph is of the same session. Otherwise objects are
        recognised by place and class.
        """
        if self.is_later_than(before):
            mine, theirs = ({i.id: i for i in graph} for graph in (self, before))
            return changes_by_id(theirs, mine)
        return changes_by_place(before, self)

    def to_networkx(self) -> Any:
        """The graph as a networkx.MultiDiGraph; needs the package networkx."""
        return to_networkx(self, self.relations())

    def is_later_than(self, other: SceneGraph) -> bool:
        """Whether both graphs are of one session, and this one is not the earlier one."""
        mine, theirs = (getattr(graph.message, "session", None) for graph in (self, other))
        if isinstance(mine, str) and isinstance(theirs, str):
            return mine == theirs and self.sequence >= other.sequence
        return False

    def _candidates(
        self,
        label: str | None,
        near: Point | SceneObject | None,
        within: float | None,
        min_probability: float | None,
    ) -> Iterable[int]:
        """The ids of all objects that `objects` may find, and of some others."""
        if near is not None and within is not None:
            if not isinstance(near, SceneObject):
                return self._index.around(near, within)
            reach_m = within + float(np.linalg.norm(near.size_m)) / 2 + 1e-6
            return self._index.around(near.position_m, reach_m)
        if label is None:
            return self._nodes
        if min_probability is None:
            return self._index.called(label)
        return self._index.perhaps(label) if min_probability > 0 else self._nodes

    def _pairs(self, subject: Which | None, object: Which | None) -> Iterable[tuple[int, int]]:
        """The relations from or to what is asked for, and some others."""
        which = object if subject is None else subject
        if which is None:
            return self._edges
        if isinstance(which, str):
            return self._index.touching(self._index.called(which))
        return self._index.touching([which if isinstance(which, int) else which.id])

    @cached_property
    def _index(self) -> GraphIndex:
        return GraphIndex(self._nodes, self._edges)

    def _chooser(self, which: Which | None) -> Callable[[SceneObject], bool]:
        if which is None:
            return lambda item: True
        if isinstance(which, str):
            return lambda item: is_class(which, item.label)
        node_id = which if isinstance(which, int) else which.id
        return lambda item: item.id == node_id


def _fits(item: SceneObject, label: str | None, least: float | None) -> bool:
    if label is None:
        return least is None or item.probability >= least
    if least is None:
        return is_class(label, item.label)
    return item.probability_of(label) >= least


def _chance(label: str) -> Callable[[SceneObject], float]:
    return lambda item: item.probability_of(label)


def distance_m(item: SceneObject, near: Point | SceneObject) -> float:
    """Distance of a box from a point, or from another box."""
    if isinstance(near, SceneObject):
        return gap_m(item.footprint, near.footprint)
    point = footprint(near, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), item.up)
    return gap_m(item.footprint, point)
