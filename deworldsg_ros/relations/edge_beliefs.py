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
from deworldsg_ros.scene.beliefs import listed
from deworldsg_ros.scene.edges import EdgeEvidence, Pair
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence, Vocabulary, derived
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.predicates import SYMMETRIC, plain
from deworldsg_ros.scene.publication import MEASURED_A_CALL
from deworldsg_ros.scene.up import UpEstimator
from deworldsg_ros.scene.votes import frame_votes
from deworldsg_ros.scene.waiting import some_of

# Votes of objects whose means are farther apart are not counted.
MAX_DISTANCE_M = 2.5
# An edge is published if its best predicate has at least this probability.
MIN_PROBABILITY = 0.2
# Pairs in reach that are judged anew in a call that may leave some for the next one. A frame of
# 12 objects changes about 80 pairs.
JUDGED_A_CALL = 12
# A symmetric relation is sent once a pair if its probabilities in both directions differ by less.
SAME_PROBABILITY = 0.01
# Probabilities are rounded to this many decimals, so that a tiny change makes no new message.
DECIMALS = 3
NO_EVIDENCE = EdgeEvidence(np.zeros(0), 0, 0, 0, 0)


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
        has_predictions = relations.world_model == "physics"
        self._table: PairTable | None = None
        self._robust: RobustBeliefs | None = None
        self._paper: PaperBeliefs | None = None
        if relations.edge_belief == "robust" or has_predictions:
            geometry = relations.world_model != "none"
            self._table = PairTable(graph, load_physics_model(), geometry=geometry)
        if relations.edge_belief == "robust" and self._table is not None:
            self._robust = RobustBeliefs(config, graph, self._table)
        else:
            self._paper = PaperBeliefs(relations, graph, self._top_k)
        self._predicted = PredictedPrior(graph.vocabulary) if has_predictions else None
        self.states: dict[Pair, wire.EdgeState] = self._paper.states if self._paper else {}
        names = graph.vocabulary.predicates
        self._symmetric = np.array([plain(name) in SYMMETRIC for name in names], np.bool_)
        self._begun = False
        # What each message was made from, beside the evidence of its edge.
        self._basis: dict[Pair, tuple[bytes, wire.Provenance, bool]] = {}

    def weigh(self, local: LocalGraph) -> LocalGraph:
        """A frame's local graph with the relation logits as they enter the sum of Eq. 9."""
        if self._robust is None:
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
        if self._robust is None or len(node_ids) < 2:
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
        """Number of nodes that wait to be measured, and of pairs that wait to be judged."""
        return 0 if self._table is None else self._table.nodes_waiting + self._table.pairs_waiting

    def refresh(self, whole: bool = True) -> list[Pair]:
        """Bring `states` up to date; returns the pairs with another message, or none.

        Args:
            whole: judge all pairs that wait, as the first call does. False: about `JUDGED_A_CALL`.
        """
        prior = self._follow_table(whole or not self._begun)
        self._begun = True
        if self._robust is not None:
            return self._follow(self._robust.refresh(prior))
        assert self._paper is not None
        return self._paper.refresh(prior)

    def _follow_table(self, everything: bool) -> Prior:
        """Judge pairs that wait, all of them or some; returns the prior that is used."""
        table, prior = self._table, self.prior
        if table is None:
            return prior
        limits = (
            some_of(table.pairs_waiting, JUDGED_A_CALL),
            some_of(table.nodes_waiting, MEASURED_A_CALL),
        )
        up_world = self.up.up_world(exact=everything)
        table.refresh(up_world, *((None, None) if everything else limits))
        if self._predicted is not None:
            self._predicted.follow(table, table.changed_pairs)
        if self._robust is None:
            table.changed_pairs.clear()
            table.changed_nodes.clear()
        return prior if self._predicted is None else self._predicted

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
        self._tell([pair for pair in changed if pair in self._basis])
        return changed

    def _mutual(self, rounded: Float64, said: Bool) -> Bool:
        """Whether each belief (m,) is of a symmetric relation that both directions name."""
        best = rounded.argmax(axis=1).reshape(-1, 2)
        both = said.reshape(-1, 2).all(axis=1) & (best[:, 0] == best[:, 1])
        both &= np.ptp(rounded.max(axis=1, initial=0.0).reshape(-1, 2), axis=1) <= SAME_PROBABILITY
        return np.repeat(both & self._symmetric[best[:, 0]], 2)

    def _tell(self, pairs: list[Pair]) -> None:
        """Write the messages of edges."""
        if not pairs:
            return
        graph = self._graph
        probabilities = np.array([np.frombuffer(self._basis[pair][0]) for pair in pairs])
        evidence = [graph.edges.get(pair, NO_EVIDENCE) for pair in pairs]
        logits = np.zeros(probabilities.shape)
        for row, item in enumerate(evidence):
            if item.frames:
                logits[row] = item.visual_logits
        entropies = entropy_nats(visual_distribution(logits)).tolist()
        told = listed(probabilities, graph.vocabulary.predicates, self._top_k)
        for pair, one, item, entropy in zip(pairs, told, evidence, entropies):
            _, provenance, mutual = self._basis[pair]
            votes = graph.votes.get((min(pair), max(pair)))
            self.states[pair] = edge_state(
                pair,
                one,
                provenance=provenance,
                entropy_nats=entropy,
                observations=item.frames,
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
