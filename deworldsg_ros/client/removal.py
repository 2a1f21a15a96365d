"""What moves if an object is taken away: scenes that the graph believes in, settled in MuJoCo.

A graph knows boxes, classes and what rests on what, and no shapes. So an object that carries
others is made of boards: one under each thing that rests on it or in it, as wide as its box, at the
height of the thing's bottom. A table has a board on top, a shelf several, a bowl one inside. Legs
and walls are not needed, because the boards of one object are one rigid body. Each thing touches
its own board from the start, so nothing hovers or overlaps, whatever the errors of the boxes are.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from deworldsg_ros.client.boxes import Footprint, gap_m, horizontal_gap_m
from deworldsg_ros.client.objects import Point, Relation, SceneObject, predicate_names
from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import ClientError
from deworldsg_ros.scene.vocabulary import plain


class SceneGraph(Protocol):
    """What is asked of a `graph.SceneGraph`, which imports this file."""

    up: Point

    def __getitem__(self, node_id: int, /) -> SceneObject: ...

    def edge(self, subject_id: int, object_id: int) -> object:
        """The edge; None = there is none."""

    def objects(
        self, *, near: Point | SceneObject | None = None, within: float | None = None
    ) -> list[SceneObject]:
        """Objects, the nearest first."""
        ...

    def relations(
        self,
        subject: SceneObject | None = None,
        predicate: str | None = None,
        object: SceneObject | None = None,
    ) -> list[Relation]:
        """Relations, the most probable first."""
        ...


# --- What rests on what: the supports that a graph believes in.

# Relations in which the object carries the subject, and those that hold it without a surface below.
HELD = predicate_names("attached to")
CARRIED = predicate_names("on") | predicate_names("in") | HELD
# Supports that are less probable are left out.
LEAST = 0.02
# Objects are not stacked deeper.
MOST_LEVELS = 12


def supports_of(graph: SceneGraph, item: SceneObject) -> dict[int, tuple[float, bool]]:
    """What an object rests on, by the graph's edges: id to (probability, whether it is held there).

    An object has one support, so the probabilities sum to 1 at most.
    """
    found = {}
    for relation in graph.relations(item):
        if graph.edge(item.id, relation.object.id) is None:
            continue  # said of the opposite direction
        shares = [b.probability for b in relation.predicates if plain(b.label) in CARRIED]
        held = [b.probability for b in relation.predicates if plain(b.label) in HELD]
        if sum(shares) >= LEAST:
            found[relation.object.id] = sum(shares), sum(held) > 0.5 * sum(shares)
    total = max(sum(share for share, _ in found.values()), 1.0)
    return {other: (share / total, held) for other, (share, held) in found.items()}


def carriers_of(graph: SceneGraph, item: SceneObject) -> dict[int, float]:
    """What an object rests on, all the way down: probabilities by id.

    The supports of different objects count as independent.
    """
    found: dict[int, float] = {}
    level = {item.id: 1.0}
    for _ in range(MOST_LEVELS):
        below: dict[int, float] = {}
        for node_id, chance in level.items():
            for other, (share, _) in supports_of(graph, graph[node_id]).items():
                if other != item.id and chance * share >= LEAST:
                    below[other] = below.get(other, 0.0) + chance * share
        for other, chance in below.items():
            found[other] = min(found.get(other, 0.0) + chance, 1.0)
        level = below
    return found


def resting_on(graph: SceneGraph, support: SceneObject) -> list[tuple[SceneObject, float]]:
    """What rests on an object, all the way up, with probabilities, the most probable first."""
    found, waiting = dict[int, float](), [support.id]
    while waiting:
        for relation in graph.relations(None, None, graph[waiting.pop()]):
            item = relation.subject
            if item.id not in found and item.id != support.id:
                found[item.id] = carriers_of(graph, item).get(support.id, 0.0)
                waiting += [item.id] if found[item.id] >= LEAST else []
    ranked = sorted((-chance, i) for i, chance in found.items() if chance >= LEAST)
    return [(graph[i], -chance) for chance, i in ranked]


# --- Answers.

# A step is safe if anything moves with less than this probability.
SAFE = 0.05
# Odds that are smaller are not told; an object that needs another one moves with the second.
TOLD, LIKELY = 0.01, 0.5


@dataclass(frozen=True)
class Removal:
    """What happens if an object is taken away.

    Attributes:
        item: the object.
        moves: the other objects that move by 3 cm or drop, with probabilities, the most probable
            first.
        risk: probability that anything moves that is not fixed to the object.
    """

    item: SceneObject
    moves: tuple[tuple[SceneObject, float], ...]
    risk: float

    @property
    def is_safe(self) -> bool:
        """Whether it can be taken: only what is fixed to it moves."""
        return self.risk < SAFE

    @property
    def lines(self) -> list[str]:
        """For people."""
        first = f"{self.item.name} can be taken" if self.is_safe else f"{self.item.name}: not safe"
        return [
            f"{first}; something falls or moves: {self.risk:.0%}",
            *(f"  {other.name} moves: {chance:.0%}" for other, chance in self.moves),
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "object": {"id": self.item.id, "label": self.item.label},
            "safe": self.is_safe,
            "risk": round(self.risk, 3),
            "moves": [
                {"id": other.id, "label": other.label, "probability": round(chance, 3)}
                for other, chance in self.moves
            ],
        }


@dataclass(frozen=True)
class Order:
    """An order in which objects can be taken.

    Attributes:
        target: the object that is wanted, or cleared.
        steps: what is taken, the first one first.
    """

    target: SceneObject
    steps: tuple[Removal, ...]

    @property
    def is_safe(self) -> bool:
        """Whether every step is."""
        return all(step.is_safe for step in self.steps)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "target": {"id": self.target.id, "label": self.target.label},
            "safe": self.is_safe,
            "steps": [step.to_dict() for step in self.steps],
        }


# --- What may touch what: supports by the edges and by the boxes, and neighbours side by side.

# Standard deviation of a face of a box: the median error of bottoms is 0.8 cm (CHANGELOG).
BOX_STD_M = 0.01
# Boxes so near to each other touch.
TOUCHING_M = 0.015
# So much of the footprint of a thing is above what it stands in; and of either, if it is on it.
INSIDE, OVERLAP = 0.8, 0.04
# What may carry an object is searched so far around its box.
REACH_M = 0.04
# The floor is that of the objects within this distance.
FLOOR_REACH_M = 4.0
# Objects that may move in one simulation.
MOST_BODIES = 48
NO = 0.0, 0.0
# A flat object has a variance across of less than this part of the next one. It leans if it stands
# askew by these angles.
FLAT, ASKEW_DEGREES = 0.3, (5.0, 45.0)


class Contact(NamedTuple):
    """A support that an object may have.

    Attributes:
        other: its id.
        share: probability that it is the main one.
        touching: probability that the object touches it from above, by the boxes.
        is_held: whether the object is fixed to it.
    """

    other: int
    share: float
    touching: float
    is_held: bool


class Contacts:
    """What each object may rest on and touch; found when asked for.

    Args:
        graph: the graph.
    """

    def __init__(self, graph: SceneGraph) -> None:
        self.graph = graph
        self._below: dict[int, list[Contact]] = {}
        self._around: dict[int, list[SceneObject]] = {}
        self._leaning: dict[int, set[int]] = {}
        self._apart: dict[tuple[int, ...], list[tuple[int, int]]] = {}

    def around(self, node_id: int) -> list[SceneObject]:
        """The objects whose boxes touch that of an object."""
        if node_id not in self._around:
            found = self.graph.objects(near=self.graph[node_id], within=REACH_M)
            self._around[node_id] = found
        return self._around[node_id]

    def below(self, node_id: int) -> list[Contact]:
        """What an object may rest on; what is left to 1 is for the floor, or a wall."""
        if node_id in self._below:
            return self._below[node_id]
        item = self.graph[node_id]
        said = supports_of(self.graph, item)
        shown = self._shown(item)
        rest = 1.0 - sum(share for share, _ in said.values())
        found = []
        for other in {**said, **shown}:
            (share, held), (shape, touching) = said.get(other, (0.0, False)), shown.get(other, NO)
            found.append(Contact(other, share + rest * shape, touching, held))
        kept = [one for one in found if max(one.share, one.touching) >= LEAST]
        self._below[node_id] = sorted(kept, key=lambda one: (-one.share, one.other))
        return self._below[node_id]

    def carriers(self, node_id: int) -> set[int]:
        """What an object may rest on, all the way down."""
        found, waiting = set[int](), [node_id]
        while waiting:
            below = {one.other for one in self.below(waiting.pop())} - found
            found |= below
            waiting += below
        return found

    def above(self, node_id: int) -> set[int]:
        """The objects that may rest on one."""
        near = {item.id for item in self.around(node_id)}
        near |= {r.subject.id for r in self.graph.relations(None, None, self.graph[node_id])}
        return {i for i in near if any(one.other == node_id for one in self.below(i))}

    def is_free(self, node_id: int) -> bool:
        """Whether an object rests on another one, and not on the floor or a wall."""
        return sum(one.share for one in self.below(node_id)) >= 0.1

    def beside(self, node_id: int) -> set[int]:
        """The free objects that touch an object from the side."""
        own = self.graph[node_id].footprint
        return {
            item.id
            for item in self.around(node_id)
            if self.is_free(item.id)
            and min(own.high, item.footprint.high) - max(own.low, item.footprint.low) > 0.01
            and horizontal_gap_m(own, item.footprint) <= TOUCHING_M
        }

    def leans_on(self, node_id: int) -> set[int]:
        """What a flat object that stands askew touches on the side to which it leans."""
        if node_id not in self._leaning:
            item, up = self.graph[node_id], horizontal_axes(self.graph.up)
            spread, axes = np.linalg.eigh(up @ np.array(item.covariance_m2) @ up.T)
            normal = axes[:, 0] * math.copysign(1.0, axes[2, 0])
            flat, low, high = spread[0] < FLAT * spread[1], *np.sin(np.radians(ASKEW_DEGREES))
            found = set[int]()
            if flat and low < normal[2] < high:
                below = {one.other for one in self.below(node_id)}
                for other in self.beside(node_id) - below:
                    way = self.graph[other].footprint.center - item.footprint.center
                    found |= {other} if way @ normal[:2] < 0.0 else set()
            self._leaning[node_id] = found
        return self._leaning[node_id]

    def groups(self, node_id: int) -> Iterator[list[int]]:
        """Groups of free objects that may touch one another, of those that may need an object."""
        waiting = [node_id] if self.is_free(node_id) else sorted(self.above(node_id))
        done: set[int] = set()
        while waiting:
            group, edge = list[int](), [waiting.pop(0)]
            while edge and len(group) < MOST_BODIES:
                one = edge.pop(0)
                if one in done or not self.is_free(one):
                    continue
                done.add(one)
                group.append(one)
                edge += [contact.other for contact in self.below(one)]
                edge += sorted(self.above(one) | self.beside(one))
            if group:
                yield group

    def apart(self, group: Sequence[int]) -> list[tuple[int, int]]:
        """Pairs of a group whose boxes are near and do not overlap: they may touch later."""
        key = tuple(group)
        if key not in self._apart:
            boxes = {i: self.graph[i].footprint for i in group}
            near = {i: {item.id for item in self.around(i)} for i in group}
            self._apart[key] = [
                (a, b)
                for a in group
                for b in group
                if a < b and b in near[a] and gap_m(boxes[a], boxes[b]) > 0.0
            ]
        return self._apart[key]

    def _shown(self, item: SceneObject) -> dict[int, tuple[float, float]]:
        """What the boxes show below an object: `share` and `touching`; the rest is the floor's."""
        own = item.footprint
        found = []
        for other in self.around(item.id):
            box = other.footprint
            share = overlap(own, box)
            if max(share, overlap(box, own)) < OVERLAP:  # a plank on a block, a block on a plank
                continue
            top = math.exp(-0.5 * ((own.low - box.high) / BOX_STD_M) ** 2)
            # A thing that stands beside another one starts as low, one that stands in it higher.
            rise = (own.low - box.low) / BOX_STD_M if share >= INSIDE else 0.0
            within = 0.5 * (1.0 + math.tanh(rise - 2.0)) * (own.low < box.high)
            found.append((box.low + 2 * BOX_STD_M * top, other.id, max(top, within), top))
        shares, left = dict[int, tuple[float, float]](), 1.0
        for _, other_id, chance, top in sorted(found, reverse=True):  # the nearest below carries
            shares[other_id] = left * chance, top
            left *= 1.0 - 0.97 * chance
        floor = left * math.exp(-0.5 * ((own.low - self._floor(item)) / BOX_STD_M) ** 2)
        total = floor + sum(share for share, _ in shares.values())
        # Without anything below, it is fixed to something that the graph does not know.
        scale = 1.0 / total if total > 0.1 else 1.0
        return {i: (scale * share, top) for i, (share, top) in shares.items()}

    def _floor(self, item: SceneObject) -> float:
        near = self.graph.objects(near=item.position_m, within=FLOOR_REACH_M)
        return min((other.footprint.low for other in near), default=item.footprint.low)


