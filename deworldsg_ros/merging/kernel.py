"""The search for the node to merge with, compiled: Eq. 5 and 6 over all global nodes in one pass.

The distance is compared as Bhattacharyya distance BD = dᵀS⁻¹d/8 + ½ ln(|S| / √(|A||B|)) with
S = (A + B)/2, of which the Hellinger distance is a monotone function. Both terms are >= 0, so a
node is out as soon as one alone is too large, and cheapest first:

1. |d|² / (4 (λ_a + λ_b)) <= dᵀS⁻¹d/8 with λ no smaller than the largest eigenvalues: no inverse.
2. dᵀS⁻¹d/8 from the pivots of S: no logarithm.
3. BD itself.
4. D_c, which reads the whole class distribution, only for a node that would be the nearest.
"""

from __future__ import annotations

import math

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.nodes import NodeTable

# Rounding must not let a bound reject what the exact comparison would keep.
_SLACK = 1.0 + 1e-9


@kernel
def _nearest(  # pragma: no cover - compiled
    mean: Float64,
    covariance: Float64,
    log_determinant: float,
    eigenvalue_bound: float,
    class_probabilities: Float64,
    skipped_row: int,
    ids: Int64,
    means: Float64,
    covariances: Float64,
    log_determinants: Float64,
    eigenvalue_bounds: Float64,
    all_class_probabilities: Float64,
    bhattacharyya_bound: float,
    class_distance_threshold: float,
) -> int:
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
        # Of equal distances the smallest id; rows are in no order.
        if distance > best or (distance == best and (best_row < 0 or ids[row] > ids[best_row])):
            continue
        inner = 0.0
        for index in range(len(class_probabilities)):
            inner += class_probabilities[index] * all_class_probabilities[row, index]
        if 1.0 - inner < class_distance_threshold:
            best_row = row
            best = distance
            best_slack = best * _SLACK
    return best_row


def nearest_row(
    mean_world: Float64,
    covariance_world: Float64,
    log_determinant: float,
    eigenvalue_bound: float,
    class_probabilities: Float64,
    nodes: NodeTable,
    bhattacharyya_bound: float,
    class_distance_threshold: float,
    skipped_row: int = -1,
) -> int:
    """Row of the node with the smallest Hellinger distance among those that pass Eq. 6.

    Args:
        mean_world: (3,) metres.
        covariance_world: (3, 3) square metres, positive definite.
        log_determinant: of the covariance, by `scene.gaussian.log_determinant`.
        eigenvalue_bound: of the covariance, by `scene.gaussian.eigenvalue_bound`.
        class_probabilities: (C,), summing to one.
        nodes: the nodes to compare with.
        bhattacharyya_bound: `gates.bhattacharyya_bound` of the threshold δ_g.
        class_distance_threshold: δ_c.
        skipped_row: row not to compare with; -1 = none.

    Returns:
        The row, of equal distances that with the smallest id; -1 where nothing passes.
    """
    return int(
        _nearest(
            mean_world,
            covariance_world,
            log_determinant,
            eigenvalue_bound,
            class_probabilities,
            skipped_row,
            nodes.ids,
            nodes.means,
            nodes.covariances,
            nodes.log_determinants,
            nodes.eigenvalue_bounds,
            nodes.class_probabilities,
            bhattacharyya_bound,
            class_distance_threshold,
        )
    )


def warm_up() -> None:
    """Compile the kernel, or load it from the cache."""
    nodes = NodeTable(1)
    row = nodes.append(1)
    nodes.put(row, np.zeros(3), np.eye(3), np.ones(1), 1.0, 1)
    nearest_row(np.zeros(3), np.eye(3), 0.0, 2.0, np.ones(1), nodes, 1.0, 1.0)
