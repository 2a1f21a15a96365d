"""Plain reference of Eq. 1-4: full-frame masks, sorting, np.cov. It is slow.

The kernels must find exactly the same inliers. bench/lifting.py compares the times. Depths are
float32; all other numbers are float64.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from deworldsg_ros.config import LiftingConfig
from deworldsg_ros.lifting.stage import LiftingConstants
from deworldsg_ros.scene.camera import Intrinsics


@dataclass(frozen=True)
class ReferenceObject:
    """One lifted object."""

    inliers: np.ndarray  # (H, W) bool
    mean: np.ndarray
    covariance: np.ndarray
    depth_m: float


def median_3x3(depth_m: np.ndarray) -> np.ndarray:
    """Median of each 3x3 neighbourhood, with repeated borders."""
    padded = np.pad(depth_m, 1, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, (3, 3)), axis=(2, 3))


PAPER, PRINTED = LiftingConfig(), LiftingConstants()


def depth_layers(
    depths_m: np.ndarray, gamma_base_m: float, alpha: float, beta: float
) -> list[np.ndarray]:
    """Eq. 2: the sorted depths, split at steps above the threshold."""
    ordered = np.sort(depths_m.astype(np.float64))
    steps = np.diff(ordered)
    threshold = max(
        gamma_base_m,
        alpha * (np.median(steps) if len(steps) else 0.0),
        beta * np.median(ordered),
    )
    return np.split(ordered, np.nonzero(steps > threshold)[0] + 1)


def kept_layer(
    depths_m: np.ndarray,
    gamma_base_m: float = PAPER.gamma_base_m,
    alpha: float = PRINTED.alpha,
    beta: float = PRINTED.beta,
) -> tuple[float, float]:
    """Eq. 3: limits of the layer whose mean is nearest to the median depth."""
    layers = depth_layers(depths_m, gamma_base_m, alpha, beta)
    reference = np.median(depths_m.astype(np.float64))
    distances = [abs(math.fsum(layer) / len(layer) - reference) for layer in layers]
    kept = layers[int(np.argmin(distances))]
    return kept[0], kept[-1]


def reference_lift(
    instances: np.ndarray,
    depth_m: np.ndarray,
    intrinsics: Intrinsics,
    T_world_camera: np.ndarray,
    config: LiftingConfig,
    count: int,
    *,
    constants: LiftingConstants = PRINTED,
    fast_median: bool = False,
) -> list[ReferenceObject | str]:
    """The lifted object, or the reason of its refusal, for each of `count` objects."""
    valid = np.isfinite(depth_m) & (depth_m > 0)
    depth = np.where(valid, depth_m, np.float32(0))
    median = cv2.medianBlur(depth, 3) if fast_median else median_3x3(depth)
    depth64, median = depth.astype(np.float64), median.astype(np.float64)
    near_median = np.abs(depth64 - median) < config.tau * median + constants.epsilon_m
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    K_inverse = np.linalg.inv(intrinsics.matrix)
    results: list[ReferenceObject | str] = []
    for k in range(1, count + 1):
        mask = (instances == k) & valid
        if mask.sum() < constants.min_pixels:
            results.append("few_mask_pixels")
            continue
        spatial = mask & near_median
        if spatial.sum() < constants.min_pixels:
            results.append("few_spatial_inliers")
            continue
        low, high = kept_layer(depth[spatial], config.gamma_base_m, constants.alpha, constants.beta)
        final = spatial & (depth64 >= low) & (depth64 <= high)
        if final.sum() < constants.min_pixels:
            results.append("few_depth_inliers")
            continue
        z = depth64[final]
        pixels = np.stack([u[final], v[final], np.ones(len(z))])
        points = T_world_camera[:3, :3] @ (z * (K_inverse @ pixels)) + T_world_camera[:3, 3:]
        covariance = np.cov(points) + config.covariance_ridge_m2 * np.eye(3)
        results.append(ReferenceObject(final, points.mean(axis=1), covariance, float(z.mean())))
    return results
