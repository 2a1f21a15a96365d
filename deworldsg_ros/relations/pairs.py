"""Geometry and votes of all pairs of nodes that may be related, kept up to date."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from sortedcontainers import SortedList

from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import take_first
from deworldsg_ros.graph.pairs import Between, Pair, PairChanges, contradicted
from deworldsg_ros.graph.publication import NEW_A_CALL
from deworldsg_ros.relations.geometry import (
    FEATURES,
    MIN_SHAPE_POINTS,
    SHAPE_POINTS,
    ReachGrid,
    centre_steps,
    in_reach,
    measure,
    pair_features,
    plan_gaps,
    rotation_to_upright,
    upright,
)
from deworldsg_ros.relations.physics import PairInputs, PhysicsModel
from deworldsg_ros.relations.rules import Scene
from deworldsg_ros.relations.states import BELIEF, NEAR, NONE, SHAPE
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.vocabulary import (
    CARRY_ON_TOP,
    FURNITURE,
    OVERHEAD,
    SEATS,
    TABLE_SEATS,
    TABLES,
    TABLES_WITH_SEATS,
)

# Logit of every relation of a pair that is out of reach. The simulated rooms have none there.
APART_LOGIT = -12.0
# The floor is where the lowest objects stand; single nodes may reach below it.
FLOOR_QUANTILE = 0.05
# Steps of the height of the floor, so that it changes seldom.
FLOOR_STEP_M = 0.02
# Steps of the components of the up direction, so that it changes less often: every change means
# that all pairs are judged anew. The error is at most half a degree.
UP_STEP = 0.01
# What is longer is no chair at a table, whatever its class is called: a couch.
MAX_SEAT_M = 1.2
# Pairs in arrays at once, so that a whole map needs no large ones.
AT_ONCE = 1024

_BOTTOM_STEP = FEATURES.index("bottom_over_bottom_m")


def joined(first: Int64, second: Int64 | Iterable[int]) -> Int64:
    """The values of both, ascending, each once. For few values, this is faster than NumPy."""
    values = second.ravel().tolist() if isinstance(second, np.ndarray) else second
    return np.array(sorted({*first.ravel().tolist(), *values}), np.int64)


class PairTable:
    """Follows the pairs of the published nodes of a graph.

    A pair is followed if a frame has shown both nodes, or if they are in reach of each other.

    Args:
        graph: to follow.
        model: judges the geometry of pairs.
        geometry: false = no pair is judged.

    Attributes:
        shapes: (n,) of `SHAPE`, by slot of the node.
        beliefs: (m,) of `BELIEF`, by row of the pair. The table writes what it says of geometry and
            votes; readers write the rest.
        changes: of the pairs of the graph; readers may look at its edges.
        changed_rows: rows of the pairs that were judged, or are followed no more, since the reader
            emptied it.
        changed_slots: slots of the nodes whose shape or classes changed, or that lost a pair; some
            may be free, or not published.
        gone: ids of the pairs that have left the graph, since the reader emptied it.
        floor_m: height of the floor in the upright frame.
        begun: whether all nodes are measured, since the beginning or since up turned in a large
            graph: only then pairs are judged, because it needs the floor.
    """

    def __init__(self, graph: GlobalGraph, model: PhysicsModel, *, geometry: bool) -> None:
        self.shapes: NDArray[np.void] = np.zeros(64, SHAPE)
        self.beliefs: NDArray[np.void] = np.zeros(64, BELIEF)
        self.changes: PairChanges = graph.pairs.watch()
        self.changed_rows: set[int] = set()
        self.changed_slots: set[int] = set()
        self.gone: list[Pair] = []
        self.floor_m = 0.0
        self.begun = False
        self._graph = graph
        self._geometry = geometry
        self._model = model
        self._learn_classes()
        self._R_up_world, self._up = np.eye(3), [0.0, 0.0, 1.0]
        self._up_world: Float64 | None = None
        self._touched = graph.watch_nodes()
        # Published nodes that changed since they were measured.
        self._stale: dict[int, None] = {}
        # Number of nodes with a shape.
        self._published = 0
        self._grid = ReachGrid()
        self._bottoms: SortedList = SortedList()
        # Rows that wait to be judged, first those of pairs that never were. A row may have another
        # pair by now, or wait no more.
        self._new: deque[int] = deque()
        self._again: deque[int] = deque()

    def _learn_classes(self) -> None:
        """Follow the vocabulary of the graph."""
        names = self._known_names = self._graph.vocabulary.classes
        self._inputs = PairInputs(names)
        self._on_top = np.array([name in CARRY_ON_TOP for name in names], np.bool_)
        sets = OVERHEAD, FURNITURE - SEATS, TABLES, SEATS
        self._over = np.array([[name in classes for name in names] for classes in sets], np.bool_)
        seating = [[name in TABLES_WITH_SEATS, name in TABLE_SEATS] for name in names]
        self._seating = np.array(seating, np.float64)

    @property
    def scene(self) -> Scene:
        """The arrays as the rules take them."""
        pairs = self._graph.pairs
        return Scene(self.shapes, pairs.firsts, pairs.rows, self.beliefs)

    @property
    def pairs_waiting(self) -> int:
        """Number of pairs that wait to be judged."""
        return len(self._new) + len(self._again)

    @property
    def nodes_waiting(self) -> int:
        """Number of nodes that wait to be measured."""
        return len(self._stale)

    def known_rows(self, slots: Sequence[int] | Int64) -> Int64:
        """Rows of the pairs of nodes that were judged, ascending."""
        rows = self._graph.pairs.of(slots)
        known: Int64 = rows[self.beliefs["known"][rows]]
        return known

    def between(self, rows: Int64) -> tuple[Between, Bool]:
        """Geometry (m,) of pairs, the first node to the second; and which are in reach, (m,) bool.

        In whole centimetres, so that a tiny change makes no new message.
        """
        beliefs, (one, other) = self.beliefs, self.shapes[self._graph.pairs.rows["slots"][rows].T]
        near = beliefs["judged"][rows] & np.isfinite(beliefs["gap_m"][rows])
        gaps = np.maximum(plan_gaps(one, other), 0.0)
        steps = one["low"][:, 2] - other["high"][:, 2], other["low"][:, 2] - one["high"][:, 2]
        return Between(*(np.rint(100.0 * values) / 100.0 + 0.0 for values in (gaps, *steps))), near

    def contradicted(self, rows: Int64) -> Bool:
        """Which relations the geometry of pairs contradicts, (m, 2, NONE), by direction.

        Out of reach, nothing touches.
        """
        between, near = self.between(rows)
        on_top = self._on_top[self.classes(rows)]
        there = contradicted(between, on_top[:, 1])
        back = contradicted(Between(between[0], between[2], between[1]), on_top[:, 0])
        apart = self.beliefs["judged"][rows, None, None] & (np.arange(NONE) != NEAR)
        both = np.stack([there, back], axis=1)
        return np.asarray(np.where(near[:, None, None], both, apart))

    def rated_above(self, rows: Int64) -> Bool:
        """Whether the embedded relation head rates "above" for the classes of pairs, (m, 2).

        By which end would be above. Where it does not, as for seats, its silence says nothing.
        """
        classes = self.classes(rows)
        overhead, below, tables, seats = self._over[:, classes]
        return np.asarray((overhead & below[:, ::-1]) | (tables & ~seats[:, ::-1]))

    def classes(self, rows: Int64) -> Int64:
        """The most probable class (k, 2) of both nodes of pairs."""
        found: Int64 = self.shapes["best_class"][self._graph.pairs.rows["slots"][rows]]
        return found

    def refresh(
        self, up_world: Float64, at_most: int | None = None, nodes_at_most: int | None = None
    ) -> None:
        """Follow the graph: its nodes, their surfaces and classes, and the votes.

        Args:
            up_world: (3,) direction that points up in the world frame; it is used in `UP_STEP`s.
            at_most: number of pairs to judge, new ones first, then those that wait longest. The
                others wait for the next call. None = all.
            nodes_at_most: number of nodes to measure, those that wait longest first. None = all.
        """
        if self._known_names is not self._graph.vocabulary.classes:
            self._learn_classes()
        self._make_room()
        self._follow_gone()
        self._find(self._follow_nodes(up_world, nodes_at_most))
        self._wait(np.array(sorted(self.changes.votes), np.int64))
        self.changes.votes.clear()
        floor_m = floor_height(self._bottoms)
        if floor_m != self.floor_m:
            self.floor_m = floor_m
            self.changed_slots.update(np.flatnonzero(self.shapes["node_id"]).tolist())
            known = self.beliefs["known"] & np.isfinite(self.beliefs["gap_m"])
            self._wait(np.flatnonzero(known), moved=True)
        self.begun = self.begun or not self._stale
        if self.begun:
            self._judge(self._take(at_most))

    def _make_room(self) -> None:
        """As many shapes as slots, and beliefs as rows."""
        wanted = len(self._graph.nodes.ids), len(self._graph.pairs.rows)
        for name, count in zip(("shapes", "beliefs"), wanted):
            known = getattr(self, name)
            if len(known) < count:
                larger = np.zeros(max(count, 2 * len(known)), known.dtype)
                larger[: len(known)] = known
                setattr(self, name, larger)

    def _follow_nodes(self, up_world: Float64, at_most: int | None) -> Int64:
        """Measure nodes that changed, and forget those that went; returns slots."""
        nodes = self._graph.nodes
        slot_of, confirmed = nodes.slot_of, nodes.confirmed
        for node_id, slot in sorted(self._touched.items()):
            if node_id in slot_of and confirmed[slot]:
                self._stale[node_id] = None
                continue
            self._stale.pop(node_id, None)
            if self.shapes["node_id"][slot] == node_id:
                self._forget(slot)
        self._touched.clear()
        # A turn waits until the one before is done: up that always turns would stop all updates.
        may_turn = self.begun or at_most is None or not self._published
        if may_turn and self._turn(up_world) and self._published:
            # Pairs are judged when all shapes are in one frame: now, or after some calls.
            ids = self.shapes["node_id"]
            self._stale.update(dict.fromkeys(ids[ids > 0].tolist()))
            if at_most is None or len(self._stale) <= NEW_A_CALL:
                at_most = None
            else:
                self.begun = False
        changed = take_first(self._stale, at_most)
        slots = nodes.slots_of(changed)
        self._measure(slots)
        return slots

    def _turn(self, up_world: Float64) -> bool:
        """Follow the up direction; true if it has made a step."""
        if up_world is self._up_world:  # the estimate is seldom another one
            return False
        self._up_world, stepped = up_world, stepped_up(up_world)
        if stepped.tolist() == self._up:
            return False
        self._up, self._R_up_world = stepped.tolist(), rotation_to_upright(stepped)
        return True

    def _measure(self, slots: Int64) -> None:
        """Take in the shapes and classes of nodes."""
        if not len(slots):
            return
        shapes, nodes = self.shapes, self._graph.nodes
        new = slots[shapes["node_id"][slots] == 0]
        shapes["node_id"][slots] = nodes.ids[slots]
        for slot in slots.tolist():
            self._forget_bottom(slot)
        surfaces = nodes.surface_points_world, nodes.surface_counts
        measure(shapes, slots, *surfaces, self._R_up_world)
        classes = self._classes(slots)
        seating = classes @ self._seating > 0.5
        seating[:, 1] &= (shapes["high"] - shapes["low"])[slots, :2].max(axis=1) <= MAX_SEAT_M
        shapes["seating"][slots] = seating
        best = classes.argmax(axis=1)
        differ = slots[shapes["best_class"][slots] != best]
        shapes["best_class"][slots] = best
        for slot in slots.tolist():
            shape = shapes[slot]
            if shape["count"] >= MIN_SHAPE_POINTS:
                self._bottoms.add(float(shape["low"][2]))
                self._grid.put(slot, shape["low"], shape["high"])
            else:
                self._grid.remove(slot)
        # Votes on nodes that are published from now on count.
        if len(new):
            pairs = self._graph.pairs
            rows = pairs.of(new)
            self._wait(rows[pairs.rows["shown"][rows] > 0])
            self._published += len(new)
        if len(differ):
            self._wait(self.known_rows(differ))
        self.changed_slots.update(slots.tolist())

    def _forget(self, slot: int) -> None:
        """Forget a node that is not published any more, and its pairs."""
        pairs = self._graph.pairs
        if self.shapes["node_id"][slot] == self._graph.nodes.ids[slot]:
            self._unfollow(pairs.of([slot]))
        self._forget_bottom(slot)
        self._grid.remove(slot)
        self.shapes[slot] = np.zeros((), SHAPE)
        self._published -= 1
        self.changed_slots.discard(slot)

    def _unfollow(self, rows: Int64) -> None:
        """Forget what is known of pairs; their nodes count as changed."""
        pairs, beliefs = self._graph.pairs, self.beliefs
        known = rows[beliefs["known"][rows]]
        self.changed_rows.update(known.tolist())
        self.changed_slots.update(pairs.rows["slots"][known].ravel().tolist())
        said = beliefs["said"][rows]
        beliefs[rows] = np.zeros((), BELIEF)
        beliefs["said"][rows] = said  # until its reader has taken it back
        pairs.release(rows)
        self._follow_gone()

    def _follow_gone(self) -> None:
        """Forget the pairs that have left the graph. Their rows may have other pairs by now."""
        slot_of = self._graph.nodes.slot_of
        for row, ids in self.changes.gone:
            self.beliefs[row] = np.zeros((), BELIEF)
            self.changed_rows.add(row)
            self.changed_slots.update(slot_of[node_id] for node_id in ids if node_id in slot_of)
            self.gone.append(ids)
        self.changes.gone.clear()

    def _forget_bottom(self, slot: int) -> None:
        if self.shapes["count"][slot] >= MIN_SHAPE_POINTS:
            self._bottoms.remove(float(self.shapes["low"][slot, 2]))

    def _classes(self, slots: Int64) -> Float64:
        graph = self._graph
        return graph.edits.believed_classes(graph.nodes, graph.vocabulary, slots)

    def _find(self, slots: Int64) -> None:
        """Let the pairs wait whose geometry changed with these nodes."""
        if not self._geometry or not len(slots):
            return
        pairs, shapes = self._graph.pairs, self.shapes
        near = pairs.ensure(self._grid.pairs(slots, shapes))
        pairs.hold(near)
        self._make_room()
        # Those that were in reach, and may be no more; and those with too few points until now.
        rows = self.known_rows(slots)
        differ = self.beliefs["judged"][rows] != self._are_solid(rows)
        others = rows[differ | np.isfinite(self.beliefs["gap_m"][rows])]
        self._wait(np.concatenate([near, others]), moved=True)

    def _are_solid(self, rows: Int64) -> Bool:
        """Whether (k,) both nodes of pairs have enough points."""
        counts = self.shapes["count"][self._graph.pairs.rows["slots"][rows]]
        solid: Bool = (counts >= MIN_SHAPE_POINTS).all(axis=1)
        return solid

    def _wait(self, rows: Int64, moved: bool = False) -> None:
        """Let pairs wait to be judged. Those of a node that is not published count when it is.

        Args:
            rows: of the pairs; some may be there twice.
            moved: they have another geometry.
        """
        if not len(rows):
            return
        slots, beliefs = self._graph.pairs.rows["slots"][rows], self.beliefs
        rows = rows[(self.shapes["node_id"][slots] > 0).all(axis=1)]
        waiting = rows[~beliefs["waits"][rows]].tolist()
        beliefs["waits"][rows] = True
        if moved:
            beliefs["moved"][rows] = True
        known = beliefs["known"]
        for row in dict.fromkeys(waiting):
            (self._again if known[row] else self._new).append(row)

    def _take(self, at_most: int | None) -> Int64:
        """The rows to judge now."""
        due: list[int] = []
        waits = self.beliefs["waits"]
        for queue in (self._new, self._again):
            while queue and (at_most is None or len(due) < at_most):
                row = queue.popleft()
                if waits[row]:
                    waits[row] = False
                    due.append(row)
        return np.array(due, np.int64)

    def _judge(self, rows: Int64) -> None:
        """Judge the geometry of pairs; those that are not related and were not seen are left."""
        if not len(rows):
            return
        pairs, beliefs = self._graph.pairs, self.beliefs
        beliefs["gap_m"][rows[~beliefs["known"][rows]]] = np.inf
        if self._geometry:
            moved = beliefs["moved"][rows]
            slots = pairs.rows["slots"][rows].astype(np.int64)
            near = np.zeros(len(rows), np.bool_)
            near[moved] = in_reach(slots[moved], self.shapes)
            self._set_apart(rows[~near & (moved | ~beliefs["known"][rows])])
            for start in range(0, int(near.sum()), AT_ONCE):
                part = slice(start, start + AT_ONCE)
                self._judge_near(rows[near][part], slots[near][part])
        beliefs["moved"][rows], beliefs["known"][rows] = False, True
        self.changed_rows.update(rows.tolist())
        idle = ~(beliefs["judged"][rows] & np.isfinite(beliefs["gap_m"][rows]))
        idle &= pairs.rows["shown"][rows] == 0
        if idle.any():
            self._unfollow(rows[idle])

    def _set_apart(self, rows: Int64) -> None:
        """Pairs that are out of reach are not related."""
        beliefs = self.beliefs
        beliefs["judged"][rows] = self._are_solid(rows)
        beliefs["state_logits"][rows] = APART_LOGIT
        beliefs["state_logits"][rows, 0] = 0.0
        beliefs["gap_m"][rows] = np.inf

    def _judge_near(self, rows: Int64, slots: Int64) -> None:
        """Judge pairs in reach, with slots (k, 2), by their surfaces."""
        nodes, beliefs = self._graph.nodes, self.beliefs
        used = joined(slots, ())
        first, second = np.searchsorted(used, slots.T)
        shapes = self.shapes.take(used)
        points = upright(nodes.surface_points_world[used, :SHAPE_POINTS], self._R_up_world)
        features = pair_features(first, second, shapes, points, self.floor_m)
        known = self._classes(used), nodes.observations[used]
        both = np.concatenate((first, second)), np.concatenate((second, first))
        inputs = self._inputs.make(features.reshape(2 * len(rows), -1), *known, *both)
        beliefs["state_logits"][rows] = self._model.states_of(inputs)
        beliefs["judged"][rows] = True
        beliefs["gap_m"][rows] = plan_gaps(shapes[first], shapes[second])
        beliefs["bottom_step_m"][rows] = features[0, :, _BOTTOM_STEP]
        beliefs["centre_step_m"][rows] = centre_steps(shapes, first, second)


def floor_height(bottoms_m: Sequence[float]) -> float:
    """Height of the floor, metres, from the ascending heights of the bottoms of all objects."""
    if not len(bottoms_m):
        return 0.0
    place = FLOOR_QUANTILE * (len(bottoms_m) - 1)
    lower = bottoms_m[int(place)]
    upper = bottoms_m[min(int(place) + 1, len(bottoms_m) - 1)]
    height = lower + (upper - lower) * (place - int(place))
    return round(height / FLOOR_STEP_M) * FLOOR_STEP_M


def stepped_up(up_world: Float64) -> Float64:
    """The direction (3,) `up_world` with components in steps of `UP_STEP`, not of unit length.

    The axes of the world stay as they are.
    """
    return np.round(up_world / np.linalg.norm(up_world) / UP_STEP) * UP_STEP
