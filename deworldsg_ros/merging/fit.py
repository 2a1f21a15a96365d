"""How well each object of a frame fits each node that its surface lies on, and who is whom."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.nodes import NodeTable

# Minimum overlap fraction of a match whose classes differ. Without a match of different classes,
# labels that flip create nodes of their own (docs/dev/notebook.md).
OVERLAP_THRESHOLD_OTHER_CLASS = 0.55
# Maximum size ratio of two matched objects whose classes differ. A book lies wholly on the cells of
# the table below it.
SIZE_RATIO_OTHER_CLASS = 5.0
# Classes agree where two labels drawn from the two distributions are the same this often.
CLASS_AGREEMENT = 0.3
# What agreeing classes add to the share of overlap, when several nodes could be the one, and what
# equal Gaussians add: of neighbours in a row, cells alone do not tell which is meant.
CLASS_BONUS = 0.5
GAUSSIAN_BONUS = 0.5
# Means further apart than so many standard deviations, of the object's and of the node's Gaussian,
# are not of one body: that of a part lies within 3 where the whole was seen evenly.
MAX_DEVIATIONS = 4.0


def fit(
    local: LocalGraph,
    nodes: NodeTable,
    rows: Int64,
    shares: Float64,
    overlap_threshold: float,
    cell_m: float,
) -> tuple[Float64, Bool]:
    """How well each object fits each node; 0 where they cannot be the same.

    Args:
        local: n objects.
        nodes: the nodes of the graph.
        rows: (k,) those to compare with.
        shares: (n, k) how far the surfaces coincide.
        overlap_threshold: minimum overlap fraction of a match whose classes agree.
        cell_m: edge of a cell, metres.

    Returns:
        (n, k) float64: share + bonus · Σ p q + bonus · exp(-BD), with the Bhattacharyya distance
        BD of the two Gaussians, both blurred by the size of a cell; (n, k) bool: whether they touch
        and their classes agree.
    """
    result: tuple[Float64, Bool] = _fit(
        local.means_world,
        local.covariances_world,
        local.class_probabilities,
        nodes.means,
        nodes.covariances,
        nodes.class_probabilities,
        rows,
        shares,
        overlap_threshold,
        # Variance of a place that is known to be in a cell, along each axis.
        cell_m**2 / 12,
    )
    return result


def one_to_one(values: Float64) -> list[int]:
    """Column of each row, -1 = none: the assignment of greatest total value."""
    matched = [-1] * len(values)
    for row, column in zip(*(ends.tolist() for ends in linear_sum_assignment(values, True))):
        if values[row, column] > 0:
            matched[row] = column
    return matched


def warm_up() -> None:
    """Compile the comparison, or load it from the cache."""
    gaussian = (np.zeros((1, 3)), np.eye(3)[None], np.ones((1, 1)))
    _fit(*gaussian, *gaussian, np.zeros(1, np.int64), np.ones((1, 1)), 0.5, 1.0)


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
def _fit(
    means: Float64,
    covariances: Float64,
    classes: Float64,
    node_means: Float64,
    node_covariances: Float64,
    node_classes: Float64,
    rows: Int64,
    shares: Float64,
    threshold: float,
    blur_m2: float,
) -> tuple[Float64, Bool]:
    values = np.zeros(shares.shape)
    touching = np.zeros(shares.shape, np.bool_)
    blur = blur_m2 * np.eye(3)
    for index in range(len(shares)):
        for column in range(len(rows)):
            share = shares[index, column]
            if share == 0.0:
                continue
            row = rows[column]
            agreement = 0.0
            for label in range(classes.shape[1]):
                agreement += classes[index, label] * node_classes[row, label]
            agree = agreement > CLASS_AGREEMENT
            touching[index, column] = agree
            if share < (threshold if agree else OVERLAP_THRESHOLD_OTHER_CLASS):
                continue
            a = covariances[index] + blur
            b = node_covariances[row] + blur
            if not agree:
                size_a = a[0, 0] + a[1, 1] + a[2, 2]
                size_b = b[0, 0] + b[1, 1] + b[2, 2]
                if max(size_a, size_b) > SIZE_RATIO_OTHER_CLASS**2 * min(size_a, size_b):
                    continue
            d0 = means[index, 0] - node_means[row, 0]
            d1 = means[index, 1] - node_means[row, 1]
            d2 = means[index, 2] - node_means[row, 2]
            determinant_a, squared_a = _solve(a, d0, d1, d2)
            determinant_b, squared_b = _solve(b, d0, d1, d2)
            if min(squared_a, squared_b) > MAX_DEVIATIONS**2:
                continue
            determinant, squared = _solve((a + b) / 2, d0, d1, d2)
            likeness = math.exp(-squared / 8) * math.sqrt(
                math.sqrt(determinant_a * determinant_b) / determinant
            )
            values[index, column] = share + CLASS_BONUS * agreement + GAUSSIAN_BONUS * likeness
    return values, touching
