"""Merging and relation fusion, composed: local graphs and relation evidence become the graph.

The graph node and the in-process pipeline both run this, so that they end with the same graph.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from deworldsg_ros.config import Config, MergingConfig
from deworldsg_ros.merging.stage import build_merging
from deworldsg_ros.relations.consistency import Consistency
from deworldsg_ros.relations.evidence import (
    PROVENANCES,
    FusedEdges,
    bounded_logits,
    choose_directions,
    fuse_edges,
)
from deworldsg_ros.relations.prior import ClassPairPrior
from deworldsg_ros.scene import graph_io as storage
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import check_pose
from deworldsg_ros.scene.correction import nodes_since
from deworldsg_ros.scene.delta import diff
from deworldsg_ros.scene.edges import EdgeEvidence, Pair
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence, Vocabulary
from deworldsg_ros.scene.graph import SceneGraph

# Before the names of what the merging remembers, in a map.
MEMORY = "merging."


def check_map_writable(path: Path) -> None:
    """Make a map's folder; raises ConfigurationError where the map could not be written there."""
    with _writing(path):
        storage.check_writable(path)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigurationError(f"map {path} cannot be written: {error.strerror}") from error


class GraphBuilder:
    """Keeps the global graph, and tells what of it is published.

    Args:
        config: sections ``merging``, ``relations`` and ``output`` are used.
        vocabulary: of every local graph that will come.
        frame_id: world frame of every local graph that will come.
    """

    def __init__(self, config: Config, vocabulary: Vocabulary, frame_id: str) -> None:
        self._relations = config.relations
        self._output = config.output
        self._merging = build_merging(config.merging)
        self.graph = SceneGraph(vocabulary, frame_id, **_graph_settings(config.merging))
        self.prior = ClassPairPrior(len(vocabulary.classes), len(vocabulary.predicates))
        self._consistency = Consistency(vocabulary.predicates)
        # Of each pair what its edge was last made of, and the edge.
        self._edges: dict[Pair, tuple[tuple[int, ...], wire.EdgeState | None]] = {}
        self._newest_ns: int | None = None
        # Newest stamp of the map that this goes on with; frames to come may be older.
        self._map_ns = 0
        # Of frames that nothing remembers any more, nobody need be told.
        self._associations: deque[wire.Association] = deque(maxlen=self.graph.remembered_frames)
        self._published = self._message(0, self._output.surface_points)

    @classmethod
    def from_map(cls, config: Config, path: Path) -> GraphBuilder:
        """Go on with the graph of a map that `save_map` wrote; the first `update` tells all of it.

        What was tentative then is left behind: nobody was told of it.

        Raises:
            ConfigurationError: where the file is no such map.
        """
        try:
            state = storage.read(path)
            graph = storage.graph_of(state, str(path), **_graph_settings(config.merging))
            builder = cls(config, graph.vocabulary, graph.frame_id)
            builder.graph = graph
            prior = ClassPairPrior.from_state(json.loads(state["prior"].tobytes()))
            if (prior.class_count, prior.predicate_count) != (
                builder.prior.class_count,
                builder.prior.predicate_count,
            ):
                raise ValueError("of other classes or predicates than the graph's")
            for node_id in graph.nodes.ids[~graph.nodes.confirmed].tolist():
                graph.remove_node(node_id)
            graph.take_removals()
            builder._merging.restore(
                graph,
                {
                    name.removeprefix(MEMORY): values
                    for name, values in state.items()
                    if name.startswith(MEMORY)
                },
            )
        except (RefusedInput, KeyError, TypeError, ValueError, IndexError) as error:
            seen = storage.told(error).removeprefix(f"graph file {path}: ")
            raise ConfigurationError(f"map {path} cannot be used: {seen}") from error
        builder.prior = prior
        builder._map_ns = int(graph.nodes.last_seen_ns.max(initial=0))
        return builder

    @property
    def confirmed(self) -> int:
        """Number of nodes that are not tentative."""
        return int(self.graph.nodes.confirmed.sum())

    def save_map(self, path: Path) -> None:
        """Write all that a later run needs to go on: graph, memory of the merging, and priors.

        Raises:
            ConfigurationError: where it cannot be written; what was there is then still there.
        """
        prior = np.frombuffer(json.dumps(self.prior.to_state()).encode(), np.uint8)
        memory = {MEMORY + name: values for name, values in self._merging.memory().items()}
        with _writing(path):
            storage.write(path, {**storage.state_of(self.graph), **memory, "prior": prior})

    def integrate(self, local: LocalGraph) -> list[int]:
        """Merge a frame's local graph; returns the node id of each of its rows.

        Raises:
            RefusedInput: ``out_of_order`` for a frame not newer than the newest one, and what
                `Merging.merge` refuses.
        """
        if self._newest_ns is not None and local.stamp_ns <= self._newest_ns:
            raise RefusedInput(
                "out_of_order",
                f"local graph of {local.stamp_ns} ns came after that of {self._newest_ns} ns",
            )
        logits = bounded_logits(local.relations.logits, self._relations.outlier_rate)
        relations = replace(local.relations, logits=logits)
        node_ids = self._merging.merge(self.graph, replace(local, relations=relations))
        self._newest_ns = local.stamp_ns
        self._associations.append(
            wire.Association(wire.stamp_from_ns(local.stamp_ns), list(node_ids))
        )
        return node_ids

    def add_evidence(self, evidence: RelationEvidence) -> None:
        """Take in neighbour pairs, and predictions where there are some.

        Raises:
            RefusedInput: ``vocabulary_mismatch``; ``unknown_frame`` where no local graph with
                that stamp is remembered.
        """
        self._check_vocabulary(evidence.vocabulary)
        node_ids = self.graph.nodes_of_frame(evidence.stamp_ns)
        if node_ids is None or (len(evidence.pairs) and evidence.pairs.max() >= len(node_ids)):
            raise RefusedInput(
                "unknown_frame",
                f"relation evidence for {evidence.stamp_ns} ns: no local graph of that frame "
                "is remembered",
            )
        self.prior.update(evidence.pair_classes, evidence.predictions)
        # Its pair is named as a neighbour by a message of its own.
        for subject, object_ in evidence.pairs[~evidence.predicted].tolist():
            self.graph.add_neighbour(node_ids[subject], node_ids[object_], evidence.stamp_ns)

    def apply_correction(self, T_correction: Float64, since_ns: int) -> list[int]:
        """Move what was first seen since a stamp along with the poses, after a loop closure.

        Nodes known before stay, also where they were seen again since: see `scene.correction`.
        Frames still to come have to carry corrected poses.

        Args:
            T_correction: (4, 4), takes points of the world as it was into the world as it is.
            since_ns: stamp of the first pose that was corrected.

        Returns:
            The ids of the nodes that moved.

        Raises:
            RefusedInput: ``invalid_pose`` where it is no rigid transform.
        """
        check_pose(T_correction)
        node_ids = nodes_since(self.graph, since_ns)
        for node_id in node_ids:
            self.graph.move_node(node_id, T_correction)
        self._merging.moved(self.graph, node_ids, T_correction)
        return node_ids

    def update(self) -> wire.SceneGraphUpdateMessage | None:
        """What changed since this was last called; None where nothing did."""
        current = self._message(self._published.sequence + 1, self._output.surface_points)
        removed = self.graph.take_removals()
        same = (current.nodes, current.edges) == (self._published.nodes, self._published.edges)
        if same and not removed:
            return None
        message = diff(self._published, current, removed, self._associations)
        self._associations.clear()
        self._published = current
        return message

    def snapshot(self) -> wire.SceneGraphMessage:
        """The graph as of the last `update`."""
        return self._published

    def full(self) -> wire.SceneGraphMessage:
        """The graph as it is now, with surface points; no update is made of it."""
        return self._message(self._published.sequence, with_points=True)

    def _message(self, sequence: int, with_points: bool) -> wire.SceneGraphMessage:
        nodes = self.graph.node_states(
            self._output.top_k, self._output.tentative_nodes, with_points
        )
        pairs = [pair for pair in sorted(self.graph.edges) if pair[0] in nodes and pair[1] in nodes]
        return wire.SceneGraphMessage(
            schema=wire.schema_of(wire.SceneGraphMessage),
            stamp=wire.stamp_from_ns(self._newest_ns or self._map_ns),
            frame_id=self.graph.frame_id,
            sequence=sequence,
            nodes=list(nodes.values()),
            edges=self._edge_states(pairs),
        )

    def _edge_states(self, pairs: Sequence[Pair]) -> list[wire.EdgeState]:
        """Messages of the edges of which something is believed; those that stay are the same."""
        bases = self._bases_of(pairs)
        stale = [
            pair
            for pair, basis in bases.items()
            if pair not in self._edges or self._edges[pair][0] != basis
        ]
        made = self._make_edges(stale)
        self._edges = {
            pair: (basis, made[pair] if pair in made else self._edges[pair][1])
            for pair, basis in bases.items()
        }
        return [state for _, state in self._edges.values() if state is not None]

    def _bases_of(self, pairs: Sequence[Pair]) -> dict[Pair, tuple[int, ...]]:
        """What each edge is made of, by revisions: evidence, classes, priors, of both directions.

        Both directions, because the one has a say in what is told of the other.
        """
        if not pairs:
            return {}
        edges = self.graph.edges
        classes = self._classes_of(pairs)
        there, back = self.prior.revisions(classes), self.prior.revisions(classes[:, ::-1])
        priors = np.column_stack([classes, there, back]).tolist()
        reverse = [edges.get((object_, subject)) for subject, object_ in pairs]
        return {
            pair: (edges[pair].revision, other.revision if other else 0, *prior)
            for pair, other, prior in zip(pairs, reverse, priors)
        }

    def _make_edges(self, pairs: Sequence[Pair]) -> dict[Pair, wire.EdgeState | None]:
        """Messages of edges (Eq. 9-10); None where nothing is believed."""
        made: dict[Pair, wire.EdgeState | None] = dict.fromkeys(pairs)
        if not pairs:
            return made
        evidence = [self.graph.edges[pair] for pair in pairs]
        logits = np.array([item.visual_logits for item in evidence])
        has_visual = np.array([item.frames > 0 for item in evidence])
        priors, has_prior = self.prior.lookup(self._classes_of(pairs))
        fused = fuse_edges(
            logits,
            has_visual,
            priors,
            has_prior,
            self._relations.fusion_alpha,
            self._relations.entropy_threshold_nats,
        )
        if self._relations.consistent_directions:
            fused = self._consistency.reconcile(pairs, logits, has_visual, fused)
        known = np.flatnonzero(fused.known)
        chosen = choose_directions(
            [pairs[row] for row in known.tolist()], has_visual[known], fused.probabilities[known]
        )
        for row in known[chosen].tolist():
            made[pairs[row]] = self._edge_state(pairs[row], evidence[row], fused, row)
        return made

    def _classes_of(self, pairs: Sequence[Pair]) -> np.ndarray:
        """Arg-max classes of the ends of each pair, (E, 2) int64."""
        table = self.graph.nodes
        classes = table.class_probabilities.argmax(axis=1)
        rows = np.array([[table.row(subject), table.row(object_)] for subject, object_ in pairs])
        return np.asarray(classes[rows], np.int64)

    def _edge_state(
        self, pair: Pair, evidence: EdgeEvidence, fused: FusedEdges, row: int
    ) -> wire.EdgeState:
        predicates = self.graph.vocabulary.predicates
        probabilities = fused.probabilities[row]
        best = np.argsort(-probabilities, kind="stable")[: self._output.top_k].tolist()
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

    def _check_vocabulary(self, vocabulary: Vocabulary) -> None:
        if vocabulary != self.graph.vocabulary:
            known = self.graph.vocabulary
            raise RefusedInput(
                "vocabulary_mismatch",
                f"message has {len(vocabulary.classes)} classes and {len(vocabulary.predicates)} "
                f"predicates; the graph was begun with {len(known.classes)} and "
                f"{len(known.predicates)}, or others of that number (do all nodes run with one "
                "configuration?)",
            )


def _graph_settings(merging: MergingConfig) -> dict[str, Any]:
    return {
        "surface_point_capacity": merging.surface_points,
        "even_gaussians": merging.association == "surface" and merging.even_gaussians,
    }
