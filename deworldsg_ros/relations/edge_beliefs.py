"""The beliefs of the edges of the global graph: evidence in, messages out."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

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
from deworldsg_ros.relations.predicted_prior import predicted_prior
from deworldsg_ros.relations.prior import ClassPairPrior
from deworldsg_ros.relations.robust_beliefs import DirectedBeliefs, RobustBeliefs
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.edges import Pair
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence, derived
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.up import UpEstimator
from deworldsg_ros.scene.votes import frame_votes

# Votes of objects whose means are farther apart are not counted.
MAX_DISTANCE_M = 2.5
# An edge is published if its best predicate has at least this probability.
MIN_PROBABILITY = 0.2
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
        # The last message of each pair, with what it was made from.
        self._known: dict[Pair, tuple[Any, wire.EdgeState]] = {}

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

    def states(self, node_ids: Collection[int]) -> list[wire.EdgeState]:
        """Messages of the edges between nodes, in order; unchanged ones are the same objects.

        Args:
            node_ids: of the published nodes.
        """
        prior = self.prior
        if self._robust or self._has_predictions:
            self._table.refresh(self.up.up_world())
        if self._has_predictions:
            prior = predicted_prior(self._table, self._graph)
        if not self._robust:
            return self._paper_beliefs.states(node_ids, prior)
        return self._messages(self._robust_beliefs.beliefs(prior))

    def _messages(self, beliefs: DirectedBeliefs) -> list[wire.EdgeState]:
        """Messages of the edges that are probable enough."""
        rounded = np.round(beliefs.probabilities, DECIMALS)
        rows = np.flatnonzero(rounded.max(axis=1, initial=0.0) >= MIN_PROBABILITY)
        order = np.lexsort((beliefs.pairs[rows, 1], beliefs.pairs[rows, 0]))
        known: dict[Pair, tuple[Any, wire.EdgeState]] = {}
        for row in rows[order].tolist():
            pair = (int(beliefs.pairs[row, 0]), int(beliefs.pairs[row, 1]))
            evidence = self._graph.edges.get(pair)
            basis = (rounded[row].tobytes(), evidence and evidence.revision, beliefs.sources(row))
            last = self._known.get(pair)
            known[pair] = last if last and last[0] == basis else (
                basis, self._message(pair, rounded[row], beliefs.sources(row))
            )  # fmt: skip
        self._known = known
        return [state for _, state in known.values()]

    def _message(
        self, pair: Pair, probabilities: Float64, provenance: wire.Provenance
    ) -> wire.EdgeState:
        evidence = self._graph.edges.get(pair)
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
