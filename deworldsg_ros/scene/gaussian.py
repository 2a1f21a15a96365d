"""Batches of 3D Gaussians: change of frame, Hellinger distance, fusion.

Leading dimensions broadcast: means are (..., 3) in metres, covariances (..., 3, 3) in square
metres, all float64.
"""

from __future__ import annotations

import math

import numpy as np

from deworldsg_ros.scene.arrays import Float64


def transform(means: Float64, covariances: Float64, T: Float64) -> tuple[Float64, Float64]:
    """Gaussians under a rigid transform (4, 4): μ → Rμ + t, Σ → RΣRᵀ."""
    rotation = T[:3, :3]
    moved = rotation @ covariances @ rotation.T
    # Rounding can make the product asymmetric.
    return means @ rotation.T + T[:3, 3], (moved + np.swapaxes(moved, -1, -2)) / 2


def bhattacharyya_distance(
    mean_a: Float64, covariance_a: Float64, mean_b: Float64, covariance_b: Float64
) -> Float64:
    """BD = dᵀS⁻¹d / 8 + ½ ln(|S| / √(|A||B|)), S = (A + B) / 2; clamped at >= 0.

    The clamp is necessary: for two equal Gaussians, rounding can give a negative value, and the
    Hellinger distance would be NaN.
    """
    mixed = (covariance_a + covariance_b) / 2
    difference = mean_a - mean_b
    # Same number of axes as the matrices: numpy 1 and 2 differ for a single vector.
    shape = np.broadcast_shapes(difference.shape, mixed.shape[:-1])
    solved = np.linalg.solve(mixed, np.broadcast_to(difference, shape)[..., None])[..., 0]
    mahalanobis = np.sum(difference * solved, axis=-1)
    log_ratio = (
        np.linalg.slogdet(mixed)[1]
        - (np.linalg.slogdet(covariance_a)[1] + np.linalg.slogdet(covariance_b)[1]) / 2
    )
    return np.asarray(np.maximum(mahalanobis / 8 + log_ratio / 2, 0.0))


def hellinger_distance(
    mean_a: Float64, covariance_a: Float64, mean_b: Float64, covariance_b: Float64
) -> Float64:
    """HD = √(1 - exp(-BD)), in [0, 1] (the distance of Eq. 6)."""
    return np.sqrt(-np.expm1(-bhattacharyya_distance(mean_a, covariance_a, mean_b, covariance_b)))


def fuse(
    weight_i: float,
    mean_i: Float64,
    covariance_i: Float64,
    weight_j: float,
    mean_j: Float64,
    covariance_j: Float64,
) -> tuple[Float64, Float64]:
    """Moment-preserving fusion of two weighted Gaussians (Eq. 7)."""
    total = weight_i + weight_j
    difference = mean_i - mean_j
    mean = (weight_i * mean_i + weight_j * mean_j) / total
    covariance = (weight_i * covariance_i + weight_j * covariance_j) / total + (
        weight_i * weight_j / total**2
    ) * (difference[:, None] * difference)
    return mean, covariance


def log_determinant(covariance: Float64) -> float:
    """The logarithm of |Σ| of one covariance (3, 3), by its LDLᵀ pivots.

    The operations and their order are those of the association kernel, so that its distance of two
    equal Gaussians is exactly 0. Kernels of other files repeat these lines: numba does not notice
    changes in the files of called kernels (see `kernels.kernel`).

    Raises:
        ValueError: if the covariance is not positive definite.
    """
    (c00, _, _), (c10, c11, _), (c20, c21, c22) = covariance.tolist()
    if c00 > 0.0:
        pivot_1 = c11 - c10 / c00 * c10
        if pivot_1 > 0.0:
            rest = c21 - c20 / c00 * c10
            pivot_2 = c22 - c20 / c00 * c20 - rest / pivot_1 * rest
            if pivot_2 > 0.0:
                return math.log(c00 * pivot_1 * pivot_2)
    raise ValueError(f"covariance {covariance.tolist()} is not positive definite")


def log_determinants(covariances: Float64) -> Float64:
    """`log_determinant` of each of n covariances (n, 3, 3), with the same bits.

    Raises:
        ValueError: if one is not positive definite.
    """
    (c00, _, _), (c10, c11, _), (c20, c21, c22) = covariances.transpose(1, 2, 0)
    with np.errstate(all="ignore"):  # NaN is refused below
        pivot_1 = c11 - c10 / c00 * c10
        rest = c21 - c20 / c00 * c10
        pivot_2 = c22 - c20 / c00 * c20 - rest / pivot_1 * rest
        refused = ~((c00 > 0.0) & (pivot_1 > 0.0) & (pivot_2 > 0.0))
    if refused.any():
        seen = covariances[refused][0].tolist()
        raise ValueError(f"covariance {seen} is not positive definite")
    # The logarithm of numpy may differ in the last bit.
    return np.array(list(map(math.log, (c00 * pivot_1 * pivot_2).tolist())))


def eigenvalue_bound(covariance: Float64) -> float:
    """An upper bound of the largest eigenvalue of a covariance (3, 3).

    The Frobenius norm: equal to it for a thin Gaussian, at most √3 times it for a sphere.
    """
    squares = 0.0  # in the order of the fusion kernel; `sum` of newer Pythons differs
    for value in covariance.ravel().tolist():
        squares += value * value
    return math.sqrt(squares)


def eigenvalue_bounds(covariances: Float64) -> Float64:
    """`eigenvalue_bound` of each of n covariances (n, 3, 3), with the same bits."""
    squares = np.zeros(len(covariances))
    for column in covariances.reshape(-1, 9).T:
        squares += column * column
    return np.sqrt(squares)