def overlap(a: Footprint, b: Footprint) -> float:
    """Share of a footprint that is over another one, from a grid of points."""
    u, v = a.corners[1] - a.corners[0], a.corners[3] - a.corners[0]
    steps = (np.arange(12) + 0.5) / 12
    points = a.corners[0] + (steps[:, None, None] * u + steps[:, None] * v).reshape(-1, 2)
    p, q = b.corners[1] - b.corners[0], b.corners[3] - b.corners[0]
    along = (points - b.corners[0]) @ np.stack([p, q], axis=1)
    sides = np.array([p @ p, q @ q])
    return float(((along >= 0) & (along <= sides)).all(axis=1).mean())


# --- Sampled scenes, settled.

# A body moves if it goes so far, or drops so much, in this time: the rule of the simulated rooms.
MOVED_M, DROPPED_M, WATCHED_S = 0.03, 0.004, 0.6
STEP_S = 0.004
# kg/m³ and its spread, as a factor: things of a household, hollow or not.
DENSITY, DENSITY_SPREAD = 250.0, 0.5
# The centre of mass is off the middle of the box by its error, or by this part of its half side.
OFF_CENTER = 0.2
BOARD_M = 0.01
# Samples of a group: as many as this for each object in it, within these limits. Twice as many are
# drawn to find those that rest as they were seen; with fewer than FEWEST, the others count as well.
SAMPLES, LEAST_SAMPLES, MOST_SAMPLES, FEWEST = 120, 8, 24, 4
_OPTION = (
    f'<compiler angle="radian"/><option timestep="{STEP_S}" integrator="implicitfast" '
    'cone="elliptic" impratio="3" iterations="30"/><default><geom contype="0" conaffinity="0"/>'
    '<pair condim="4" friction="0.7 0.7 0.01 0.002 0.002" solref="0.01 1" '
    'solimp="0.95 0.99 0.001"/></default>'
)


