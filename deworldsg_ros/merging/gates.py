"""The association rule in its obvious form; the kernel computes the same, fast.

The fusion of Eq. 7 is `scene.gaussian.fuse`.
"""

from __future__ import annotations

import math

import numpy as np

from deworldsg_ros.scene.arrays import Float64


def class_distance(class_probabilities_i: Float64, class_probabilities_j: Float64) -> Float64:
    """D_c = 1 - Σ p_i p_j of class distributions (..., C) (Eq. 5)."""
    return np.asarray(1.0 - np.sum(class_probabilities_i * class_probabilities_j, axis=-1))


def may_merge(
    hellinger_distances: Float64,
    class_distances: Float64,
    hellinger_threshold: float,
    class_distance_threshold: float,
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Both gates, strictly: HD < δ_g and D_c < δ_c (Eq. 6)."""
    return np.asarray(
        (hellinger_distances < hellinger_threshold) & (class_distances < class_distance_threshold)
    )


def bhattacharyya_bound(hellinger_threshold: float) -> float:
    """B with HD < δ ⇔ BD < B: B = -ln(1 - δ²), since HD = √(1 - exp(-BD))."""
    return -math.log1p(-(hellinger_threshold**2))
