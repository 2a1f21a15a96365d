"""Which way is up, from the depth image alone."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.camera import Intrinsics

# A hand-held or mounted camera looks from level to steeply down; a wall it faces squarely has its
# normal at 90 degrees from image up, and must not be taken for the floor.
PITCH_SEEDS_DEG = (0, 15, 30, 45, 60)
MAX_TILT_DEG = 65.0
CONES_DEG = (20.0, 12.0, 8.0, 8.0)
MIN_SUPPORT = 0.03
STEP_PX = 8


def estimate_up(depth_m: Float32, intrinsics: Intrinsics) -> Float64:
    """Unit vector against gravity in the camera frame, (3,).

    The direction, within 65 degrees of image up, that most surface normals share: floors, tables,
    shelves and seats face it. Where nothing does, image up.

    Args:
        depth_m: (H, W) metres; 0 = invalid.
        intrinsics: of the depth.
    """
    image_up = np.array([0.0, -1.0, 0.0])
    normals = _normals(depth_m, intrinsics)
    if not len(normals):
        return image_up
    best, best_support = image_up, MIN_SUPPORT * len(normals)
    for pitch in np.radians(PITCH_SEEDS_DEG):
        direction = np.array([0.0, -np.cos(pitch), -np.sin(pitch)])
        support = 0
        for cone in CONES_DEG:
            members = normals[normals @ direction > np.cos(np.radians(cone))]
            support = len(members)
            if support == 0:
                break
            mean = members.mean(axis=0)
            direction = mean / np.linalg.norm(mean)
        tilt_is_plausible = direction @ image_up > np.cos(np.radians(MAX_TILT_DEG))
        if support > best_support and tilt_is_plausible:
            best, best_support = direction, support
    return np.asarray(best)


def _normals(depth_m: Float32, intrinsics: Intrinsics) -> Float64:
    """Unit normals (k, 3) towards the camera, on a coarse grid, where the depth is smooth."""
    rows = np.arange(STEP_PX // 2, depth_m.shape[0], STEP_PX)
    columns = np.arange(STEP_PX // 2, depth_m.shape[1], STEP_PX)
    z = depth_m[np.ix_(rows, columns)].astype(np.float64)
    x = (columns[None, :] - intrinsics.cx) / intrinsics.fx * z
    y = (rows[:, None] - intrinsics.cy) / intrinsics.fy * z
    points = np.stack([x, y, z], axis=2)
    right = points[:-1, 1:] - points[:-1, :-1]
    down = points[1:, :-1] - points[:-1, :-1]
    valid = (z[:-1, :-1] > 0) & (z[:-1, 1:] > 0) & (z[1:, :-1] > 0)
    # A step of 8 px on a surface seen at up to 75 degrees; more is an edge between surfaces.
    limit = 4.0 * STEP_PX / intrinsics.fx * z[:-1, :-1]
    valid &= (np.abs(right[..., 2]) < limit) & (np.abs(down[..., 2]) < limit)
    normals = np.cross(down[valid], right[valid])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(lengths, 1e-12)
    # Towards the camera: against the viewing ray.
    away = np.einsum("ij,ij->i", normals, points[:-1, :-1][valid]) > 0
    normals[away] *= -1
    return np.asarray(normals)
