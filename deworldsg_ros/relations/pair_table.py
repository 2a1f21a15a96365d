"""Geometry and votes of all pairs of nodes that may be related, kept up to date."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from deworldsg_ros.relations.pair_geometry import (
    FEATURES,
    MIN_SHAPE_POINTS,
    NodeShapes,
    pair_features,
    pairs_in_reach,
    rotation_to_upright,
)
from deworldsg_ros.relations.physical_states import (
    NONE,
    STATE_COUNT,
    relation_of_predicates,
)
from deworldsg_ros.relations.physics_model import PairInputs, PhysicsModel
from deworldsg_ros.relations.vote_model import relation_counts
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.columns import Columns
from deworldsg_ros.scene.edges import Pair
from deworldsg_ros.scene.graph import SceneGraph

# The floor is where the lowest objects stand; single nodes may reach below it.
FLOOR_QUANTILE = 0.05
# Steps of the height of the floor, so that it changes seldom.
FLOOR_STEP_M = 0.02
# Steps of the components of the up direction, so that it changes less often: every change means
# that all pairs are judged anew. The error is at most half a degree.
UP_STEP = 0.01
# Logit of every relation of a pair that is out of reach. The simulated rooms have none there.
APART_LOGIT = -12.0
_GAP, _BOTTOM_STEP = FEATURES.index("gap_m"), FEATURES.index("bottom_over_bottom_m")


class PairTable(Columns):
    """Pairs of nodes, the smaller id first; a row's id is `key` of the pair.

    Attributes:
        nodes: (m, 2) int64 ids.
        judged: (m,) bool; both nodes have enough points.
        state_logits: (m, STATE_COUNT) of the physical model, where judged.
        gaps_m: (m,) horizontal gap of the bounds; infinite out of reach.
        bottom_steps_m: (m,) difference of the heights of the bottoms, where in reach.
        centre_steps_m: (m,) horizontal distance of the centres of the bounds, where in reach.
        votes: (m, 2, R) float32 sums of the votes in both directions.
        frames: (m,) number of frames that showed both nodes.
        counts: (m, 2, NONE) of `relation_counts` in both directions.
    """

    nodes: Int64
    judged: Bool
    state_logits: Float64
    gaps_m: Float64
    bottom_steps_m: Float64
    centre_steps_m: Float64
    votes: Float32
    frames: Float64
    counts: Float64

    def __init__(self, graph: SceneGraph, model: PhysicsModel, *, geometry: bool) -> None:
        super().__init__(
            {
                "nodes": (np.int64, (2,)),
                "judged": (np.bool_, ()),
                "state_logits": (np.float64, (STATE_COUNT,)),
                "gaps_m": (np.float64, ()),
                "bottom_steps_m": (np.float64, ()),
                "centre_steps_m": (np.float64, ()),
                "votes": (np.float32, (2, len(graph.vocabulary.predicates))),
                "frames": (np.float64, ()),
                "counts": (np.float64, (2, NONE)),
            }
        )
        self.shapes = NodeShapes()
        self.floor_m = 0.0
        self._graph = graph
        self._model = model
        self._geometry = geometry
        self._inputs = PairInputs(graph.vocabulary.classes)
        self._relation_of = relation_of_predicates(graph.vocabulary.predicates)
        self._R_up_world = np.eye(3)
        self._of_node: dict[int, set[int]] = {}

    def refresh(self, up_world: Float64) -> None:
        """Follow the graph: its nodes, their surfaces and classes, and the votes.

        Args:
            up_world: (3,) direction that points up in the world frame; it is used in `UP_STEP`s.
        """
        nodes, shapes = self._graph.nodes, self.shapes
        included = np.flatnonzero(nodes.confirmed)
        ids = nodes.ids[included].tolist()
        for node_id in set(shapes.ids.tolist()).difference(ids):
            self._forget(node_id)
        turned = rotation_to_upright(stepped_up(up_world))
        all_changed = not np.array_equal(turned, self._R_up_world)
        self._R_up_world = turned
        changed: list[int] = []
        voted = self._graph.take_changed_votes()
        for row, node_id in zip(included.tolist(), ids):
            known = node_id in shapes
            shape = shapes.row(node_id) if known else shapes.append(node_id)
            if not known:
                partners = self._graph.seen_together(node_id)
                voted |= {(min(node_id, other), max(node_id, other)) for other in partners}
            if not known or all_changed or shapes.revisions[shape] != nodes.revisions[row]:
                shapes.put(shape, nodes.surface(row), turned)
                shapes.revisions[shape] = nodes.revisions[row]
                changed.append(node_id)
        floor_m = floor_height(self.shapes)
        if floor_m != self.floor_m:
            self.floor_m, changed = floor_m, ids
        if self._geometry and changed:
            self._judge(changed)
        self._count(voted)
        in_reach = self.judged & np.isfinite(self.gaps_m)
        for pair_key in self.ids[~in_reach & (self.frames == 0)].tolist():
            self._forget_pair(pair_key)

    def _forget(self, node_id: int) -> None:
        self.shapes.remove(node_id)
        for pair_key in list(self._of_node.get(node_id, ())):
            self._forget_pair(pair_key)
        self._of_node.pop(node_id, None)

    def _forget_pair(self, pair_key: int) -> None:
        for node_id in self.nodes[self.row(pair_key)].tolist():
            self._of_node[node_id].discard(pair_key)
        self.remove(pair_key)

    def _judge(self, changed: list[int]) -> None:
        """Judge all pairs in reach of the changed nodes anew."""
        shapes, nodes = self.shapes, self._graph.nodes
        stale = {pair_key for node_id in changed for pair_key in self._of_node.get(node_id, ())}
        self._judge_apart([self.row(pair_key) for pair_key in stale])
        changed_rows = np.array([shapes.row(node_id) for node_id in changed], np.int64)
        found = pairs_in_reach(changed_rows, shapes.low, shapes.high, shapes.counts)
        if not len(found):
            return
        # The smaller id first.
        swapped = shapes.ids[found[:, 0]] > shapes.ids[found[:, 1]]
        found[swapped] = found[swapped, ::-1]
        first, second = np.ascontiguousarray(found.T)  # the layout that is compiled
        columns = (shapes.low, shapes.high, shapes.means, shapes.covariances, shapes.counts)
        there = pair_features(first, second, *columns, shapes.points, self.floor_m)
        back = pair_features(second, first, *columns, shapes.points, self.floor_m)
        ids = shapes.ids[found]
        used, table_rows = np.unique(ids, return_inverse=True)
        ends = table_rows.reshape(ids.shape)
        node_rows = [nodes.row(node_id) for node_id in used.tolist()]
        known = (nodes.class_probabilities[node_rows], nodes.observations[node_rows])
        logits = self._model.state_logits(
            self._inputs.make(there, *known, ends[:, 0], ends[:, 1]),
            self._inputs.make(back, *known, ends[:, 1], ends[:, 0]),
        )
        rows = self._rows_of(ids.tolist())
        self.judged[rows] = True
        self.state_logits[rows] = logits
        self.gaps_m[rows] = there[:, _GAP]
        self.bottom_steps_m[rows] = there[:, _BOTTOM_STEP]
        centres = (shapes.low[:, :2] + shapes.high[:, :2]) / 2.0
        self.centre_steps_m[rows] = np.linalg.norm(centres[first] - centres[second], axis=1)

    def _judge_apart(self, rows: list[int]) -> None:
        """Judge pairs that are out of reach: they are not related."""
        if not rows:
            return
        shapes = self.shapes
        ends = [shapes.row(node_id) for node_id in self.nodes[rows].ravel().tolist()]
        solid = shapes.counts[ends] >= MIN_SHAPE_POINTS
        self.judged[rows] = solid.reshape(-1, 2).all(axis=1)
        self.state_logits[rows] = APART_LOGIT
        self.state_logits[rows, 0] = 0.0
        self.gaps_m[rows] = np.inf

    def _count(self, changed: Iterable[Pair]) -> None:
        """Take in the votes of pairs whose votes changed."""
        votes, shapes = self._graph.votes, self.shapes
        for pair in changed:
            if pair not in votes and key(*pair) in self:
                row = self.row(key(*pair))
                self.votes[row] = self.frames[row] = self.counts[row] = 0.0
        pairs = sorted(p for p in changed if p in votes and p[0] in shapes and p[1] in shapes)
        if not pairs:
            return
        rows = self._rows_of(pairs)
        none = np.zeros((2, len(self._relation_of)))
        counts = np.array([none if (c := votes[pair].counts) is None else c for pair in pairs])
        self.votes[rows] = counts
        self.frames[rows] = [votes[pair].frames for pair in pairs]
        for end in (0, 1):
            self.counts[rows, end] = relation_counts(counts[:, end], self._relation_of)

    def _rows_of(self, pairs: Iterable[Iterable[int]]) -> Int64:
        """Rows of pairs of ids (smaller first); missing ones are added."""
        rows: list[int] = []
        added: list[int] = []
        for first, second in pairs:
            pair_key = key(first, second)
            if pair_key in self:
                rows.append(self.row(pair_key))
                continue
            row = self.append(pair_key)
            self.nodes[row] = first, second
            self._of_node.setdefault(first, set()).add(pair_key)
            self._of_node.setdefault(second, set()).add(pair_key)
            rows.append(row)
            added.append(row)
        if self._geometry:
            self._judge_apart(added)
        return np.array(rows, np.int64)


def floor_height(shapes: NodeShapes) -> float:
    """Height of the floor in the upright frame, metres: where the lowest objects stand."""
    bottoms = shapes.low[shapes.counts >= MIN_SHAPE_POINTS, 2]
    if not len(bottoms):
        return 0.0
    return float(np.round(np.quantile(bottoms, FLOOR_QUANTILE) / FLOOR_STEP_M) * FLOOR_STEP_M)


def stepped_up(up_world: Float64) -> Float64:
    """The direction (3,) `up_world` with components in steps of `UP_STEP`, not of unit length.

    The axes of the world stay as they are.
    """
    return np.round(up_world / np.linalg.norm(up_world) / UP_STEP) * UP_STEP


def key(first: int, second: int) -> int:
    """One number for a pair of ids, the smaller first."""
    return first << 31 | second
