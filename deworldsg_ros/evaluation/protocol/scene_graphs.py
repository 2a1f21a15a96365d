"""Conversion of scene graphs of this package to predictions of the protocol."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.protocol.predictions import ScanPrediction
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.extent import surface_points
from deworldsg_ros.scene.frame_graph import Vocabulary

# About the number of surface points that one observation adds to a node.
POINTS_PER_OBSERVATION = 64


def to_prediction(
    graph: wire.SceneGraphMessage, vocabulary: Vocabulary, *, sampled: bool = True
) -> ScanPrediction:
    """Nodes with their surface points, edges with their predicate distributions, in graph order.

    Of several predictions for one object the protocol takes the one with most points. A graph
    stores a bounded sample of each surface; therefore the first `POINTS_PER_OBSERVATION` points
    count once per observation of the node.

    A graph contains the k most probable labels. The rest of the probability is spread evenly over
    the other labels. Classes outside the vocabulary are left out (see `labels`).

    Args:
        graph: scene graph with surface points.
        vocabulary: classes and predicates of the data set.
        sampled: False if the graph contains all points of a node; then each point counts once.

    Raises:
        EvaluationError: all classes, or some predicate, are outside the vocabulary.
    """
    classes = {name: index for index, name in enumerate(vocabulary.classes)}
    predicates = {name: index for index, name in enumerate(vocabulary.predicates)}
    index_of = {node.id: index for index, node in enumerate(graph.nodes)}
    points = tuple(_segment(node) if sampled else surface_points(node) for node in graph.nodes)
    labels = {belief.label for node in graph.nodes for belief in node.classes}
    if labels and not labels & set(classes):
        raise _foreign("class", labels)
    unknown = {belief.label for edge in graph.edges for belief in edge.predicates} - set(predicates)
    if unknown:
        raise _foreign("predicate", unknown)
    class_scores = [_expand(node.classes, classes) for node in graph.nodes]
    edge_scores = [_expand(edge.predicates, predicates) for edge in graph.edges]
    edges = [(index_of[edge.subject], index_of[edge.object]) for edge in graph.edges]
    return ScanPrediction(
        points,
        np.array(class_scores).reshape(-1, len(classes)),
        np.array(edges, np.int64).reshape(-1, 2),
        np.array(edge_scores).reshape(-1, len(predicates)),
        [] if all(map(len, points)) else ["a node has no surface points: it supports no object"],
    )


def _segment(node: wire.NodeState) -> Float64:
    """Points (n, 3) of a node. The stored sample is in random order, so its start is random too."""
    return np.tile(surface_points(node)[:POINTS_PER_OBSERVATION], (node.observations, 1))


def _expand(beliefs: Sequence[wire.Belief], indices: dict[str, int]) -> Float64:
    others = len(indices) - sum(belief.label in indices for belief in beliefs)
    left = max(0.0, 1.0 - sum(belief.probability for belief in beliefs))
    scores = np.full(len(indices), left / others if others else 0.0)
    for belief in beliefs:
        if belief.label in indices:
            scores[indices[belief.label]] = belief.probability
    return scores


def _foreign(kind: str, labels: set[str]) -> EvaluationError:
    return EvaluationError(
        f"scene graph has the {kind} '{min(labels)}', which is not in the data set: make the graph "
        "with the vocabulary of the data set"
    )
