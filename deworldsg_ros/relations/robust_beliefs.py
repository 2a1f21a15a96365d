"""The beliefs of edges beyond the paper: is a pair related at all, and by what.

Three sources are combined for each pair of nodes: the fused geometry of both, judged by the
physical world model; the votes of all frames that showed both; and the prior of their classes.
Relations of different pairs exclude each other (`exclusions`). Beliefs are computed anew only
around the pairs that changed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from deworldsg_ros.config import Config
from deworldsg_ros.relations.evidence import entropy_nats, fuse_distributions
from deworldsg_ros.relations.exclusions import (
    CARRIED_FIRST,
    CARRIED_SECOND,
    MOST,
    SEAT_GAP_M,
)
from deworldsg_ros.relations.naming import MIN_OTHER_VOTES, predicate_probabilities, uncertain
from deworldsg_ros.relations.pair_table import PairTable, ends_of
from deworldsg_ros.relations.physical_states import (
    NONE,
    canonical_predicates,
    relation_of_predicates,
)
from deworldsg_ros.relations.physics_model import believed_logits, load_physics_model
from deworldsg_ros.relations.prior import Prior
from deworldsg_ros.relations.settling import (
    find_neighbours,
    rank_neighbours,
    relate,
    share_supports,
)
from deworldsg_ros.relations.vote_model import near_logits, vote_logits
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.class_kinds import SEATS, TABLES
from deworldsg_ros.scene.edges import Pair
from deworldsg_ros.scene.graph import SceneGraph

# Pairs that are related with a smaller probability have no beliefs: no edge would be published.
MIN_RELATED = 0.01

ClassPair = tuple[int, int]


@dataclass(frozen=True)
class ChangedBeliefs:
    """Beliefs of the ordered pairs (subject id, object id) that were computed anew.

    Attributes:
        unrelated: pairs without a belief.
        pairs: k pairs with one.
        probabilities: (k, R) that the predicate holds; row sums are at most 1.
        sources: where each belief comes from.
    """

    unrelated: list[Pair]
    pairs: list[Pair]
    probabilities: Float64
    sources: list[wire.Provenance]


class RobustBeliefs:
    """Beliefs of all edges of a graph.

    Args:
        config: `fusion_alpha`, `entropy_threshold_nats` and `relation_head` are used.
        graph: whose edges these are.
        table: the geometry and the votes of its pairs; its belief columns are written here.
    """

    def __init__(self, config: Config, graph: SceneGraph, table: PairTable) -> None:
        self._config = config.relations
        self._own_head = config.perception.relation_head == "geometric"
        self._graph = graph
        self._table = table
        self._model = load_physics_model()
        predicates, classes = graph.vocabulary.predicates, graph.vocabulary.classes
        self._relation_of = relation_of_predicates(predicates)
        self._canonical = canonical_predicates(predicates)
        self._with = predicates.index("with") if "with" in predicates else -1
        self._tables = np.array([name in TABLES for name in classes], np.float64)
        self._seats = np.array([name in SEATS for name in classes], np.float64)
        # Nodes of each circle of supports that was cut.
        self._circles: list[set[int]] = []
        # Keys of the pairs into which a prior may enter, by class pair; and the reverse.
        self._by_classes: dict[ClassPair, set[int]] = {}
        self._classes_of: dict[int, list[ClassPair]] = {}

    def refresh(self, prior: Prior) -> ChangedBeliefs:
        """Compute the beliefs that may have changed since the last call.

        Args:
            prior: of class pairs, from the predictions of a world model.
        """
        table = self._table
        keys = sorted(table.changed_pairs)
        rows = np.array([table.row(one) for one in keys if one in table], np.int64)
        gone = [one for one in keys if one not in table]
        changed = np.union1d(rows, self._settle(rows))
        for pair_key in gone:
            self._index(pair_key, [])
        again = set().union(*(self._by_classes.get(pair, ()) for pair in prior.changed))
        changed = np.union1d(changed, np.array([table.row(one) for one in again], np.int64))
        table.changed_pairs.clear()
        table.changed_nodes.clear()
        prior.changed.clear()
        return self._beliefs(changed.astype(np.int64), gone, prior)

    def _settle(self, rows: Int64) -> Int64:
        """Relations around the changed rows; returns the rows whose relations changed."""
        t, shapes = self._table, self._table.shapes
        nodes = [shapes.row(node_id) for node_id in t.changed_nodes]
        objects = np.union1d(t.ends[rows], np.array(nodes, np.int64)).astype(np.int64)
        if not len(objects):
            return objects
        self._judge(rows)
        objects = self._reopen_circles(objects)
        shapes.floor_odds[objects] = self._floor_odds(objects)
        lists = (t.ends, t.links, shapes.first_links)
        cut = share_supports(
            objects, t.carried, t.kept, shapes.floor_odds, shapes.on_floor, shapes.totals, *lists
        )
        self._note_circles(cut.tolist())
        ranked = find_neighbours(
            objects,
            t.states,
            t.carried,
            t.kept,
            shapes.on_floor,
            t.gaps_m,
            t.bottom_steps_m,
            t.with_,
            t.near,
            t.eligible,
            shapes.shares,
            shapes.marks,
            *lists,
        )
        moved = rank_neighbours(
            ranked, t.gaps_m, t.centre_steps_m, t.eligible, t.close, t.links, shapes.first_links
        )
        around = np.union1d(t.rows_of(shapes.ids[objects].tolist()), moved).astype(np.int64)
        around = around[t.live[around]]
        changed = relate(
            around,
            t.states,
            t.carried,
            t.kept,
            t.near,
            t.close,
            t.with_,
            t.near_votes,
            t.relations,
        )
        return around[changed]

    def _judge(self, rows: Int64) -> None:
        """What the evidence on each changed pair alone says."""
        if not len(rows):
            return
        table, model = self._table, self._model
        counts, frames, judged = table.counts[rows], table.frames[rows], table.judged[rows]
        geometry = np.where(judged[:, None], table.state_logits[rows], 0.0)
        votes = vote_logits(counts, frames, model.votes)
        independent = ~judged | (not self._own_head)
        states = softmax(believed_logits(model, geometry, votes, independent), axis=1)
        table.states[rows] = states
        carried = [states[:, CARRIED_FIRST].sum(1), states[:, CARRIED_SECOND].sum(1)]
        table.carried[rows] = np.minimum(np.column_stack(carried), MOST)
        by_votes = np.where(independent, model.source_weights[1], 1.0)
        near_votes = by_votes * near_logits(counts, frames, model.votes)
        table.near_votes[rows] = near_votes
        table.by_votes[rows] = by_votes
        apart = judged & np.isinf(table.gaps_m[rows])
        spoken = (votes > 0.0).any(axis=1) | (near_votes > 0.0)
        live = ~apart | spoken | (table.other_votes[rows] >= MIN_OTHER_VOTES)
        table.live[rows] = live
        idle = rows[~live]
        table.near[idle], table.eligible[idle], table.relations[idle] = 0.0, False, 0.0
        table.relations[idle, :, NONE] = 1.0
        table.with_[rows] = self._tables_with_seats(rows)

    def _tables_with_seats(self, rows: Int64) -> Bool:
        """(m, 2) bool: a table and a seat in its reach; the table is the first, or the second."""
        t, nodes = self._table, self._graph.nodes
        ends = t.nodes[rows]
        ids, places = np.unique(ends, return_inverse=True)
        classes = nodes.class_probabilities[[nodes.row(node_id) for node_id in ids.tolist()]]
        classes = classes.reshape(-1, nodes.class_probabilities.shape[1])
        first, second = places.reshape(-1, 2).T
        table, seat = classes @ self._tables > 0.5, classes @ self._seats > 0.5
        found = np.column_stack([table[first] & seat[second], table[second] & seat[first]])
        return found & (t.judged[rows] & (t.gaps_m[rows] <= SEAT_GAP_M))[:, None]

    def _floor_odds(self, objects: Int64) -> Float64:
        """Odds (n,) that nodes stand on the floor; 0 without surfaces or a world model."""
        if self._config.world_model == "none":
            return np.zeros(len(objects))
        shapes = self._table.shapes
        low, high = shapes.low[objects, 2], shapes.high[objects, 2]
        logits = self._model.floor_logits(low - self._table.floor_m, high - low)
        known = shapes.counts[objects] > 0
        return np.where(known, np.exp(np.clip(logits, -20.0, 20.0)), 0.0)

    def _reopen_circles(self, objects: Int64) -> Int64:
        """The objects, and those of the circles that contain one of them."""
        if not self._circles:
            return objects
        shapes = self._table.shapes
        ids = set(shapes.ids[objects].tolist())
        opened = [circle for circle in self._circles if not circle.isdisjoint(ids)]
        self._circles = [circle for circle in self._circles if circle.isdisjoint(ids)]
        more = [shapes.row(i) for circle in opened for i in circle if i in shapes]
        return np.union1d(objects, np.array(more, np.int64)).astype(np.int64)

    def _note_circles(self, cut: list[int]) -> None:
        """Remember the nodes of the circles that were cut at these places."""
        table = self._table
        for place in cut:
            row, end = place >> 1, place & 1
            circle = {int(table.nodes[row, end])}
            node = int(table.nodes[row, 1 - end])
            while node not in circle:
                circle.add(node)
                rows = table.rows_of([node])
                ends = (table.nodes[rows, 1] == node).astype(np.int64)
                likely = np.flatnonzero(table.kept[rows, ends] > 0.5)
                if not len(likely):
                    break
                node = int(table.nodes[rows[likely[0]], 1 - ends[likely[0]]])
            self._circles.append(circle)

    def _beliefs(self, rows: Int64, gone: list[int], prior: Prior) -> ChangedBeliefs:
        """Beliefs of pairs in both directions: few of those in reach are related."""
        t = self._table
        related = t.relations[rows, :, NONE].min(axis=1) < 1.0 - MIN_RELATED
        related |= t.other_votes[rows] >= MIN_OTHER_VOTES
        for pair_key in t.ids[rows[~related]].tolist():
            self._index(pair_key, [])
            gone.append(pair_key)
        rows = rows[related]
        votes = self._votes(rows)
        probabilities = predicate_probabilities(
            t.relations[rows],
            votes,
            t.frames[rows],
            t.by_votes[rows],
            t.with_[rows],
            self._relation_of,
            self._canonical,
            self._with,
            self._model.vote_scales,
        )
        judged = np.repeat(t.judged[rows][:, None], 2, axis=1)
        self._add_prior(rows, probabilities, judged, prior)
        voted = votes.any(axis=2)
        return ChangedBeliefs(
            [pair for one in gone for pair in _both(*ends_of(one))],
            [pair for ends in t.nodes[rows].tolist() for pair in _both(*ends)],
            probabilities.reshape(-1, len(self._relation_of)),
            [_source(*known) for known in zip(judged.ravel().tolist(), voted.ravel().tolist())],
        )

    def _votes(self, rows: Int64) -> Float32:
        """The votes (k, 2, R) on pairs."""
        known = self._graph.votes
        result = np.zeros((len(rows), 2, len(self._relation_of)), np.float32)
        for index, pair in enumerate(map(tuple, self._table.nodes[rows].tolist())):
            votes = known.get(pair)
            if votes is not None and votes.counts is not None:
                result[index] = votes.counts
        return result

    def _add_prior(self, rows: Int64, probabilities: Float64, judged: Bool, prior: Prior) -> None:
        """Eq. 10 with the prior of class pairs, in place; and whether a world model spoke."""
        table = self._table
        open_ = uncertain(probabilities, self._config.entropy_threshold_nats)
        best = table.shapes.best_classes[table.ends[rows]]
        for index, pair_key in enumerate(table.ids[rows].tolist()):
            first, second = best[index].tolist()
            pairs = [(first, second), (second, first)]
            self._index(pair_key, [pairs[end] for end in (0, 1) if open_[index, end]])
        places, ends = np.nonzero(open_)
        if not len(places):
            return
        classes = np.column_stack([best[places, ends], best[places, 1 - ends]])
        priors, has_prior = prior.lookup(classes)
        fused, active = fuse_prior(
            probabilities[places, ends],
            priors,
            has_prior,
            self._config.fusion_alpha,
            self._config.entropy_threshold_nats,
        )
        probabilities[places, ends] = fused
        judged[places, ends] |= active

    def _index(self, pair_key: int, classes: list[ClassPair]) -> None:
        """Note the class pairs whose prior may enter a pair."""
        for known in self._classes_of.pop(pair_key, ()):
            self._by_classes[known].discard(pair_key)
            if not self._by_classes[known]:
                del self._by_classes[known]
        if classes:
            self._classes_of[pair_key] = classes
            for pair in classes:
                self._by_classes.setdefault(pair, set()).add(pair_key)


def _both(first: int, second: int) -> tuple[Pair, Pair]:
    return (first, second), (second, first)


def _source(judged: bool, voted: bool) -> wire.Provenance:
    if not judged:
        return "visual"
    return "fused" if voted else "prior"


def fuse_prior(
    probabilities: Float64, priors: Float64, has_prior: Bool, alpha: float, threshold_nats: float
) -> tuple[Float64, Bool]:
    """Eq. 10 for pairs that are related with some probability.

    The prior says by what a pair is related, not whether. It enters where the distribution over
    predicates, given that one holds, has an entropy above the threshold.

    Args:
        probabilities: (m, R), row sums at most 1.
        priors: (m, R) distributions, and
        has_prior: (m,) bool.
        alpha: weight of Eq. 10.
        threshold_nats: entropy.

    Returns:
        (m, R) with the same row sums, and (m,) bool: the prior entered.
    """
    related = probabilities.sum(axis=1)
    given = probabilities / np.maximum(related, 1e-300)[:, None]
    active = has_prior & (entropy_nats(given) > threshold_nats) & (related > 0) & (alpha > 0)
    fused = fuse_distributions(given, priors, np.where(active, alpha, 0.0))
    return np.where(active[:, None], related[:, None] * fused, probabilities), active
