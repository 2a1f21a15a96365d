"""The beliefs of the edges of the global graph (Eq. 9-10), rebuilt only where something changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.consistency import Consistency
from deworldsg_ros.relations.evidence import (
    OUTLIER_RATE,
    PROVENANCES,
    FusedEdges,
    bounded_logits,
    choose_directions,
    fuse_edges,
)
from deworldsg_ros.relations.prior import ClassPairPrior
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.edges import EdgeEvidence, Pair
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence
from deworldsg_ros.scene.graph import SceneGraph

# Revisions of everything that a belief is computed from.
_Basis = tuple[int, ...]


class EdgeBeliefs:
    """Takes relation evidence into a graph and computes the messages of its edges.

    Args:
        config: `edge_belief`, `fusion_alpha` and `entropy_threshold_nats` are used.
        graph: whose edges these are.
        prior: of class pairs.
        top_k: number of predicates in the message of an edge.

    Attributes:
        prior: of class pairs.
    """

    def __init__(
        self, config: RelationsConfig, graph: SceneGraph, prior: ClassPairPrior, top_k: int
    ) -> None:
        self.prior = prior
        self._config = config
        self._graph = graph
        self._top_k = top_k
        robust = config.edge_belief == "robust"
        self._consistency = Consistency(graph.vocabulary.predicates) if robust else None
        # The last message of each pair, with its basis; None = no belief, no edge.
        self._known: dict[Pair, tuple[_Basis, wire.EdgeState | None]] = {}

    def weigh(self, local: LocalGraph) -> LocalGraph:
        """A frame's local graph with the relation logits as they enter the sum of Eq. 9."""
        if self._config.edge_belief == "paper":
            return local
        logits = bounded_logits(local.relations.logits, OUTLIER_RATE)
        return replace(local, relations=replace(local.relations, logits=logits))

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

    def states(self, pairs: Sequence[Pair]) -> list[wire.EdgeState]:
        """Messages of the pairs that have a belief; unchanged messages are the same objects."""
        bases = self._bases(pairs)
        stale = [
            pair
            for pair, basis in bases.items()
            if pair not in self._known or self._known[pair][0] != basis
        ]
        made = self._make(stale)
        self._known = {
            pair: (basis, made[pair] if pair in made else self._known[pair][1])
            for pair, basis in bases.items()
        }
        return [state for _, state in self._known.values() if state is not None]

    def _bases(self, pairs: Sequence[Pair]) -> dict[Pair, _Basis]:
        """Revisions of evidence, classes and priors of each pair, in both directions.

        Both, because the belief of one direction depends on the evidence of the other.
        """
        if not pairs:
            return {}
        edges = self._graph.edges
        classes = self._classes(pairs)
        there, back = self.prior.revisions(classes), self.prior.revisions(classes[:, ::-1])
        priors = np.column_stack([classes, there, back]).tolist()
        reverse = [edges.get((object_, subject)) for subject, object_ in pairs]
        return {
            pair: (edges[pair].revision, other.revision if other else 0, *prior)
            for pair, other, prior in zip(pairs, reverse, priors)
        }

    def _make(self, pairs: Sequence[Pair]) -> dict[Pair, wire.EdgeState | None]:
        """Messages of edges (Eq. 9-10); None = no belief."""
        made: dict[Pair, wire.EdgeState | None] = dict.fromkeys(pairs)
        if not pairs:
            return made
        evidence = [self._graph.edges[pair] for pair in pairs]
        logits = np.array([item.visual_logits for item in evidence])
        has_visual = np.array([item.frames > 0 for item in evidence])
        priors, has_prior = self.prior.lookup(self._classes(pairs))
        fused = fuse_edges(
            logits,
            has_visual,
            priors,
            has_prior,
            self._config.fusion_alpha,
            self._config.entropy_threshold_nats,
        )
        if self._consistency is not None:
            fused = self._consistency.reconcile(pairs, logits, has_visual, fused)
        known = np.flatnonzero(fused.known)
        chosen = choose_directions(
            [pairs[row] for row in known.tolist()], has_visual[known], fused.probabilities[known]
        )
        for row in known[chosen].tolist():
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
        predicates = self._graph.vocabulary.predicates
        probabilities = fused.probabilities[row]
        best = np.argsort(-probabilities, kind="stable")[: self._top_k].tolist()
        beliefs = [wire.Belief(predicates[index], float(probabilities[index])) for index in best]
        return wire.EdgeState(
            subject=pair[0],
            object=pair[1],
            predicate=beliefs[0].label,
            probability=beliefs[0].probability,
            predicates=beliefs,
            provenance=PROVENANCES[fused.provenance_codes[row]],
            entropy_nats=float(fused.entropies_nats[row]),
            observations=evidence.frames,
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
