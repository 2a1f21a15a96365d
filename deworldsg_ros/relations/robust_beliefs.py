"""The beliefs of edges beyond the paper: is a pair related at all, and by what.

Three sources are combined for each pair of nodes: the fused geometry of both, judged by the
physical world model; the votes of all frames that showed both; and the prior of their classes.
Relations of different pairs exclude each other (`exclusions`). Beliefs are computed anew only
around the pairs that changed.
"""

from __future__ import annotations

import itertools
from collections.abc import Set
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.config import Config
from deworldsg_ros.relations.evidence import entropy_nats, fuse_distributions
from deworldsg_ros.relations.naming import predicate_probabilities, related_pairs, uncertain
from deworldsg_ros.relations.pair_links import joined
from deworldsg_ros.relations.pair_table import PairTable
from deworldsg_ros.relations.physical_states import canonical_predicates, relation_of_predicates
from deworldsg_ros.relations.physics_model import load_physics_model
from deworldsg_ros.relations.prior import Prior
from deworldsg_ros.relations.settled_relations import SettledRelations
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.graph import SceneGraph

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
