"""Beliefs of edges beyond the paper: the relations of all pairs, settled around what changed."""

from __future__ import annotations

import itertools
from collections.abc import Set
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.config import Config
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.relations.pairs import PairTable, joined
from deworldsg_ros.relations.paper import Prior, entropy_nats, fuse_distributions
from deworldsg_ros.relations.physics import (
    believed_logits,
    floor_odds,
    load_physics_model,
    near_logits,
    vote_logits,
)
from deworldsg_ros.relations.rules import settle, take_in
from deworldsg_ros.relations.states import (
    canonical_predicates,
    predicate_probabilities,
    related_pairs,
    relation_of_predicates,
    uncertain,
)
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.wire import messages as wire

# --- The physical relations of all pairs, settled around what changed.


class SettledRelations:
    """Writes the belief columns of a table: what its pairs say, and what they exclude.

    The columns of `PairRows` are: ``states`` (STATE_COUNT,), ``carried`` (2,) and ``near_votes`` by
    the pair alone; ``kept`` (2,), ``near``, ``eligible`` and ``close`` (2,) after what others
    exclude (see `settling`); ``relations`` (2, NONE + 1) of both directions; ``by_votes``, the
    exponent of the votes; ``with_`` (2,), a table and a seat; ``live``, false for pairs that are
    apart and have no votes that matter.

    Args:
        config: `world_model` and `relation_head` are used.
        graph: of the table.
        table: of pairs.
    """

    def __init__(self, config: Config, graph: SceneGraph, table: PairTable) -> None:
        self._geometry = config.relations.world_model != "none"
        self._own_head = config.perception.relation_head == "geometric"
        self._table = table
        self._model = load_physics_model()
        # Nodes of each circle of supports that was cut.
        self._circles: list[set[int]] = []

    def settle(self, rows: Int64) -> Int64:
        """Relations around the changed rows; returns the rows whose relations changed."""
        t, shapes = self._table, self._table.shapes
        nodes = [shapes.places[node_id] for node_id in t.changed_nodes]
        objects = joined(t.ends[rows], nodes)
        if not len(objects):
            return objects
        self._judge(rows)
        objects = self._reopen_circles(objects)
        if self._geometry:
            shapes.floor_odds[objects] = floor_odds(
                objects, shapes.low, shapes.high, shapes.counts, t.floor_m, self._model.floor
            )
        cut, changed = settle(
            objects,
            t.states,
            t.carried,
            t.kept,
            shapes.floor_odds,
            shapes.on_floor,
            shapes.totals,
            t.gaps_m,
            t.bottom_steps_m,
            t.centre_steps_m,
            t.with_,
            t.near,
            t.eligible,
            shapes.shares,
            shapes.marks,
            t.close,
            t.near_votes,
            t.live,
            t.relations,
            t.ends,
            t.links,
            shapes.first_links,
        )
        if len(cut):
            self._note_circles(cut.tolist())
        return changed

    def _judge(self, rows: Int64) -> None:
        """What the evidence on each changed pair alone says."""
        if not len(rows):
            return
        t, model = self._table, self._model
        counts, frames = t.counts[rows], t.frames[rows]
        geometry, unknown = t.state_logits[rows], ~t.judged[rows]
        geometry[unknown] = 0.0
        votes = vote_logits(counts, frames, model.votes)
        independent = unknown if self._own_head else np.ones_like(unknown)
        take_in(
            rows,
            believed_logits(model, geometry, votes, independent),
            votes,
            near_logits(counts, frames, model.votes),
            np.where(independent, model.source_weights[1], 1.0),
            t.ends,
            t.shapes.seating,
            t.judged,
            t.gaps_m,
            t.other_votes,
            t.states,
            t.carried,
            t.near,
            t.near_votes,
            t.by_votes,
            t.relations,
            t.eligible,
            t.with_,
            t.live,
        )

    def _reopen_circles(self, objects: Int64) -> Int64:
        """The objects, and those of the circles that contain one of them."""
        if not self._circles:
            return objects
        shapes = self._table.shapes
        ids = set(shapes.ids[objects].tolist())
        opened = [circle for circle in self._circles if not circle.isdisjoint(ids)]
        self._circles = [circle for circle in self._circles if circle.isdisjoint(ids)]
        more = [shapes.row(i) for circle in opened for i in circle if i in shapes]
        return joined(objects, more)

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


# --- The beliefs of edges beyond the paper: is a pair related at all, and by what.
#
# Three sources are combined for each pair of nodes: the fused geometry of both, judged by the
# physical world model; the votes of all frames that showed both; and the prior of their classes.
# Relations of different pairs exclude each other (`exclusions`). Beliefs are computed anew only
# around the pairs that changed.

ClassPair = tuple[int, int]


