"""The beliefs of the edges of the global graph: evidence in, messages out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deworldsg_ros.config import Config
from deworldsg_ros.relations.evidence import (
    OUTLIER_RATE,
    bounded_logits,
    entropy_nats,
    visual_distribution,
)
from deworldsg_ros.relations.pair_table import PairTable
from deworldsg_ros.relations.paper_beliefs import PaperBeliefs, edge_state
from deworldsg_ros.relations.physics_model import load_physics_model
from deworldsg_ros.relations.predicted_prior import PredictedPrior
from deworldsg_ros.relations.prior import ClassPairPrior, Prior
from deworldsg_ros.relations.robust_beliefs import ChangedBeliefs, RobustBeliefs
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Bool, Float64
from deworldsg_ros.scene.edges import Pair
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence, Vocabulary, derived
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.predicates import SYMMETRIC, plain
from deworldsg_ros.scene.up import UpEstimator
from deworldsg_ros.scene.votes import frame_votes

# Votes of objects whose means are farther apart are not counted.
MAX_DISTANCE_M = 2.5
# An edge is published if its best predicate has at least this probability.
MIN_PROBABILITY = 0.2
# Pairs in reach that are judged anew in a call that may leave some for the next one. A frame of
# 12 objects changes about 80 pairs.
JUDGED_A_CALL = 32
# A symmetric relation is sent once a pair if its probabilities in both directions differ by less.
SAME_PROBABILITY = 0.01
# If more wait than this many calls judge, a call judges more: edges lag by a second at 30 Hz.
MAX_CALLS = 32
# Probabilities are rounded to this many decimals, so that a tiny change makes no new message.
DECIMALS = 3


class EdgeBeliefs:
    """Takes relation evidence into a graph and computes the messages of its edges.

    Args:
        config: every section but ``lifting`` and ``merging`` is used.
        graph: whose edges these are.
        prior: of class pairs, from clips.

    Attributes:
        prior: of class pairs, from clips.
        up: estimates the direction against gravity from the poses of the frames.
        states: the messages of the edges by subject and object; those that did not change are the
            same objects.
    """

    def __init__(self, config: Config, graph: SceneGraph, prior: ClassPairPrior) -> None:
        self.prior = prior
        self.up = UpEstimator(config.inputs.world_up)
        self._graph = graph
        self._top_k = config.output.top_k
        relations = config.relations
        self._robust = relations.edge_belief == "robust"
        self._table = PairTable(
            graph,
            load_physics_model(),
            geometry=relations.world_model != "none",
        )
        self._has_predictions = relations.world_model == "physics"
        self._paper_beliefs = PaperBeliefs(relations, graph, self._top_k)
        self._robust_beliefs = RobustBeliefs(config, graph, self._table)
        self._predicted = PredictedPrior(graph.vocabulary)
        self.states: dict[Pair, wire.EdgeState] = {} if self._robust else self._paper_beliefs.states
        names = graph.vocabulary.predicates
        self._symmetric = np.array([plain(name) in SYMMETRIC for name in names], np.bool_)
        self._begun = False
        # What each message was made from, beside the evidence of its edge.
        self._basis: dict[Pair, tuple[bytes, wire.Provenance, bool]] = {}

    def weigh(self, local: LocalGraph) -> LocalGraph:
        """A frame's local graph with the relation logits as they enter the sum of Eq. 9."""
        if not self._robust:
            return local
        logits = bounded_logits(local.relations.logits, OUTLIER_RATE)
        return derived(local, relations=derived(local.relations, logits=logits))

    def observe(self, local: LocalGraph, node_ids: Sequence[int]) -> None:
        """Count the votes of a merged frame, also for pairs without a relation.

        Args:
            local: the frame, with the logits of the relation head.
            node_ids: the node of each of its rows.
        """
        self.up.observe(local.T_world_camera)
        if not self._robust or len(node_ids) < 2:
            return
        votes = frame_votes(local.relations.logits)
        counts: dict[tuple[int, int], Float64] = {}
        for (subject, object_), vote in zip(local.relations.pairs.tolist(), votes):
            first, second = min(subject, object_), max(subject, object_)
            pair = counts.setdefault((first, second), np.zeros((2, votes.shape[1])))
            pair[int(subject > object_)] = vote
        offsets = local.means_world[:, None] - local.means_world[None]
        close = (offsets**2).sum(axis=2) < MAX_DISTANCE_M**2
        for first, second in np.argwhere(np.triu(close, 1)).tolist():
            a_id, b_id = node_ids[first], node_ids[second]
            if a_id and b_id and a_id != b_id:
                self._graph.add_votes(a_id, b_id, counts.get((first, second)))

    def add(self, evidence: RelationEvidence) -> None:
        """Take in neighbour pairs (Eq. 8) and the world model's predictions.

        Raises:
            RefusedInput: ``vocabulary_mismatch``; ``unknown_frame`` if the local graph with that
                stamp was never merged or is forgotten.
        """
        self._check_vocabulary(evidence)
        node_ids = self._graph.nodes_of_frame(evidence.stamp_ns)
        if node_ids is None or (len(evidence.pairs) and evidence.pairs.max() >= len(node_ids)):
            raise RefusedInput(
                "unknown_frame",
                f"relation evidence for {evidence.stamp_ns} ns: no local graph of that frame "
                "is remembered",
            )
        self.prior.update(evidence.pair_classes, evidence.predictions)
        # A pair with a prediction was already named as a neighbour in an earlier message.
        for subject, object_ in evidence.pairs[~evidence.predicted].tolist():
            self._graph.add_neighbour(node_ids[subject], node_ids[object_], evidence.stamp_ns)

    @property
    def waiting(self) -> int:
        """Number of pairs that wait to be judged."""
        return self._table.waiting

    def refresh(self, whole: bool = True) -> list[Pair]:
        """Bring `states` up to date; returns the pairs with another message, or none.

        Args:
            whole: judge all pairs that wait, as the first call does. False: about `JUDGED_A_CALL`.
        """
        prior: Prior = self.prior
        if self._robust or self._has_predictions:
            some = max(JUDGED_A_CALL, self._table.waiting // MAX_CALLS)
            everything = whole or not self._begun
            self._table.refresh(self.up.up_world(), None if everything else some)
            self._begun = True
        if self._has_predictions:
            self._predicted.follow(self._table, self._table.changed_pairs)
            prior = self._predicted
        if self._robust:
            return self._follow(self._robust_beliefs.refresh(prior))
        self._table.changed_pairs.clear()
        self._table.changed_nodes.clear()
        return self._paper_beliefs.refresh(prior)

    def _follow(self, beliefs: ChangedBeliefs) -> list[Pair]:
        """Messages of the edges that are probable enough."""
        evidence_changed = self._graph.take_changed_edges()
        rounded = np.round(beliefs.probabilities, DECIMALS)
        said = rounded.max(axis=1, initial=0.0) >= MIN_PROBABILITY
        mutual = self._mutual(rounded, said)
        # The beliefs of both directions of a pair follow each other.
        said[1::2] &= ~mutual[1::2]
        gone = beliefs.unrelated + [beliefs.pairs[i] for i in np.flatnonzero(~said).tolist()]
        changed = [pair for pair in gone if self.states.pop(pair, None) is not None]
        for pair in changed:
            del self._basis[pair]
        for index in np.flatnonzero(said).tolist():
            pair = beliefs.pairs[index]
            basis = (rounded[index].tobytes(), beliefs.sources[index], bool(mutual[index]))
            if self._basis.get(pair) != basis or pair in evidence_changed:
                self._basis[pair] = basis
                changed.append(pair)
        changed.extend((evidence_changed & self.states.keys()).difference(changed))
        for pair in changed:
            if pair in self._basis:
                self.states[pair] = self._message(pair, *self._basis[pair])
        return changed

    def _mutual(self, rounded: Float64, said: Bool) -> Bool:
        """Whether each belief (m,) is of a symmetric relation that both directions name."""
        best = rounded.argmax(axis=1).reshape(-1, 2)
        both = said.reshape(-1, 2).all(axis=1) & (best[:, 0] == best[:, 1])
        both &= np.ptp(rounded.max(axis=1, initial=0.0).reshape(-1, 2), axis=1) <= SAME_PROBABILITY
        return np.repeat(both & self._symmetric[best[:, 0]], 2)

    def _message(
        self, pair: Pair, rounded: bytes, provenance: wire.Provenance, mutual: bool
    ) -> wire.EdgeState:
        evidence = self._graph.edges.get(pair)
        probabilities = np.frombuffer(rounded)
        votes = self._graph.votes.get((min(pair), max(pair)))
        logits = np.zeros(len(probabilities))
        frames = 0
        if evidence is not None and evidence.frames:
            logits, frames = evidence.visual_logits, evidence.frames
        return edge_state(
            pair,
            probabilities,
            self._graph.vocabulary.predicates,
            self._top_k,
            provenance=provenance,
            entropy_nats=float(entropy_nats(visual_distribution(logits))),
            observations=frames,
            shown=0 if votes is None else votes.frames,
            mutual=mutual,
        )

    def _check_vocabulary(self, evidence: RelationEvidence) -> None:
        seen, known = evidence.vocabulary, self._graph.vocabulary
        if seen != known:
            raise RefusedInput(
                "vocabulary_mismatch",
                f"relation evidence has {len(seen.classes)} classes and {len(seen.predicates)} "
                f"predicates; expected the graph's {len(known.classes)} and "
                f"{len(known.predicates)}, with the same names in the same order (do all nodes "
                "run with one configuration?)",
            )


def warm_up(config: Config) -> None:
    """Compile the kernels, or load them from the cache: things come, move, rest in a circle, go."""
    graph = SceneGraph(Vocabulary(("table", "cup"), ("on", "near", "with", "other")), "world")
    beliefs = EdgeBeliefs(config, graph, ClassPairPrior(2, 4))
    points = np.indices((3, 3, 3)).reshape(3, -1).T.astype(np.float32) / 10.0
    for index in range(3):
        mean, surface = np.zeros(3), points + np.float32(0.1 * index)
        graph.add_node(mean, np.eye(3), np.array([0.7, 0.3]), 1, surface)
    for pair in ((1, 2), (2, 3), (3, 1)):
        graph.add_votes(*pair, np.array([[30.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]]))
    beliefs.refresh()
    graph.move_node(2, np.array([[1.0, 0, 0, 9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    beliefs.refresh()
    graph.remove_node(1)
    beliefs.refresh()
