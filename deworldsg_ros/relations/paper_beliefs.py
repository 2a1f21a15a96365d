"""The beliefs of edges as in the paper (Eq. 9-10), rebuilt only where something changed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import UNSET

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.evidence import PROVENANCES, fuse_edges
from deworldsg_ros.relations.prior import Prior
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.beliefs import DECIMALS, Listed, listed
from deworldsg_ros.scene.edges import Pair
from deworldsg_ros.scene.graph import SceneGraph


class PaperBeliefs:
    """Computes the messages of the edges of a graph, each direction for itself.

    Args:
        config: `fusion_alpha` and `entropy_threshold_nats` are used.
        graph: whose edges these are.
        top_k: number of predicates in the message of an edge.

    Attributes:
        states: the messages by subject and object; those that did not change are the same objects.
    """

    def __init__(self, config: RelationsConfig, graph: SceneGraph, top_k: int) -> None:
        self._config = config
        self._graph = graph
        self._top_k = top_k
        self.states: dict[Pair, wire.EdgeState] = {}
        self._touched = graph.watch_nodes()
        # Classes of subject and object of each pair of published nodes, and the pairs of each two.
        self._classes: dict[Pair, tuple[int, int]] = {}
        self._by_classes: dict[tuple[int, int], set[Pair]] = {}
        # Classes of the published nodes.
        self._class_of: dict[int, int] = {}

    def refresh(self, prior: Prior) -> list[Pair]:
        """Bring `states` up to date; returns the pairs with another message, or none.

        Args:
            prior: of class pairs.
        """
        touched = self._graph.take_changed_edges() | self._follow_nodes()
        for classes in prior.changed:
            touched |= self._by_classes.get(classes, set())
        prior.changed.clear()
        pairs = sorted(pair for pair in touched if self._index(pair))
        made = self._make(pairs, *prior.lookup(self._pair_classes(pairs)))
        changed = []
        for pair in touched:
            state, known = made.get(pair), self.states.get(pair)
            if state == known:
                continue
            changed.append(pair)
            if state is None:
                del self.states[pair]
            else:
                self.states[pair] = state
        return changed

    def _follow_nodes(self) -> set[Pair]:
        """Pairs of the nodes that came, went or have another class now."""
        nodes, edits, names = self._graph.nodes, self._graph.edits, self._graph.vocabulary
        pairs = set()
        for node_id in self._touched:
            best = -1
            if node_id in nodes and nodes.confirmed[row := nodes.row(node_id)]:
                best = int(edits.believed_classes(nodes, names, [row]).argmax())
            if self._class_of.get(node_id, -1) == best:
                continue
            self._class_of[node_id] = best
            if best < 0:
                del self._class_of[node_id]
            for other in self._graph.partners(node_id):
                pairs.update({(node_id, other), (other, node_id)})
        self._touched.clear()
        return pairs

    def _index(self, pair: Pair) -> bool:
        """Note the classes of a pair; false if it is no pair of published nodes."""
        if pair in self._classes:
            self._by_classes[self._classes.pop(pair)].discard(pair)
        if pair not in self._graph.edges or not (self._class_of.keys() >= set(pair)):
            return False
        classes = self._class_of[pair[0]], self._class_of[pair[1]]
        self._classes[pair] = classes
        self._by_classes.setdefault(classes, set()).add(pair)
        return True

    def _pair_classes(self, pairs: Sequence[Pair]) -> Int64:
        return np.array([self._classes[pair] for pair in pairs], np.int64).reshape(-1, 2)

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
        rows = np.flatnonzero(fused.known).tolist()
        names = self._graph.vocabulary.predicates
        for row, told in zip(rows, listed(fused.probabilities[rows], names, self._top_k)):
            made[pairs[row]] = edge_state(
                pairs[row],
                told,
                provenance=PROVENANCES[fused.provenance_codes[row]],
                entropy_nats=float(fused.entropies_nats[row]),
                observations=evidence[row].frames,
            )
        return made


def edge_state(
    pair: Pair,
    told: Listed,
    *,
    provenance: wire.Provenance,
    entropy_nats: float,
    observations: int,
    shown: int | None = None,
    mutual: bool = False,
) -> wire.EdgeState:
    """The message of an edge with the probabilities of its predicates."""
    return wire.EdgeState(
        subject=pair[0],
        object=pair[1],
        predicate=told.beliefs[0].label,
        probability=told.beliefs[0].probability,
        predicates=told.beliefs,
        provenance=provenance,
        entropy_nats=round(entropy_nats, DECIMALS),
        observations=observations,
        remainder=told.remainder,
        shown=UNSET if shown is None else shown,
        mutual=mutual or UNSET,
    )
