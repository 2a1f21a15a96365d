"""Geometry and votes of all pairs of nodes that may be related, kept up to date."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sortedcontainers import SortedList

from deworldsg_ros.relations.geometry_judge import GeometryJudge
from deworldsg_ros.relations.pair_geometry import rotation_to_upright
from deworldsg_ros.relations.pair_links import move_object, pairs_of
from deworldsg_ros.relations.pair_rows import PairRows
from deworldsg_ros.relations.physical_states import relation_of_predicates
from deworldsg_ros.relations.physics_model import PhysicsModel
from deworldsg_ros.relations.reach import MIN_SHAPE_POINTS, ReachGrid, in_reach, known_reach
from deworldsg_ros.relations.vote_model import count_votes
from deworldsg_ros.relations.waiting_pairs import WaitingPairs
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.class_kinds import SEATS, TABLES
from deworldsg_ros.scene.edges import key
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.publication import NEW_A_CALL
from deworldsg_ros.scene.waiting import take_first

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
        places, confirmed = self._graph.nodes.places, self._graph.nodes.confirmed
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
        rows = nodes.rows_at(node_ids)
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