@dataclass(frozen=True)
class ChangedBeliefs:
    """Beliefs of pairs of nodes that were computed anew; pairs have the keys of the table.

    Attributes:
        unrelated: pairs without a belief.
        pairs: k pairs with one.
        probabilities: (k, 2, R) that the predicate holds, in both directions; sums over R are at
            most 1.
        judged: (k, 2) bool, whether a world model spoke, and
        voted: (k, 2) bool, whether frames voted.
    """

    unrelated: list[int]
    pairs: list[int]
    probabilities: Float64
    judged: Bool
    voted: Bool

    def source(self, index: int, end: int) -> wire.Provenance:
        """Where a belief comes from."""
        if not self.judged[index, end]:
            return "visual"
        return "fused" if self.voted[index, end] else "prior"


class RobustBeliefs:
    """Beliefs of all edges of a graph.

    Args:
        config: `fusion_alpha`, `entropy_threshold_nats` and `relation_head` are used.
        graph: whose edges these are.
        table: the geometry and the votes of its pairs.
    """

    def __init__(self, config: Config, graph: SceneGraph, table: PairTable) -> None:
        self._config = config.relations
        self._graph = graph
        self._table = table
        self._model = load_physics_model()
        self._settled = SettledRelations(config, graph, table)
        predicates = graph.vocabulary.predicates
        self._relation_of = relation_of_predicates(predicates)
        self._canonical = canonical_predicates(predicates)
        self._with = predicates.index("with") if "with" in predicates else -1
        # Keys of the pairs into which a prior may enter, by class pair; and the reverse.
        self._by_classes: dict[ClassPair, set[int]] = {}
        self._classes_of: dict[int, Set[ClassPair]] = {}

    def refresh(self, prior: Prior) -> ChangedBeliefs:
        """Compute the beliefs that may have changed since the last call.

        Args:
            prior: of class pairs, from the predictions of a world model.
        """
        table = self._table
        places = table.places
        gone = [one for one in table.changed_pairs if one not in places]
        rows = [places[one] for one in table.changed_pairs if one in places]
        changed = self._settled.settle(np.array(rows, np.int64))
        again = set().union(*(self._by_classes.get(pair, ()) for pair in prior.changed))
        changed = joined(changed, rows + [places[one] for one in again.difference(gone)])
        table.changed_pairs.clear()
        table.changed_nodes.clear()
        prior.changed.clear()
        return self._beliefs(changed, gone, prior)

    def _beliefs(self, rows: Int64, gone: list[int], prior: Prior) -> ChangedBeliefs:
        """Beliefs of pairs in both directions: few of those in reach are related."""
        t = self._table
        related = related_pairs(rows, t.relations, t.other_votes)
        gone += t.ids[rows[~related]].tolist()
        for pair_key in self._classes_of.keys() & gone:
            self._index(pair_key, set())
        rows = rows[related]
        probabilities, voted = predicate_probabilities(
            rows,
            t.relations,
            self._graph.votes.of(t.nodes[rows])[1],
            t.frames,
            t.by_votes,
            t.with_,
            self._relation_of,
            self._canonical,
            self._with,
            self._model.vote_scales,
        )
        judged = t.judged[rows].repeat(2).reshape(-1, 2)
        self._add_prior(rows, probabilities, judged, prior)
        return ChangedBeliefs(gone, t.ids[rows].tolist(), probabilities, judged, voted)

    def _add_prior(self, rows: Int64, probabilities: Float64, judged: Bool, prior: Prior) -> None:
        """Eq. 10 with the prior of class pairs, in place; and whether a world model spoke."""
        table = self._table
        open_ = uncertain(probabilities, self._config.entropy_threshold_nats)
        best = table.shapes.best_classes[table.ends[rows]]
        for pair_key, (first, second), ends in zip(
            table.ids[rows].tolist(), best.tolist(), open_.tolist()
        ):
            known = self._classes_of.get(pair_key)
            if known is not None or any(ends):
                pairs = [(first, second), (second, first)]
                # Two objects of one class have the same class pair in both directions.
                uncertain_ones = set(itertools.compress(pairs, ends))
                if uncertain_ones != known:
                    self._index(pair_key, uncertain_ones)
        places, ends = np.nonzero(open_)
        if not len(places):
            return
        classes = np.column_stack([best[places, ends], best[places, 1 - ends]])
        priors, has_prior = prior.lookup(classes)
        if not has_prior.any():
            return
        fused, active = fuse_prior(
            probabilities[places, ends],
            priors,
            has_prior,
            self._config.fusion_alpha,
            self._config.entropy_threshold_nats,
        )
        probabilities[places, ends] = fused
        judged[places, ends] |= active

    def _index(self, pair_key: int, classes: Set[ClassPair]) -> None:
        """Note the class pairs whose prior may enter a pair."""
        for known in self._classes_of.pop(pair_key, ()):
            self._by_classes[known].discard(pair_key)
            if not self._by_classes[known]:
                del self._by_classes[known]
        if classes:
            self._classes_of[pair_key] = classes
            for pair in classes:
                self._by_classes.setdefault(pair, set()).add(pair_key)


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
