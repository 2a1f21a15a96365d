"""The rows of the pairs of nodes, and of the nodes themselves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from deworldsg_ros.relations.pair_geometry import NodeShapes
from deworldsg_ros.relations.pair_links import link, move_pair, pairs_of, unlink
from deworldsg_ros.relations.physical_states import NONE, STATE_COUNT
from deworldsg_ros.relations.reach import MIN_SHAPE_POINTS
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.columns import Columns
from deworldsg_ros.scene.edges import ends_of

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