class Scene:
    """One sample of a group of objects: what they rest on, and their boxes with errors.

    Args:
        contacts: what may touch what.
        group: ids of the objects that may move.
        rng: draws the sample.
    """

    def __init__(self, contacts: Contacts, group: list[int], rng: np.random.Generator) -> None:
        self._contacts, self._group = contacts, group
        self._held: dict[int, int] = {}
        self._below = {node_id: self._draw(node_id, rng) for node_id in group}
        self._free = [i for i in group if self._below[i] and i not in self._held]
        self._leans = {i: contacts.leans_on(i) for i in self._free}
        self._rng = rng.spawn(1)[0]

    def moved(self, gone: set[int]) -> set[int]:
        """The objects that move without some others, and would not with them."""
        fallen = self._unsupported(self._with_held(gone))
        if self._is_simulated and not fallen.issuperset(self._free):
            moved = self._run(self._with_held(gone)) - self._still
            fallen = self._unsupported(fallen | moved)
        return fallen - gone

    @property
    def is_settled(self) -> bool:
        """Whether everything rests, as it was seen: else the sample is not what is there."""
        return not (self._is_simulated and self._still)

    @property
    def _is_simulated(self) -> bool:
        """Whether more than one thing may touch a free object, and the rest is not obvious."""
        return len(self._free) > 1 or any(len(self._below[i]) > 1 for i in self._free)

    def fixed_to(self, node_id: int) -> set[int]:
        """An object, and what goes along with it."""
        return self._with_held({node_id})

    def _draw(self, node_id: int, rng: np.random.Generator) -> list[int]:
        """What an object rests on, the main support first; empty = it is fixed."""
        below = self._contacts.below(node_id)
        at = int(np.searchsorted(np.cumsum([one.share for one in below]), rng.random()))
        if at == len(below):
            return []
        main = below[at]
        if main.is_held:
            self._held[node_id] = main.other
        # What carries the main support is below it, and does not touch.
        lower = self._contacts.carriers(main.other)
        more = [
            one.other
            for one in below
            if one is not main
            and one.other not in lower
            and rng.random() < one.touching
            and not {node_id, main.other} & self._contacts.carriers(one.other)
        ]
        return [main.other, *more]

    def _with_held(self, ids: set[int]) -> set[int]:
        """Objects, and what is fixed to them."""
        found = set(ids)
        for _ in self._held:
            found |= {i for i, holder in self._held.items() if holder in found}
        return found

    def _unsupported(self, gone: set[int]) -> set[int]:
        """Objects, and what has lost all that it rested on, what it leans on, or is fixed to."""
        found = set(gone)
        while True:
            more = {
                i
                for i in self._free
                if found.issuperset(self._below[i]) or not found.isdisjoint(self._leans[i])
            }
            if found.issuperset(more):
                return found
            found |= self._with_held(more)

    def _run(self, gone: set[int]) -> set[int]:
        mujoco, model, ends, rows = self._model
        model.pair_margin[:] = np.where(np.isin(ends, list(gone)).any(axis=1), -1e3, 0.0)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        before = data.xpos[rows].copy()
        mujoco.mj_step(model, data, nstep=round(WATCHED_S / STEP_S))
        way = data.xpos[rows] - before
        far = (np.linalg.norm(way, axis=1) > MOVED_M) | (way[:, 2] < -DROPPED_M)
        return {i for i, is_far in zip(self._free, far) if is_far} - gone

    @cached_property
    def _still(self) -> set[int]:
        return self._run(set())

    @cached_property
    def _model(self) -> tuple[Any, Any, Any, list[int]]:
        """mujoco, its model, the objects of each pair (n, 2), and the rows of the free bodies."""
        mujoco = _mujoco()
        model = mujoco.MjModel.from_xml_string(self._xml())
        owners = np.array([int(model.geom(k).name.split("_")[0]) for k in range(model.ngeom)])
        ends = np.stack([owners[model.pair_geom1], owners[model.pair_geom2]], axis=1)
        return mujoco, model, ends, [model.body(f"b{i}").id for i in self._free]

    def _xml(self) -> str:
        graph = self._contacts.graph
        origin = np.append(graph[self._group[0]].footprint.center, 0.0)
        on: dict[int, list[int]] = {}
        for node_id, below in self._below.items():
            for other in below:
                on.setdefault(other, []).append(node_id)
        bodies, pairs = [], []
        for node_id in sorted({*self._group, *on}):
            center, half, yaw = _upright(graph[node_id])
            x, y, z = center - origin
            low, high = self._rng.normal(0.0, BOX_STD_M, (2, 2))
            wide = np.maximum(half[:2] + (high - low) / 2, 0.005)
            # What is thin stands all the same: the centre of mass is off by a part of the box.
            off = self._rng.normal(0.0, np.minimum(BOX_STD_M, OFF_CENTER * half[:2]))
            shift = (high + low) / 2
            mass = DENSITY * 8.0 * half.prod() * math.exp(DENSITY_SPREAD * self._rng.normal())
            a, b, c = mass / 3.0 * (half**2).sum() - mass / 3.0 * half**2
            boards = "".join(
                f'<geom name="{node_id}_{thing}" type="box" pos="{shift[0]} {shift[1]} '
                f'{graph[thing].footprint.low - BOARD_M / 2 - z}" '
                f'size="{wide[0]} {wide[1]} {BOARD_M / 2}"/>'
                for thing in on.get(node_id, ())
            )
            joint = "<freejoint/>" if node_id in self._free else ""
            bodies.append(
                f'<body name="b{node_id}" pos="{x} {y} {z}" euler="0 0 {yaw}">{joint}'
                f'<inertial pos="{off[0]} {off[1]} 0" mass="{mass}" diaginertia="{a} {b} {c}"/>'
                f'<geom name="{node_id}_" type="box" size="{half[0] - 1e-3} {half[1] - 1e-3} '
                f'{half[2]}"/>{boards}</body>'
            )
            pairs += [(f"{thing}_", f"{node_id}_{thing}") for thing in on.get(node_id, ())]
        pairs += [(f"{a}_", f"{b}_") for a, b in self._contacts.apart(self._group)]
        contact = "".join(f'<pair geom1="{a}" geom2="{b}"/>' for a, b in pairs)
        return (
            f"<mujoco>{_OPTION}<worldbody>{''.join(bodies)}</worldbody>"
            f"<contact>{contact}</contact></mujoco>"
        )


