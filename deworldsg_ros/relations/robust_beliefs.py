"""The beliefs of edges beyond the paper: is a pair related at all, and by what.

Three sources are combined for each pair of nodes: the fused geometry of both, judged by the
physical world model; the votes of all frames that showed both; and the prior of their classes.
Relations of different pairs exclude each other (`exclusions`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit, softmax

from deworldsg_ros.config import Config
from deworldsg_ros.relations.evidence import entropy_nats, fuse_distributions
from deworldsg_ros.relations.exclusions import (
    NEAR_CERTAINTY,
    SEAT_GAP_M,
    near_probabilities,
    one_support,
)
from deworldsg_ros.relations.pair_table import PairTable
from deworldsg_ros.relations.physical_states import (
    NEAR,
    NONE,
    RELATIONS,
    RELATIONS_OF_STATE,
    canonical_predicates,
    relation_of_predicates,
)
from deworldsg_ros.relations.physics_model import believed_logits, load_physics_model
from deworldsg_ros.relations.prior import ClassPairPrior
from deworldsg_ros.relations.vote_model import near_logits, vote_logits
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.class_kinds import SEATS, TABLES
from deworldsg_ros.scene.graph import SceneGraph

# Several predicates may name one relation, and share its probability by their votes. The default
# name gets these votes in addition, so that a relation without votes has a name.
NAMING_VOTES = 0.5
# Least sum of votes for a predicate that names no physical relation. Less is no evidence: a frame
# that votes gives every predicate a small probability.
MIN_OTHER_VOTES = 0.5
# Pairs that are related with a smaller probability have no beliefs: no edge would be published.
MIN_RELATED = 0.01
# Odds, before any vote, that a predicate beyond the physical relations holds.
OTHER_ODDS = 0.02


@dataclass(frozen=True)
class DirectedBeliefs:
    """Beliefs of m ordered pairs.

    Attributes:
        pairs: (m, 2) ids of subject and object.
        probabilities: (m, R) that the predicate holds; row sums are at most 1.
        voted: (m,) bool; a frame voted on this direction.
        judged: (m,) bool; a world model predicted this pair, or pairs of its classes.
    """

    pairs: Int64
    probabilities: Float64
    voted: Bool
    judged: Bool

    def sources(self, row: int) -> wire.Provenance:
        """Where the belief of a pair comes from."""
        if not self.judged[row]:
            return "visual"
        return "fused" if self.voted[row] else "prior"


class RobustBeliefs:
    """Beliefs of all edges of a graph.

    Args:
        config: `fusion_alpha`, `entropy_threshold_nats` and `relation_head` are used.
        graph: whose edges these are.
        table: the geometry and the votes of its pairs.
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

    def beliefs(self, prior: ClassPairPrior) -> DirectedBeliefs:
        """Beliefs of both directions of every pair that may be related.

        Args:
            prior: of class pairs, from the predictions of a world model.
        """
        table, nodes = self._table, self._graph.nodes
        ids, ends = np.unique(table.nodes, return_inverse=True)
        pairs = ends.reshape(-1, 2)
        classes = nodes.class_probabilities[[nodes.row(node_id) for node_id in ids.tolist()]]
        classes = classes.reshape(-1, nodes.class_probabilities.shape[1])
        with_ = self._tables_with_seats(pairs, classes)
        relations = self._relations(pairs, ids, np.asarray(with_.any(axis=1)))
        rows = self._related_rows(relations)
        votes, frames = table.votes[rows], table.frames[rows]
        by_votes = self._by_votes()[rows]
        named = [
            self._named(relations[rows, end], votes[:, end], with_[rows, end])
            + self._others(relations[rows, end, NONE], votes[:, end], frames, by_votes)
            for end in (0, 1)
        ]
        best = classes.argmax(axis=1).astype(np.int64)[pairs[rows]]
        probabilities, judged = self._with_prior(
            np.concatenate(named),
            np.concatenate([best, best[:, ::-1]]),
            np.tile(table.judged[rows], 2),
            prior,
        )
        return DirectedBeliefs(
            np.concatenate([table.nodes[rows], table.nodes[rows, ::-1]]),
            probabilities,
            np.concatenate([votes[:, end].any(axis=1) for end in (0, 1)]),
            judged,
        )

    def _related_rows(self, relations: Float64) -> Int64:
        """Rows of the pairs that may be related: few of those in reach are."""
        columns = self._relation_of < 0
        other = self._table.votes[:, :, columns].max(axis=(1, 2), initial=0.0) >= MIN_OTHER_VOTES
        return np.flatnonzero((relations[..., NONE].min(axis=1) < 1.0 - MIN_RELATED) | other)

    def _relations(self, pairs: Int64, ids: Int64, seated: Bool) -> Float64:
        """Probabilities (m, 2, len(RELATIONS)) of the relations in both directions."""
        table, model = self._table, self._model
        geometry = np.where(table.judged[:, None], table.state_logits, 0.0)
        votes = vote_logits(table.counts, table.frames, model.votes)
        states = softmax(believed_logits(model, geometry, votes, self._independent()), axis=1)
        floor_odds = self._floor_odds(ids)
        states, carried, on_floor = one_support(states, pairs, floor_odds)
        near = self._near(pairs, seated, carried, on_floor, states[:, 0])
        result = np.zeros((len(pairs), 2, len(RELATIONS)))
        for end in (0, 1):
            for state in range(1, states.shape[1]):
                result[:, end, RELATIONS_OF_STATE[state, end]] += states[:, state]
            result[:, end, NEAR] = states[:, 0] * near
            result[:, end, NONE] += states[:, 0] * (1.0 - near)
        return result

    def _floor_odds(self, ids: Int64) -> Float64:
        """Odds (n,) that nodes stand on the floor; 0 without surfaces or a world model."""
        if self._config.world_model == "none":
            return np.zeros(len(ids))
        shapes = self._table.shapes
        rows = [shapes.row(node_id) for node_id in ids.tolist()]
        low, high = shapes.low[rows, 2], shapes.high[rows, 2]
        logits = self._model.floor_logits(low - self._table.floor_m, high - low)
        known = shapes.counts[rows] > 0
        return np.where(known, np.exp(np.clip(logits, -20.0, 20.0)), 0.0)

    def _near(
        self, pairs: Int64, seated: Bool, carried: Float64, on_floor: Float64, free: Float64
    ) -> Float64:
        """Probability (m,) that a pair is near if it is in no more specific relation."""
        table = self._table
        near = near_probabilities(
            pairs,
            carried,
            on_floor,
            np.where(table.judged, table.gaps_m, np.inf),
            table.bottom_steps_m,
            table.centre_steps_m,
            free,
            seated,
        )
        near = np.clip(near, 1.0 - NEAR_CERTAINTY, NEAR_CERTAINTY)
        votes = near_logits(table.counts, table.frames, self._model.votes)
        return np.asarray(expit(logit(near) + self._by_votes() * votes))

    def _tables_with_seats(self, pairs: Int64, classes: Float64) -> Bool:
        """(m, 2) bool: a table and a seat in its reach; the table is the first, or the second."""
        table, seat = classes @ self._tables > 0.5, classes @ self._seats > 0.5
        first, second = pairs[:, 0], pairs[:, 1]
        found = np.column_stack([table[first] & seat[second], table[second] & seat[first]])
        return found & (self._table.judged & (self._table.gaps_m <= SEAT_GAP_M))[:, None]

    def _named(self, relations: Float64, votes: Float32, with_: Bool) -> Float64:
        """Probabilities (m, R): each relation's is divided among its predicates by their votes.

        Without votes, a relation has the name that comes first in `PREDICATES`; a table is "with"
        the seats that are near it.
        """
        result = np.zeros(votes.shape)
        rows = np.arange(len(votes))
        for relation, canonical in enumerate(self._canonical.tolist()):
            if canonical < 0:
                continue
            named = np.flatnonzero(self._relation_of == relation)
            names = np.full(len(votes), canonical)
            if relation == NEAR and self._with >= 0:
                names[with_] = self._with
            weights = np.zeros(votes.shape)
            weights[:, named] = votes[:, named]
            weights[rows, names] += NAMING_VOTES
            weights /= weights.sum(axis=1, keepdims=True)
            result += relations[:, relation, None] * weights
        return result

    def _others(
        self, unrelated: Float64, votes: Float32, frames: Float64, by_votes: Float64
    ) -> Float64:
        """Probabilities (m, R) of predicates that name no physical relation, from votes alone.

        Their votes are believed as those on "on" are.
        """
        result = np.zeros(votes.shape)
        columns = np.flatnonzero(self._relation_of < 0)
        rows = np.flatnonzero(votes[:, columns].max(axis=1, initial=0.0) >= MIN_OTHER_VOTES)
        if not len(rows):
            return result
        hits = votes[np.ix_(rows, columns)].astype(np.float64)
        logs = self._model.votes.evidence(hits, frames[rows, None])
        logs *= by_votes[rows, None]
        odds = OTHER_ODDS * np.exp(np.clip(logs, -30.0, 30.0))
        result[np.ix_(rows, columns)] = (
            unrelated[rows, None] * odds / (1.0 + odds.sum(axis=1, keepdims=True))
        )
        return result

    def _independent(self) -> Bool:
        """(m,) bool: the votes on a pair do not repeat what its geometry says."""
        return ~self._table.judged | (not self._own_head)

    def _by_votes(self) -> Float64:
        """Exponent (m,) of the votes of each pair."""
        by_independent = self._model.source_weights[1]
        return np.asarray(np.where(self._independent(), by_independent, 1.0))

    def _with_prior(
        self, probabilities: Float64, classes: Int64, judged: Bool, prior: ClassPairPrior
    ) -> tuple[Float64, Bool]:
        """Eq. 10 with the prior of class pairs; and whether a world model spoke of each pair."""
        priors, has_prior = prior.lookup(classes)
        fused, active = fuse_prior(
            probabilities,
            priors,
            has_prior,
            self._config.fusion_alpha,
            self._config.entropy_threshold_nats,
        )
        return fused, judged | active


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
