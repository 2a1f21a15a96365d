"""Geometry and votes of all pairs of nodes that may be related, kept up to date."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
from sortedcontainers import SortedList

from deworldsg_ros.relations.pair_geometry import (
    FEATURES,
    SHAPE_POINTS,
    NodeShapes,
    pair_features,
    rotation_to_upright,
    upright,
)
from deworldsg_ros.relations.pair_links import link, move_object, move_pair, pairs_of, unlink
from deworldsg_ros.relations.physical_states import NONE, STATE_COUNT, relation_of_predicates
from deworldsg_ros.relations.physics_model import PairInputs, PhysicsModel
from deworldsg_ros.relations.reach import MIN_SHAPE_POINTS, ReachGrid, in_reach
from deworldsg_ros.relations.vote_model import relation_counts
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.columns import Columns
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.votes import PairVotes

# The floor is where the lowest objects stand; single nodes may reach below it.
FLOOR_QUANTILE = 0.05
# Steps of the height of the floor, so that it changes seldom.
FLOOR_STEP_M = 0.02
# Steps of the components of the up direction, so that it changes less often: every change means
# that all pairs are judged anew. The error is at most half a degree.
UP_STEP = 0.01
# Logit of every relation of a pair that is out of reach. The simulated rooms have none there.
APART_LOGIT = -12.0
NO_VOTES = PairVotes(0, None, 0)
_GAP, _BOTTOM_STEP = FEATURES.index("gap_m"), FEATURES.index("bottom_over_bottom_m")


class PublishedNodes(NodeShapes):
    """The shapes of the published nodes, and what beliefs keep of each.

    Attributes:
        best_classes: (n,) int64, the class of the highest probability.
        first_links: (n,) int64; see `pair_links`.
        floor_odds, on_floor, totals, shares, marks: see `settling`.
    """

    best_classes: Int64
    first_links: Int64
    floor_odds: Float64
    on_floor: Float64
    totals: Float64
    shares: Float64
    marks: Bool

    def __init__(self) -> None:
        super().__init__(
            {
                "best_classes": (np.int64, ()),
                "first_links": (np.int64, ()),
                "floor_odds": (np.float64, ()),
                "on_floor": (np.float64, ()),
                "totals": (np.float64, ()),
                "shares": (np.float64, ()),
                "marks": (np.bool_, ()),
            }
        )


class PairTable(Columns):
    """Pairs of nodes, the smaller id first; a row's id is `key` of the pair.

    Attributes:
        nodes: (m, 2) int64 ids.
        ends: (m, 2) int64 rows of `shapes`.
        links: (m, 2) int64; see `pair_links`.
        judged: (m,) bool; both nodes have enough points.
        state_logits: (m, STATE_COUNT) of the physical model, where judged.
        gaps_m: (m,) horizontal gap of the bounds; infinite out of reach.
        bottom_steps_m: (m,) difference of the heights of the bottoms, where in reach.
        centre_steps_m: (m,) horizontal distance of the centres of the bounds, where in reach.
        frames: (m,) number of frames that showed both nodes.
        counts: (m, 2, NONE) of `relation_counts` in both directions.
        other_votes: (m,) most votes on a predicate that names no physical relation.
        states, carried, kept, near, near_votes, by_votes, relations, eligible, close, with_, live:
            what `RobustBeliefs` keeps of each pair.
        shapes: the nodes that are published.
        changed_pairs: keys of the pairs that changed or went, since the reader emptied it.
        changed_nodes: ids of the nodes whose shape or classes changed, or that lost a pair.
    """

    nodes: Int64
    ends: Int64
    links: Int64
    judged: Bool
    state_logits: Float64
    gaps_m: Float64
    bottom_steps_m: Float64
    centre_steps_m: Float64
    frames: Float64
    counts: Float64
    other_votes: Float64
    states: Float64
    carried: Float64
    kept: Float64
    near: Float64
    near_votes: Float64
    by_votes: Float64
    relations: Float64
    eligible: Bool
    close: Bool
    with_: Bool
    live: Bool

    def __init__(self, graph: SceneGraph, model: PhysicsModel, *, geometry: bool) -> None:
        super().__init__(
            {
                "nodes": (np.int64, (2,)),
                "ends": (np.int64, (2,)),
                "links": (np.int64, (2,)),
                "judged": (np.bool_, ()),
                "state_logits": (np.float64, (STATE_COUNT,)),
                "gaps_m": (np.float64, ()),
                "bottom_steps_m": (np.float64, ()),
                "centre_steps_m": (np.float64, ()),
                "frames": (np.float64, ()),
                "counts": (np.float64, (2, NONE)),
                "other_votes": (np.float64, ()),
                "states": (np.float64, (STATE_COUNT,)),
                "carried": (np.float64, (2,)),
                "kept": (np.float64, (2,)),
                "near": (np.float64, ()),
                "near_votes": (np.float64, ()),
                "by_votes": (np.float64, ()),
                "relations": (np.float64, (2, NONE + 1)),
                "eligible": (np.bool_, ()),
                "close": (np.bool_, (2,)),
                "with_": (np.bool_, (2,)),
                "live": (np.bool_, ()),
            }
        )
        self.shapes = PublishedNodes()
        self.floor_m = 0.0
        self.changed_pairs: set[int] = set()
        self.changed_nodes: set[int] = set()
        self._graph = graph
        self._model = model
        self._geometry = geometry
        self._inputs = PairInputs(graph.vocabulary.classes)
        self._relation_of = relation_of_predicates(graph.vocabulary.predicates)
        self._R_up_world = np.eye(3)
        self._touched = graph.watch_nodes()
        self._grid = ReachGrid()
        self._bottoms: SortedList = SortedList()
        # Keys of the pairs that wait to be judged: those that never were, and the others; and which
        # of them have another geometry since.
        self._new: dict[int, None] = {}
        self._waiting: dict[int, None] = {}
        self._moved: set[int] = set()

    @property
    def waiting(self) -> int:
        """Number of pairs that wait to be judged."""
        return len(self._new) + len(self._waiting)

    def refresh(self, up_world: Float64, at_most: int | None = None) -> None:
        """Follow the graph: its nodes, their surfaces and classes, and the votes.

        Args:
            up_world: (3,) direction that points up in the world frame; it is used in `UP_STEP`s.
            at_most: number of pairs to judge, new ones first, then those that wait longest. The
                others wait for the next call. None = all.
        """
        self._find(self._follow_nodes(up_world))
        self._wait(key(*pair) for pair in self._graph.take_changed_votes())
        floor_m = floor_height(self._bottoms)
        if floor_m != self.floor_m:
            self.floor_m = floor_m
            self.changed_nodes.update(self.shapes.ids.tolist())
            self._move(self.ids[np.isfinite(self.gaps_m)].tolist())
        waiting = itertools.chain(list(self._new), list(self._waiting))
        keys = list(itertools.islice(waiting, at_most))
        if keys:
            self._judge(keys)

    def _wait(self, keys: Iterable[int]) -> None:
        for pair_key in keys:
            (self._waiting if pair_key in self else self._new)[pair_key] = None

    def _move(self, keys: Sequence[int]) -> None:
        """Note pairs that have another geometry."""
        self._moved.update(keys)
        self._wait(keys)

    def rows_of(self, ids: Iterable[int]) -> Int64:
        """Rows of the pairs of nodes; nodes that are not published have none."""
        shapes = self.shapes
        items = np.array([shapes.row(i) for i in ids if i in shapes], np.int64)
        return pairs_of(shapes.first_links, self.links, items)

    def _follow_nodes(self, up_world: Float64) -> list[int]:
        """Measure the nodes that changed, and forget those that went; returns ids."""
        turned = rotation_to_upright(stepped_up(up_world))
        if not np.array_equal(turned, self._R_up_world):
            self._R_up_world = turned
            self._touched.update(self.shapes.ids.tolist())
        nodes = self._graph.nodes
        changed = []
        for node_id in sorted(self._touched):
            if node_id in nodes and nodes.confirmed[nodes.row(node_id)]:
                changed.append(node_id)
            elif node_id in self.shapes:
                self._forget(node_id)
        self._touched.clear()
        self._measure(changed)
        return changed

    def _measure(self, node_ids: list[int]) -> None:
        """Take in the shapes and classes of nodes."""
        if not node_ids:
            return
        shapes, nodes = self.shapes, self._graph.nodes
        rows = np.array([nodes.row(node_id) for node_id in node_ids], np.int64)
        new = [node_id for node_id in node_ids if node_id not in shapes]
        shapes.extend(new)
        at = np.array([shapes.row(node_id) for node_id in node_ids], np.int64)
        for shape in at.tolist():
            self._forget_bottom(shape)
        counts = nodes.surface_counts[rows]
        shapes.put(at, nodes.surface_points_world[rows], counts, self._R_up_world)
        best = nodes.class_probabilities[rows].argmax(axis=1)
        differs = np.flatnonzero(shapes.best_classes[at] != best).tolist()
        shapes.best_classes[at] = best
        for shape in at.tolist():
            if shapes.counts[shape] >= MIN_SHAPE_POINTS:
                self._bottoms.add(float(shapes.low[shape, 2]))
                self._grid.put(shape, shapes.low[shape], shapes.high[shape])
            else:
                self._grid.remove(shape)
        self._came(new)
        others = self.rows_of([node_ids[index] for index in differs])
        self._wait(self.ids[others].tolist())
        self.changed_nodes.update(node_ids)

    def _came(self, node_ids: list[int]) -> None:
        """Count the votes on nodes that are published from now on."""
        for node_id in node_ids:
            partners = self._graph.seen_together(node_id)
            self._wait(key(min(node_id, other), max(node_id, other)) for other in partners)

    def _forget(self, node_id: int) -> None:
        """Forget a node that is not published any more, and its pairs."""
        shapes = self.shapes
        row, last = shapes.row(node_id), len(shapes) - 1
        for pair_key in self.ids[self.rows_of([node_id])].tolist():
            self._forget_pair(pair_key)
        self._forget_bottom(row)
        self._grid.remove(row)
        if row != last:
            self._grid.move(last, row)
            move_object(shapes.first_links, self.links, self.ends, last, row)
        shapes.remove(node_id)
        self.changed_nodes.discard(node_id)

    def _forget_bottom(self, shape: int) -> None:
        if self.shapes.counts[shape] >= MIN_SHAPE_POINTS:
            self._bottoms.remove(float(self.shapes.low[shape, 2]))

    def _forget_pair(self, pair_key: int) -> None:
        row, last = self.row(pair_key), len(self) - 1
        self.changed_nodes.update(self.nodes[row].tolist())
        self.changed_pairs.add(pair_key)
        unlink(self.shapes.first_links, self.links, self.ends, row)
        if row != last:
            move_pair(self.shapes.first_links, self.links, self.ends, last, row)
        self.remove(pair_key)

    def _find(self, changed: list[int]) -> None:
        """Note the pairs whose geometry changed with these nodes."""
        if not self._geometry or not changed:
            return
        shapes = self.shapes
        at = np.array([shapes.row(node_id) for node_id in changed], np.int64)
        ends = shapes.ids[self._grid.pairs(at, shapes.low, shapes.high, shapes.counts)]
        self._move(key(ends.min(axis=1), ends.max(axis=1)).tolist())
        # Those that were in reach, and may be no more; and those with too few points until now.
        rows = pairs_of(shapes.first_links, self.links, at)
        solid = (shapes.counts[self.ends[rows]] >= MIN_SHAPE_POINTS).all(axis=1)
        self._move(
            self.ids[rows[(self.judged[rows] != solid) | np.isfinite(self.gaps_m[rows])]].tolist()
        )

    def _judge(self, keys: list[int]) -> None:
        """Take in what is known of pairs now; those without any evidence go."""
        shapes = self.shapes
        moved = [pair_key in self._moved for pair_key in keys]
        self._moved.difference_update(keys)
        for pair_key in keys:
            self._new.pop(pair_key, None)
            self._waiting.pop(pair_key, None)
        known = [ends_of(one)[0] in shapes and ends_of(one)[1] in shapes for one in keys]
        moved = [has for has, is_known in zip(moved, known) if is_known]
        keys = list(itertools.compress(keys, known))
        if not keys:
            return
        rows = self._rows_of(keys)
        self._count(rows, keys)
        if self._geometry:
            again = rows[moved]
            near = in_reach(self.ends[again], shapes.low, shapes.high, shapes.counts)
            self._set_apart(again[~near])
            self._judge_near(again[near])
        self.changed_pairs.update(keys)
        idle = (self.frames[rows] == 0) & ~(self.judged[rows] & np.isfinite(self.gaps_m[rows]))
        for pair_key in self.ids[rows[idle]].tolist():
            self._forget_pair(pair_key)

    def _judge_near(self, rows: Int64) -> None:
        """Judge pairs in reach by their geometry."""
        if not len(rows):
            return
        used, places = np.unique(self.ends[rows], return_inverse=True)
        first, second = np.ascontiguousarray(places.reshape(-1, 2).T)
        shapes, nodes = self.shapes, self._graph.nodes
        low, high = shapes.low[used], shapes.high[used]
        node_rows = [nodes.row(node_id) for node_id in shapes.ids[used].tolist()]
        points = nodes.surface_points_world[node_rows, :SHAPE_POINTS]
        there, back = pair_features(
            first,
            second,
            low,
            high,
            shapes.means[used],
            shapes.covariances[used],
            shapes.counts[used],
            upright(points, self._R_up_world),
            self.floor_m,
        )
        known = (nodes.class_probabilities[node_rows], nodes.observations[node_rows])
        self.state_logits[rows] = self._model.state_logits(
            self._inputs.make(there, *known, first, second),
            self._inputs.make(back, *known, second, first),
        )
        self.judged[rows] = True
        self.gaps_m[rows] = there[:, _GAP]
        self.bottom_steps_m[rows] = there[:, _BOTTOM_STEP]
        centres = (low[:, :2] + high[:, :2]) / 2.0
        self.centre_steps_m[rows] = np.linalg.norm(centres[first] - centres[second], axis=1)

    def _set_apart(self, rows: Int64) -> None:
        """Pairs that are out of reach are not related."""
        self.judged[rows] = (self.shapes.counts[self.ends[rows]] >= MIN_SHAPE_POINTS).all(axis=1)
        self.state_logits[rows] = APART_LOGIT
        self.state_logits[rows, 0] = 0.0
        self.gaps_m[rows] = np.inf

    def _count(self, rows: Int64, keys: list[int]) -> None:
        """Take in the votes on pairs."""
        votes = self._graph.votes
        found = [votes.get(ends_of(pair_key), NO_VOTES) for pair_key in keys]
        counts = np.zeros((len(rows), 2, len(self._relation_of)))
        for index, pair in enumerate(found):
            if pair.counts is not None:
                counts[index] = pair.counts
        self.frames[rows] = [pair.frames for pair in found]
        self.counts[rows] = relation_counts(counts, self._relation_of)
        others = counts[:, :, self._relation_of < 0]
        self.other_votes[rows] = others.max(axis=(1, 2), initial=0.0)

    def _rows_of(self, keys: Sequence[int]) -> Int64:
        """Rows of the pairs with these keys; missing ones are added."""
        new = [pair_key for pair_key in keys if pair_key not in self]
        if new:
            shapes = self.shapes
            self.extend(new)
            added = np.arange(len(self) - len(new), len(self))
            self.nodes[added] = pairs = [ends_of(pair_key) for pair_key in new]
            self.ends[added] = [[shapes.row(first), shapes.row(second)] for first, second in pairs]
            self.gaps_m[added] = np.inf
            for row in added.tolist():
                link(shapes.first_links, self.links, self.ends, row)
            if self._geometry:
                self._set_apart(added)
        return np.array([self.row(pair_key) for pair_key in keys], np.int64)


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


Ids = TypeVar("Ids", int, Int64)


def key(first: Ids, second: Ids) -> Ids:
    """One number for a pair of ids, the smaller first."""
    return first << 31 | second


def ends_of(pair_key: int) -> tuple[int, int]:
    """The two ids of a `key`."""
    return pair_key >> 31, pair_key & 0x7FFFFFFF
