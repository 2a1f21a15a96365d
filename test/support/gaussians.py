"""The Gaussian of points by Eq. 4."""

from __future__ import annotations

import numpy as np


def moments(points_xyz: np.ndarray, ridge_m2: float) -> tuple[np.ndarray, np.ndarray]:
    """Sample mean (3,) and covariance (3, 3) of points (N, 3), N >= 2, with a ridge."""
    mean = points_xyz.mean(axis=0, dtype=np.float64)
    centred = points_xyz - mean
    return mean, centred.T @ centred / (len(points_xyz) - 1) + ridge_m2 * np.eye(3)
