"""Matching of the objects of a frame with the nodes that their surfaces overlap."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.merging.assignment import assign
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.nodes import NodeTable

# Minimum overlap of a match whose classes differ. Without a match of different classes, labels that
# flip create nodes of their own (docs/dev/notebook.md).
OVERLAP_THRESHOLD_OTHER_CLASS = 0.55
# If the classes differ, at least this fraction of the object lies on the node, and of what is seen
# of the node in the object: a book on a chair covers less of it. With all faults at once, a
# rendered room keeps 50 % of its relations at 0.15, 61 % at 0.25 and 60 % at 0.4.
MIN_FRACTION_OTHER_CLASS = 0.25
# Classes agree if two labels, one drawn from each distribution, are equal with this probability.
CLASS_AGREEMENT = 0.3
# Weights of the agreement of classes and of Gaussians in the match score; the overlap fraction has
# weight 1. Objects in a row touch each other's cells: then the Gaussians disambiguate.
CLASS_WEIGHT = 0.5
GAUSSIAN_WEIGHT = 0.5
# Maximum distance of the means of a match, in standard deviations of the object's or of the node's
# Gaussian. The mean of a part of an evenly observed object lies within 3.
MAX_DEVIATIONS = 4.0


# Means, covariances and class distributions of n objects or nodes.
_Items = tuple[Float64, Float64, Float64]


class Matches(NamedTuple):
    """How n objects of a frame match k nodes.

    Attributes:
        owners: the k owners of the nodes.
        on_nodes: (n, k) float64, fraction of each object's cells that lie on each node.
        scores: (n, k) float64, 0 = no match possible.
        touching: (n, k) bool, whether the surfaces touch and the classes agree.
        columns: column of the node that each object matched, one to one; -1 = none.
    """

    owners: list[int]
    on_nodes: Float64
    scores: Float64
    touching: Bool
    columns: list[int]


def match(
    local: LocalGraph,
    nodes: NodeTable,
    rows: Int64,
    owners: list[int],
    on_nodes: Float64,
    covered: Float64,
    overlap_threshold: float,
    cell_m: float,
) -> Matches:
    """Match the objects of a frame with some nodes.

    The score of a match is overlap + CLASS_WEIGHT · Σ p q + GAUSSIAN_WEIGHT · exp(-BD), where BD is
    the Bhattacharyya distance of the two Gaussians, both blurred by the size of a cell. The overlap
    is the larger of two fractions: of the object on the node, and of the node in the object. Either
    may be a partial view of the other. If the classes differ, the smaller fraction counts, too: a
    thing on a larger one lies wholly on it.

    Args:
        local: n objects.
        nodes: the nodes of the graph.
        rows: (k,) rows of the nodes to compare with.
        owners: the owner of each.
        on_nodes: (n, k) fraction of each object's cells that lie on each node.
        covered: (n, k) fraction of each node's surface that lies in each object.
        overlap_threshold: minimum overlap of a match whose classes agree.
        cell_m: edge of a cell, metres.
    """
    scores, touching = _match_scores(
        (local.means_world, local.covariances_world, local.class_probabilities),
        (nodes.means, nodes.covariances, nodes.class_probabilities),
        rows,
        on_nodes,
        covered,
        overlap_threshold,
        # Variance of a point in a cell along each axis, if only the cell is known.
        cell_m**2 / 12,
    )
    return Matches(owners, on_nodes, scores, touching, one_to_one(scores))


def one_to_one(scores: Float64) -> list[int]:
    """One-to-one assignment with the greatest total score: column of each row, -1 = none."""
    columns: list[int] = assign(scores).tolist()
    return [c if c >= 0 and scores[row, c] > 0 else -1 for row, c in enumerate(columns)]


@kernel
def _solve(covariance: Float64, d0: float, d1: float, d2: float) -> tuple[float, float]:
    """|Σ| and dᵀΣ⁻¹d by the LDLᵀ pivots of a covariance."""
    c00 = covariance[0, 0]
    l10 = covariance[1, 0] / c00
    l20 = covariance[2, 0] / c00
    pivot_1 = covariance[1, 1] - l10 * covariance[1, 0]
    rest = covariance[2, 1] - l20 * covariance[1, 0]
    pivot_2 = covariance[2, 2] - l20 * covariance[2, 0] - rest / pivot_1 * rest
    y1 = d1 - l10 * d0
    y2 = d2 - l20 * d0 - rest / pivot_1 * y1
    squared = d0 * d0 / c00 + y1 * y1 / pivot_1 + y2 * y2 / pivot_2
    return c00 * pivot_1 * pivot_2, squared


@kernel
def _match_scores(
    objects: _Items,
    nodes: _Items,
    rows: Int64,
    on_nodes: Float64,
    covered: Float64,
    overlap_threshold: float,
    blur_m2: float,
) -> tuple[Float64, Bool]:
    means, covariances, classes = objects
    node_means, node_covariances, node_classes = nodes
    scores = np.zeros(on_nodes.shape, np.float64)
    touching = np.zeros(on_nodes.shape, np.bool_)
    a, b = np.empty((3, 3), np.float64), np.empty((3, 3), np.float64)
    both = np.empty((3, 3), np.float64)
    for index in range(len(on_nodes)):
        for column in range(len(rows)):
            on_node, cover = on_nodes[index, column], covered[index, column]
            if on_node == 0.0:
                continue
            row = rows[column]
            agreement = 0.0
            for label in range(classes.shape[1]):
                agreement += classes[index, label] * node_classes[row, label]
            agree = agreement > CLASS_AGREEMENT
            touching[index, column] = agree
            overlap = max(on_node, cover)
            if not agree and min(on_node, cover) < MIN_FRACTION_OTHER_CLASS:
                continue
            if overlap < (overlap_threshold if agree else OVERLAP_THRESHOLD_OTHER_CLASS):
                continue
            for i in range(3):
                for j in range(3):
                    blur = blur_m2 if i == j else 0.0
                    a[i, j] = covariances[index, i, j] + blur
                    b[i, j] = node_covariances[row, i, j] + blur
                    both[i, j] = (a[i, j] + b[i, j]) / 2
            d0 = means[index, 0] - node_means[row, 0]
            d1 = means[index, 1] - node_means[row, 1]
            d2 = means[index, 2] - node_means[row, 2]
            determinant_a, squared_a = _solve(a, d0, d1, d2)
            determinant_b, squared_b = _solve(b, d0, d1, d2)
            if min(squared_a, squared_b) > MAX_DEVIATIONS**2:
                continue
            determinant, squared = _solve(both, d0, d1, d2)
            likeness = math.exp(-squared / 8) * math.sqrt(
                math.sqrt(determinant_a * determinant_b) / determinant
            )
            scores[index, column] = overlap + CLASS_WEIGHT * agreement + GAUSSIAN_WEIGHT * likeness
    return scores, touching
