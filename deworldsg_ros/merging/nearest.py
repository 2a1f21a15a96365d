"""Search for the nearest node that passes Eq. 5 and 6, compiled: one pass over all nodes.

The kernel compares Bhattacharyya distances BD = dᵀS⁻¹d/8 + ½ ln(|S| / √(|A||B|)), S = (A + B)/2.
The Hellinger distance is a monotone function of BD. Both terms are >= 0, so a node is rejected as
soon as one term is too large. The cheapest test comes first:

1. |d|² / (4 (λ_a + λ_b)) <= dᵀS⁻¹d/8 with λ >= the largest eigenvalue: needs no inverse.
2. dᵀS⁻¹d/8 from the pivots of S: needs no logarithm.
3. BD itself.
4. D_c, which reads the whole class distribution: only for a node that would be the nearest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.gaussian import eigenvalue_bound, log_determinant
from deworldsg_ros.scene.nodes import NodeTable

# Rounding must not let a bound reject a node that passes the exact comparison.
_SLACK = 1.0 + 1e-9


class Observed(NamedTuple):
    """An object or node for which a matching node is searched.

    Attributes:
        mean: (3,) float64, metres, world frame.
        covariance: (3, 3) float64, square metres, positive definite.
        log_determinant: of the covariance, by `scene.gaussian.log_determinant`.
        eigenvalue_bound: of the covariance, by `scene.gaussian.eigenvalue_bound`.
        class_probabilities: (C,) float64, sum one.
    """

    mean: Float64
    covariance: Float64
    log_determinant: float
    eigenvalue_bound: float
    class_probabilities: Float64


# The fields of `Observed`, and the arrays of a `NodeTable` that the kernel reads, as plain tuples:
# numba is slower to call with named tuples.
_ItemArrays = tuple[Float64, Float64, float, float, Float64]
_NodeArrays = tuple[Int64, Float64, Float64, Float64, Float64, Float64]


def bhattacharyya_bound(hellinger_threshold: float) -> float:
    """B with HD < δ ⇔ BD < B: B = -ln(1 - δ²), since HD = √(1 - exp(-BD))."""
    return -math.log1p(-(hellinger_threshold**2))


def observed(mean: Float64, covariance: Float64, class_probabilities: Float64) -> Observed:
    """An object by its Gaussian, metres, world frame, and its class distribution (C,)."""
    return Observed(
        mean,
        covariance,
        log_determinant(covariance),
        eigenvalue_bound(covariance),
        class_probabilities,
    )


def nearest_row(
    item: Observed,
    nodes: NodeTable,
    bhattacharyya_bound: float,
    class_distance_threshold: float,
    skipped_row: int = -1,
) -> int:
    """Row of the node with the smallest Hellinger distance among those that pass Eq. 6.

    Args:
        item: the object or node.
        nodes: the nodes to compare with.
        bhattacharyya_bound: of the threshold δ_g.
        class_distance_threshold: δ_c.
        skipped_row: row that is not compared; -1 = none.

    Returns:
        The row; among equal distances that of the smallest id; -1 if no node passes.
    """
    table = (
        nodes.ids,
        nodes.means,
        nodes.covariances,
        nodes.log_determinants,
        nodes.eigenvalue_bounds,
        nodes.class_probabilities,
    )
    return int(_nearest(item[:], table, skipped_row, bhattacharyya_bound, class_distance_threshold))


def warm_up() -> None:
    """Compile the kernel, or load it from the cache."""
    nodes = NodeTable(1)
    row = nodes.append(1)
    nodes.put(row, np.zeros(3), np.eye(3), np.ones(1), 1.0, 1)
    nearest_row(observed(np.zeros(3), np.eye(3), np.ones(1)), nodes, 1.0, 1.0)


@kernel
def _nearest(  # pragma: no cover - compiled
    item: _ItemArrays,
    nodes: _NodeArrays,
    skipped_row: int,
    bhattacharyya_bound: float,
    class_distance_threshold: float,
) -> int:
    mean, covariance, log_determinant, eigenvalue_bound, classes = item
    ids, means, covariances, log_determinants, eigenvalue_bounds, node_classes = nodes
    a00, a10, a11 = covariance[0, 0], covariance[1, 0], covariance[1, 1]
    a20, a21, a22 = covariance[2, 0], covariance[2, 1], covariance[2, 2]
    best_row = -1
    best = bhattacharyya_bound
    best_slack = best * _SLACK
    for row in range(len(ids)):
        d0 = mean[0] - means[row, 0]
        d1 = mean[1] - means[row, 1]
        d2 = mean[2] - means[row, 2]
        squared = d0 * d0 + d1 * d1 + d2 * d2
        if squared > 4.0 * best_slack * (eigenvalue_bound + eigenvalue_bounds[row]):
            continue
        if row == skipped_row:
            continue
        # LDLᵀ of S; the operations are those of scene.gaussian.log_determinant.
        s00 = (a00 + covariances[row, 0, 0]) / 2
        s10 = (a10 + covariances[row, 1, 0]) / 2
        s11 = (a11 + covariances[row, 1, 1]) / 2
        s20 = (a20 + covariances[row, 2, 0]) / 2
        s21 = (a21 + covariances[row, 2, 1]) / 2
        s22 = (a22 + covariances[row, 2, 2]) / 2
        l10 = s10 / s00
        l20 = s20 / s00
        pivot_1 = s11 - l10 * s10
        rest = s21 - l20 * s10
        l21 = rest / pivot_1
        pivot_2 = s22 - l20 * s20 - l21 * rest
        y1 = d1 - l10 * d0
        y2 = d2 - l20 * d0 - l21 * y1
        mahalanobis = d0 * d0 / s00 + y1 * y1 / pivot_1 + y2 * y2 / pivot_2
        if mahalanobis > 8.0 * best_slack:
            continue
        log_mixed = math.log(s00 * pivot_1 * pivot_2)
        log_ratio = log_mixed - (log_determinant + log_determinants[row]) / 2
        distance = max(mahalanobis / 8 + log_ratio / 2, 0.0)
        # Among equal distances the smallest id wins; rows are in no order.
        if distance > best or (distance == best and (best_row < 0 or ids[row] > ids[best_row])):
            continue
        inner = 0.0
        for index in range(len(classes)):
            inner += classes[index] * node_classes[row, index]
        if 1.0 - inner < class_distance_threshold:
            best_row = row
            best = distance
            best_slack = best * _SLACK
    return best_row
