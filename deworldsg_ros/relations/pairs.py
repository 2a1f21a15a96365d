"""Geometry and votes of all pairs of nodes that may be related, kept up to date."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import filterfalse

import numpy as np
from sortedcontainers import SortedList

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.graph.messages import take_first
from deworldsg_ros.graph.pairs import ends_of, key
from deworldsg_ros.graph.publication import NEW_A_CALL
from deworldsg_ros.relations.geometry import (
    FEATURES,
    SHAPE_POINTS,
    NodeShapes,
    centre_steps,
    pair_features,
    rotation_to_upright,
    upright,
)
from deworldsg_ros.relations.physics import PairInputs, PhysicsModel, count_votes
from deworldsg_ros.relations.reach import MIN_SHAPE_POINTS, ReachGrid, in_reach, known_reach
from deworldsg_ros.relations.states import NONE, STATE_COUNT, relation_of_predicates
from deworldsg_ros.scene.arrays import Bool, Columns, Float64, Int64
from deworldsg_ros.scene.vocabulary import SEATS, TABLES

# --- The pairs of each object, as lists that are linked through arrays.
#
# `first_links` (n,) and `links` (m, 2) hold places: 2 · row + end + 1 of a pair's end, 0 = none.
# `ends` (m, 2) are the rows of the two objects of each pair.


def joined(first: Int64, second: Int64 | list[int]) -> Int64:
    """The values of both, ascending, each once. For few values, this is faster than NumPy."""
    values = second if isinstance(second, list) else second.ravel().tolist()
    return np.array(sorted({*first.ravel().tolist(), *values}), np.int64)


@kernel
def link(first_links: Int64, links: Int64, ends: Int64, row: int) -> None:
    """Enter a pair in the lists of both its objects."""
    for end in range(2):
        links[row, end] = first_links[ends[row, end]]
        first_links[ends[row, end]] = 2 * row + end + 1


@kernel
def unlink(first_links: Int64, links: Int64, ends: Int64, row: int) -> None:
    """Take a pair out of the lists of both its objects."""
    for end in range(2):
        _replace(first_links, links, ends[row, end], 2 * row + end + 1, links[row, end])


@kernel
def move_pair(first_links: Int64, links: Int64, ends: Int64, row: int, to: int) -> None:
    """Let the lists name another row for a pair. The arrays themselves stay."""
    for end in range(2):
        _replace(first_links, links, ends[row, end], 2 * row + end + 1, 2 * to + end + 1)


@kernel
def _replace(first_links: Int64, links: Int64, item: int, old: int, new: int) -> None:
    place = first_links[item]
    if place == old:
        first_links[item] = new
        return
    while links[(place - 1) >> 1, (place - 1) & 1] != old:
        place = links[(place - 1) >> 1, (place - 1) & 1]
    links[(place - 1) >> 1, (place - 1) & 1] = new


@kernel
def move_object(first_links: Int64, links: Int64, ends: Int64, row: int, to: int) -> None:
    """Let the pairs of an object name another row for it."""
    place = first_links[row]
    while place:
        ends[(place - 1) >> 1, (place - 1) & 1] = to
        place = links[(place - 1) >> 1, (place - 1) & 1]


@kernel
def pairs_of(first_links: Int64, links: Int64, items: Int64) -> Int64:
    """Rows of the pairs of objects (k,), ascending, each once."""
    count = 0
    for item in items:
        place = first_links[item]
        while place:
            count += 1
            place = links[(place - 1) >> 1, (place - 1) & 1]
    rows = np.empty(count, np.int64)
    count = 0
    for item in items:
        place = first_links[item]
        while place:
            rows[count] = (place - 1) >> 1
            count += 1
            place = links[(place - 1) >> 1, (place - 1) & 1]
    rows.sort()
    kept = 0
    for index in range(count):
        if kept == 0 or rows[index] != rows[kept - 1]:
            rows[kept] = rows[index]
            kept += 1
    return rows[:kept]


# --- The rows of the pairs of nodes, and of the nodes themselves.

# Logit of every relation of a pair that is out of reach. The simulated rooms have none there.
APART_LOGIT = -12.0


class PublishedNodes(NodeShapes):
    """The shapes of the published nodes, and what beliefs keep of each.

    Attributes:
        best_classes: (n,) int64, the class of the highest probability.
        seating: (n, 2) bool, whether it is a table, and a seat.
        first_links: (n,) int64; see `pair_links`.
        floor_odds, on_floor, totals, shares, marks: see `settling`.
    """

    best_classes: Int64
    seating: Bool
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
                "seating": (np.bool_, (2,)),
                "first_links": (np.int64, ()),
                "floor_odds": (np.float64, ()),
                "on_floor": (np.float64, ()),
                "totals": (np.float64, ()),
                "shares": (np.float64, ()),
                "marks": (np.bool_, ()),
            }
        )


class PairRows(Columns):
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
            see `SettledRelations`.
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

    def __init__(self) -> None:
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
        self.changed_pairs: set[int] = set()
        self.changed_nodes: set[int] = set()

    def rows_of(self, ids: Iterable[int]) -> Int64:
        """Rows of the pairs of nodes; nodes that are not published have none."""
        shapes = self.shapes
        items = np.array([shapes.row(i) for i in ids if i in shapes], np.int64)
        return pairs_of(shapes.first_links, self.links, items)

    def add(self, keys: Sequence[int]) -> Int64:
        """Rows of the pairs with these keys; missing ones are added, as not judged."""
        known = self.places
        new = [pair_key for pair_key in keys if pair_key not in known]
        if new:
            shapes = self.shapes
            self.extend(new)
            added = np.arange(len(self) - len(new), len(self))
            self.nodes[added] = pairs = [ends_of(pair_key) for pair_key in new]
            self.ends[added] = [[shapes.row(first), shapes.row(second)] for first, second in pairs]
            self.gaps_m[added] = np.inf
            for row in added.tolist():
                link(shapes.first_links, self.links, self.ends, row)
        return self.rows_at(keys)

    def forget_pair(self, pair_key: int) -> None:
        """Remove a pair; its nodes and its key count as changed."""
        row, last = self.row(pair_key), len(self) - 1
        self.changed_nodes.update(self.nodes[row].tolist())
        self.changed_pairs.add(pair_key)
        unlink(self.shapes.first_links, self.links, self.ends, row)
        if row != last:
            move_pair(self.shapes.first_links, self.links, self.ends, last, row)
        self.remove(pair_key)

    def set_apart(self, rows: Int64) -> None:
        """Pairs that are out of reach are not related."""
        self.judged[rows] = (self.shapes.counts[self.ends[rows]] >= MIN_SHAPE_POINTS).all(axis=1)
        self.state_logits[rows] = APART_LOGIT
        self.state_logits[rows, 0] = 0.0
        self.gaps_m[rows] = np.inf


# --- The pairs of nodes that wait to be judged.


class WaitingPairs:
    """Pairs that wait to be judged: those that are not in the table come first.

    Args:
        known: the pairs in the table, by key.
        published: the nodes that are published, by id.
    """

    def __init__(self, known: Mapping[int, int], published: Mapping[int, int]) -> None:
        self._known = known
        self._published = published
        self._new: dict[int, None] = {}
        self._again: dict[int, None] = {}
        # Those that have another geometry.
        self._moved: set[int] = set()

    def __len__(self) -> int:
        return len(self._new) + len(self._again)

    def add(self, keys: Collection[int]) -> None:
        """Let pairs wait. Those with a node that is not published count when it is."""
        # Most are known: a loop of Python is for the others only.
        self._again.update(dict.fromkeys(filter(self._known.__contains__, keys)))
        for pair_key in filterfalse(self._known.__contains__, keys):
            if self._are_published(pair_key):
                self._new[pair_key] = None

    def move(self, keys: Int64) -> None:
        """Let pairs wait that have another geometry."""
        moved = keys.tolist()
        self._moved.update(moved)
        self.add(moved)

    def forget(self, pair_key: int) -> None:
        """A pair has left the table."""
        self._again.pop(pair_key, None)
        self._moved.discard(pair_key)

    def take(self, at_most: int | None) -> tuple[list[int], Bool]:
        """Keys (k,) of the pairs to judge now; and (k,) which have another geometry."""
        due = []
        for pair_key in take_first(self._new, at_most):
            if self._are_published(pair_key):
                due.append(pair_key)
            else:  # a node went since
                self._moved.discard(pair_key)
        due += take_first(self._again, None if at_most is None else at_most - len(due))
        moved = np.array([pair_key in self._moved for pair_key in due], np.bool_)
        self._moved.difference_update(due)
        return due, moved

    def _are_published(self, pair_key: int) -> bool:
        first, second = ends_of(pair_key)
        return first in self._published and second in self._published


# --- What the physical model says of the geometry of pairs.

_GAP, _BOTTOM_STEP = FEATURES.index("gap_m"), FEATURES.index("bottom_over_bottom_m")

# Pairs in arrays at once, so that a whole map needs no large ones.
AT_ONCE = 1024


class GeometryJudge:
    """Judges pairs of nodes by their surfaces.

    Args:
        graph: of the nodes.
        model: the physical model.
    """

    def __init__(self, graph: SceneGraph, model: PhysicsModel) -> None:
        self._graph = graph
        self._model = model
        self._inputs = PairInputs(graph.vocabulary.classes)

    def __call__(self, table: PairRows, rows: Int64, R_up_world: Float64, floor_m: float) -> None:
        """Judge pairs in reach, and write what follows to their columns.

        Args:
            table: of the pairs.
            rows: (k,) of the pairs.
            R_up_world: (3, 3) rotation from the world frame to the upright frame.
            floor_m: height of the floor in the upright frame.
        """
        for start in range(0, len(rows), AT_ONCE):
            self._judge(table, rows[start : start + AT_ONCE], R_up_world, floor_m)

    def _judge(self, table: PairRows, rows: Int64, R_up_world: Float64, floor_m: float) -> None:
        shapes, nodes = table.shapes, self._graph.nodes
        ends = table.ends[rows]
        used = joined(ends, [])
        first, second = np.searchsorted(used, ends.T)
        low, high = shapes.low[used], shapes.high[used]
        node_rows = nodes.slots_of(shapes.ids[used].tolist())
        features = pair_features(
            first,
            second,
            low,
            high,
            shapes.means[used],
            shapes.covariances[used],
            shapes.counts[used],
            upright(nodes.surface_points_world[node_rows, :SHAPE_POINTS], R_up_world),
            floor_m,
        )
        edits, names = self._graph.edits, self._graph.vocabulary
        known = edits.believed_classes(nodes, names, node_rows), nodes.observations[node_rows]
        both = np.concatenate((first, second)), np.concatenate((second, first))
        inputs = self._inputs.make(features.reshape(2 * len(rows), -1), *known, *both)
        table.state_logits[rows] = self._model.states_of(inputs)
        table.judged[rows] = True
        table.gaps_m[rows] = features[0, :, _GAP]
        table.bottom_steps_m[rows] = features[0, :, _BOTTOM_STEP]
        table.centre_steps_m[rows] = centre_steps(first, second, low, high)


# --- Geometry and votes of all pairs of nodes that may be related, kept up to date.

# The floor is where the lowest objects stand; single nodes may reach below it.
FLOOR_QUANTILE = 0.05
# Steps of the height of the floor, so that it changes seldom.
FLOOR_STEP_M = 0.02
# Steps of the components of the up direction, so that it changes less often: every change means
# that all pairs are judged anew. The error is at most half a degree.
UP_STEP = 0.01


class PairTable(PairRows):
    """The pairs of the published nodes of a graph; see `PairRows` for the columns.

    Args:
        graph: to follow.
        model: judges the geometry of pairs.
        geometry: false = no pair is judged.

    Attributes:
        floor_m: height of the floor in the upright frame.
        begun: whether all nodes are measured, since the beginning or since up turned in a large
            graph: only then pairs are judged, because it needs the floor.
    """

    def __init__(self, graph: SceneGraph, model: PhysicsModel, *, geometry: bool) -> None:
        super().__init__()
        self.floor_m = 0.0
        self.begun = False
        self._graph = graph
        self._geometry = geometry
        self._judge_near = GeometryJudge(graph, model)
        names = graph.vocabulary.classes
        self._seating = np.array([[name in TABLES, name in SEATS] for name in names], np.float64)
        self._relation_of = relation_of_predicates(graph.vocabulary.predicates)
        self._R_up_world, self._up = np.eye(3), [0.0, 0.0, 1.0]
        self._up_world: Float64 | None = None
        self._touched = graph.watch_nodes()
        # Published nodes that changed since they were measured.
        self._stale: dict[int, None] = {}
        self._grid = ReachGrid()
        self._bottoms: SortedList = SortedList()
        self._waiting = WaitingPairs(self.places, self.shapes.places)

    @property
    def pairs_waiting(self) -> int:
        """Number of pairs that wait to be judged."""
        return len(self._waiting)

    @property
    def nodes_waiting(self) -> int:
        """Number of nodes that wait to be measured."""
        return len(self._stale)

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
        self._find(self._follow_nodes(up_world, nodes_at_most))
        self._waiting.add(self._graph.take_changed_votes())
        floor_m = floor_height(self._bottoms)
        if floor_m != self.floor_m:
            self.floor_m = floor_m
            self.changed_nodes.update(self.shapes.ids.tolist())
            self._waiting.move(self.ids[np.isfinite(self.gaps_m)])
        self.begun = self.begun or not self._stale
        if not self.begun:
            return
        keys, moved = self._waiting.take(at_most)
        if keys:
            self._judge(keys, moved)

    def _follow_nodes(self, up_world: Float64, at_most: int | None) -> list[int]:
        """Measure nodes that changed, and forget those that went; returns ids."""
        places, confirmed = self._graph.nodes.slot_of, self._graph.nodes.confirmed
        for node_id in sorted(self._touched):
            row = places.get(node_id)
            if row is not None and confirmed[row]:
                self._stale[node_id] = None
            else:
                self._stale.pop(node_id, None)
                if node_id in self.shapes:
                    self._forget(node_id)
        self._touched.clear()
        # A turn waits until the one before is done: up that always turns would stop all updates.
        may_turn = self.begun or at_most is None or not len(self.shapes)
        if may_turn and self._turn(up_world) and len(self.shapes):
            # Pairs are judged when all shapes are in one frame: now, or after some calls.
            self._stale.update(dict.fromkeys(self.shapes.ids.tolist()))
            if at_most is None or len(self._stale) <= NEW_A_CALL:
                at_most = None
            else:
                self.begun = False
        changed = take_first(self._stale, at_most)
        self._measure(changed)
        return changed

    def _turn(self, up_world: Float64) -> bool:
        """Follow the up direction; true if it has made a step."""
        if up_world is self._up_world:  # the estimate is seldom another one
            return False
        self._up_world, stepped = up_world, stepped_up(up_world)
        if stepped.tolist() == self._up:
            return False
        self._up, self._R_up_world = stepped.tolist(), rotation_to_upright(stepped)
        return True

    def _measure(self, node_ids: list[int]) -> None:
        """Take in the shapes and classes of nodes."""
        if not node_ids:
            return
        shapes, nodes = self.shapes, self._graph.nodes
        rows = nodes.slots_of(node_ids)
        new = [node_id for node_id in node_ids if node_id not in shapes]
        shapes.extend(new)
        at = shapes.rows_at(node_ids)
        for shape in at.tolist():
            self._forget_bottom(shape)
        surfaces = nodes.surface_points_world, nodes.surface_counts
        shapes.put(at, *surfaces, rows, self._R_up_world)
        edits, names = self._graph.edits, self._graph.vocabulary
        classes = edits.believed_classes(nodes, names, rows)
        shapes.seating[at] = classes @ self._seating > 0.5
        best = classes.argmax(axis=1)
        differs = (shapes.best_classes[at] != best).nonzero()[0].tolist()
        shapes.best_classes[at] = best
        for shape in at.tolist():
            if shapes.counts[shape] >= MIN_SHAPE_POINTS:
                self._bottoms.add(float(shapes.low[shape, 2]))
                self._grid.put(shape, shapes.low[shape], shapes.high[shape])
            else:
                self._grid.remove(shape)
        self._came(new)
        if differs:
            others = self.rows_of([node_ids[index] for index in differs])
            self._waiting.add(self.ids[others].tolist())
        self.changed_nodes.update(node_ids)

    def _came(self, node_ids: list[int]) -> None:
        """Count the votes on nodes that are published from now on."""
        for node_id in node_ids:
            partners = self._graph.seen_together(node_id)
            self._waiting.add([key(min(node_id, other), max(node_id, other)) for other in partners])

    def _forget(self, node_id: int) -> None:
        """Forget a node that is not published any more, and its pairs."""
        shapes = self.shapes
        row, last = shapes.row(node_id), len(shapes) - 1
        for pair_key in self.ids[self.rows_of([node_id])].tolist():
            self.forget_pair(pair_key)
            self._waiting.forget(pair_key)
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

    def _find(self, changed: list[int]) -> None:
        """Note the pairs whose geometry changed with these nodes."""
        if not self._geometry or not changed:
            return
        shapes = self.shapes
        at = shapes.rows_at(changed)
        first, second = shapes.ids[self._grid.pairs(at, shapes.low, shapes.high, shapes.counts)].T
        self._waiting.move(key(np.minimum(first, second), np.maximum(first, second)))
        # Those that were in reach, and may be no more; and those with too few points until now.
        rows = pairs_of(shapes.first_links, self.links, at)
        known = known_reach(rows, self.ends, self.judged, self.gaps_m, shapes.counts)
        self._waiting.move(self.ids[rows[known]])

    def _judge(self, keys: list[int], moved: Bool) -> None:
        """Take in what is known of pairs now; those without any evidence go."""
        shapes = self.shapes
        known_rows = len(self)
        rows = self.add(keys)
        self._count(rows)
        if self._geometry:
            if len(self) > known_rows:
                self.set_apart(rows[rows >= known_rows])
            again = rows[moved]
            if len(again):
                near = in_reach(self.ends[again], shapes.low, shapes.high, shapes.counts)
                if not near.all():
                    self.set_apart(again[~near])
                self._judge_near(self, again[near], self._R_up_world, self.floor_m)
        self.changed_pairs.update(keys)
        unseen = rows[self.frames[rows] == 0]
        if len(unseen):
            idle = ~(self.judged[unseen] & np.isfinite(self.gaps_m[unseen]))
            for pair_key in self.ids[unseen[idle]].tolist():
                self.forget_pair(pair_key)

    def _count(self, rows: Int64) -> None:
        """Take in the votes on pairs."""
        self.frames[rows], votes = self._graph.votes.of(self.nodes[rows])
        count_votes(rows, votes, self._relation_of, self.counts, self.other_votes)


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