def _upright(item: SceneObject) -> tuple[Float64, Float64, float]:
    """Centre (3,) and half sizes (3,) of a box in upright axes, and its turn about up."""
    box = item.footprint
    u, v = box.corners[1] - box.corners[0], box.corners[3] - box.corners[0]
    center = np.append(box.center, (box.low + box.high) / 2)
    sizes = np.array([np.linalg.norm(u), np.linalg.norm(v), box.high - box.low])
    return center, np.maximum(sizes / 2, 0.003), math.atan2(u[1], u[0])


def _mujoco() -> Any:
    try:
        import mujoco
    except ImportError as error:
        raise ClientError(
            "what falls is simulated by the package mujoco: pip install 'deworldsg_ros[physics]'"
        ) from error
    return mujoco


class Removals:
    """Answers what moves if something is taken, for one graph.

    Args:
        graph: the graph.

    Raises:
        ClientError: without the package mujoco.
    """

    def __init__(self, graph: SceneGraph) -> None:
        _mujoco()
        self._graph = graph
        self._contacts = Contacts(graph)
        self._lock = threading.RLock()  # samples are settled one at a time
        self._scenes: dict[tuple[int, ...], list[Scene]] = {}

    def without(self, item: SceneObject, taken: Iterable[int] = ()) -> Removal:
        """What happens if an object is taken away, when others are taken already."""
        with self._lock:
            return self._without(item, taken)

    def _without(self, item: SceneObject, taken: Iterable[int]) -> Removal:
        before, chances, calm = set(taken), dict[int, float](), 1.0
        for group in self._contacts.groups(item.id):
            scenes = self._sampled(group)
            moved = [scene.moved(before | {item.id}) - before for scene in scenes]
            along = [scene.fixed_to(item.id) for scene in scenes]
            for node_id in set(group) - before - {item.id}:
                seen = [node_id in found for found in moved]
                chances[node_id] = sum(seen) / len(seen)
            calm *= sum(found <= more for found, more in zip(moved, along)) / len(moved)
        told = [(i, chance) for i, chance in chances.items() if chance >= TOLD]
        told.sort(key=lambda pair: (-pair[1], pair[0]))
        return Removal(item, tuple((self._graph[i], chance) for i, chance in told), 1.0 - calm)

    def order(self, item: SceneObject, before: Iterable[Removal] = ()) -> Order:
        """An order in which an object can be taken: what would fall without it comes first."""
        steps = list(before)
        self._take(item, steps, {item.id})
        return Order(item, tuple(steps))

    def clearing(self, support: SceneObject) -> Order:
        """An order in which everything can be taken that needs an object."""
        needs = [other for other, chance in self.without(support).moves if chance >= LIKELY]
        steps: list[Removal] = []
        for item in sorted(needs, key=lambda item: (-item.footprint.low, item.id)):
            if item.id not in {step.item.id for step in steps}:
                self._take(item, steps, {item.id, support.id})
        return Order(support, tuple(steps))

    def _take(self, item: SceneObject, steps: list[Removal], pending: set[int]) -> None:
        """Append the steps of an object; those that wait for it are not taken first."""
        while True:
            taken = {step.item.id for step in steps}
            removal = self.without(item, taken)
            first = [one for one, _ in removal.moves if one.id not in pending]
            if removal.is_safe or not first:
                steps.append(removal)
                return
            highest = max(first, key=lambda one: (one.footprint.low, one.id))
            self._take(highest, steps, pending | {highest.id})

    def _sampled(self, group: list[int]) -> list[Scene]:
        key = tuple(sorted(group))
        if key not in self._scenes:
            rng = np.random.default_rng([len(key), *key])
            count = min(max(SAMPLES // len(key), LEAST_SAMPLES), MOST_SAMPLES)
            drawn = [Scene(self._contacts, list(key), rng) for _ in range(2 * count)]
            settled = list(itertools.islice((one for one in drawn if one.is_settled), count))
            self._scenes[key] = settled if len(settled) >= FEWEST else drawn[:count]
        return self._scenes[key]
