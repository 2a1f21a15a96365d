"""The beliefs of edges as in the paper (Eq. 9-10), rebuilt only where something changed."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.evidence import PROVENANCES, FusedEdges, fuse_edges
from deworldsg_ros.relations.prior import ClassPairPrior
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.edges import EdgeEvidence, Pair
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.node_states import best_beliefs

# What a belief is computed from: revision of the evidence, classes, and the prior as bytes.
_Basis = tuple[int, int, int, bytes]


class PaperBeliefs:
    """Computes the messages of the edges of a graph, each direction for itself.

    Args:
        config: `fusion_alpha` and `entropy_threshold_nats` are used.
        graph: whose edges these are.
        top_k: number of predicates in the message of an edge.
    """

    def __init__(self, config: RelationsConfig, graph: SceneGraph, top_k: int) -> None:
        self._config = config
        self._graph = graph
        self._top_k = top_k
        # The last message of each pair, with its basis; None = no belief, no edge.
        self._known: dict[Pair, tuple[_Basis, wire.EdgeState | None]] = {}

    def states(self, node_ids: Collection[int], prior: ClassPairPrior) -> list[wire.EdgeState]:
        """Messages of the edges between these nodes; unchanged messages are the same objects.

        Args:
            node_ids: of published nodes.
            prior: of class pairs.
        """
        pairs = [p for p in sorted(self._graph.edges) if p[0] in node_ids and p[1] in node_ids]
        if not pairs:
            self._known = {}
            return []
        classes = self._classes(pairs)
        priors, has_prior = prior.lookup(classes)
        bases = {
            pair: (self._graph.edges[pair].revision, *ends, priors[row].tobytes())
            for row, (pair, ends) in enumerate(zip(pairs, classes.tolist()))
        }
        stale = [
            row
            for row, (pair, basis) in enumerate(bases.items())
            if pair not in self._known or self._known[pair][0] != basis
        ]
        made = self._make([pairs[row] for row in stale], priors[stale], has_prior[stale])
        self._known = {
            pair: (basis, made[pair] if pair in made else self._known[pair][1])
            for pair, basis in bases.items()
        }
        return [state for _, state in self._known.values() if state is not None]

    def _make(
        self, pairs: Sequence[Pair], priors: Float64, has_prior: Bool
    ) -> dict[Pair, wire.EdgeState | None]:
        """Messages of edges (Eq. 9-10); None = no belief."""
        made: dict[Pair, wire.EdgeState | None] = dict.fromkeys(pairs)
        if not pairs:
            return made
        evidence = [self._graph.edges[pair] for pair in pairs]
        logits = np.array([item.visual_logits for item in evidence])
        has_visual = np.array([item.frames > 0 for item in evidence])
        fused = fuse_edges(
            logits,
            has_visual,
            priors,
            has_prior,
            self._config.fusion_alpha,
            self._config.entropy_threshold_nats,
        )
        for row in np.flatnonzero(fused.known).tolist():
            made[pairs[row]] = self._state(pairs[row], evidence[row], fused, row)
        return made

    def _classes(self, pairs: Sequence[Pair]) -> Int64:
        """Arg-max classes of subject and object of each pair, (E, 2)."""
        table = self._graph.nodes
        classes = table.class_probabilities.argmax(axis=1)
        rows = np.array([[table.row(subject), table.row(object_)] for subject, object_ in pairs])
        return np.asarray(classes[rows], np.int64)

    def _state(
        self, pair: Pair, evidence: EdgeEvidence, fused: FusedEdges, row: int
    ) -> wire.EdgeState:
        return edge_state(
            pair,
            fused.probabilities[row],
            self._graph.vocabulary.predicates,
            self._top_k,
            provenance=PROVENANCES[fused.provenance_codes[row]],
            entropy_nats=float(fused.entropies_nats[row]),
            observations=evidence.frames,
        )


def edge_state(
    pair: Pair,
    probabilities: Float64,
    predicates: Sequence[str],
    top_k: int,
    *,
    provenance: wire.Provenance,
    entropy_nats: float,
    observations: int,
) -> wire.EdgeState:
    """The message of an edge with the probabilities (R,) of its predicates, the best first."""
    beliefs = best_beliefs(probabilities, predicates, top_k)
    return wire.EdgeState(
        subject=pair[0],
        object=pair[1],
        predicate=beliefs[0].label,
        probability=beliefs[0].probability,
        predicates=beliefs,
        provenance=provenance,
        entropy_nats=entropy_nats,
        observations=observations,
    )
