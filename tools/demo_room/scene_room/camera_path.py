"""Path of a hand-held camera around the room, at 10 Hz."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

RATE_HZ = 10.0

# Each row: seconds, camera x y z, target x y z (metres, world). The camera points at the target.
WAYPOINTS = np.array([
    [0.0, 0.75, -1.35, 1.52, -1.15, 0.45, 0.75],
    [1.3, 0.35, -1.20, 1.50, -1.20, 0.40, 0.75],
    [2.5, -0.25, -0.98, 1.42, -1.15, 0.15, 0.74],
    [3.2, -0.42, -0.92, 1.38, -1.12, 0.10, 0.76],
    [5.4, -0.42, -0.92, 1.38, -1.12, 0.10, 0.76],
    [6.6, 0.05, -0.25, 1.42, -1.25, 0.30, 0.80],
    [7.6, 0.20, 0.45, 1.45, -1.20, 1.20, 0.85],
    [8.4, 0.15, 0.80, 1.48, -1.30, 2.15, 1.00],
    [9.1, 0.10, 0.70, 1.48, -0.70, 2.30, 1.00],
    [9.9, 0.20, 0.25, 1.46, 1.15, 2.35, 0.85],
    [10.8, 0.45, 0.00, 1.44, 1.90, 2.25, 0.65],
    [11.7, 0.60, 0.20, 1.44, 2.50, 0.90, 0.50],
    [12.7, 0.75, 0.75, 1.46, 1.75, -1.30, 0.45],
    [13.7, 0.75, 0.80, 1.45, 1.20, -1.90, 0.55],
    [14.6, 0.55, 0.40, 1.46, 0.10, -2.10, 0.75],
    [15.3, 0.40, 0.00, 1.48, -1.10, -2.30, 0.85],
    [15.9, 0.50, -0.60, 1.50, -1.80, -1.30, 0.80],
    [16.5, 0.70, -1.25, 1.52, -1.25, 0.20, 0.76],
    [17.0, 0.75, -1.35, 1.52, -1.15, 0.45, 0.75],
])  # fmt: skip
# The camera stands still from the first to the second time.
STILL_S = (3.4, 5.2)


def camera_poses(seed: int, duration_s: float = 17.0) -> NDArray[np.float64]:
    """T_world_camera (n, 4, 4) of each frame. Optical frame: x right, y down, z forward."""
    rng = np.random.default_rng(seed)
    times = np.arange(int(round(duration_s * RATE_HZ)) + 1) / RATE_HZ
    fine = np.arange(0, duration_s + 1e-9, 0.02)
    spline = PchipInterpolator(WAYPOINTS[:, 0], WAYPOINTS[:, 1:], axis=0)
    smooth = gaussian_filter1d(
        spline(np.minimum(fine, WAYPOINTS[-1, 0])), 12, axis=0, mode="nearest"
    )
    path = np.stack([np.interp(times, fine, smooth[:, i]) for i in range(6)], 1)
    tremor = gaussian_filter1d(rng.normal(size=(len(fine), 6)), 6, axis=0, mode="nearest")
    tremor /= tremor.std(0)
    tremor = np.stack([np.interp(times, fine, tremor[:, i]) for i in range(6)], 1)
    still = ((times >= STILL_S[0]) & (times <= STILL_S[1])).astype(float)
    calm = (1 - 0.85 * gaussian_filter1d(still, 1.5, mode="nearest"))[:, None]
    position = path[:, :3] + tremor[:, :3] * calm * [0.004, 0.004, 0.005]
    angles = tremor[:, 3:] * calm * np.deg2rad([0.35, 0.35, 0.6])
    return np.array([_look(p, t, a) for p, t, a in zip(position, path[:, 3:], angles)])


def _look(position: NDArray, target: NDArray, shake: NDArray) -> NDArray[np.float64]:
    forward = target - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, down, forward], 1) @ _small_rotation(shake)
    pose[:3, 3] = position
    return pose


def _small_rotation(vector: NDArray) -> NDArray[np.float64]:
    angle = float(np.linalg.norm(vector)) + 1e-15
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
