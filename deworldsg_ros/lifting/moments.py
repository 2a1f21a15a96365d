"""Back-projection (Eq. 3) and the Gaussian of an object (Eq. 4)."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.lifting.pixels import Pixels
from deworldsg_ros.scene.arrays import Float32, Float64, Int32
from deworldsg_ros.scene.camera import Intrinsics

# Points that are computed at once; they fit into the first-level cache.
CHUNK = 256


def back_project(pixels: Pixels, intrinsics: Intrinsics, T_world_camera: Float64) -> Float64:
    """Points of pixels in the world frame (Eq. 3): x~ = z K⁻¹ [u v 1]ᵀ, x = R x~ + t.

    Returns:
        (N, 3) float64, metres.
    """
    camera = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    points_camera = _back_project(pixels.columns, pixels.rows, pixels.depths_m, *camera)
    return points_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def estimate_gaussian(pixels: Pixels, intrinsics: Intrinsics) -> tuple[Float64, Float64]:
    """Sample mean and covariance of an object's points, camera frame (Eq. 4).

    The Gaussian of the points in the world frame follows by `scene.gaussian.transform`: μ → Rμ + t,
    Σ → RΣRᵀ. The points themselves are never stored.

    Args:
        pixels: the final inliers of the object, two or more.
        intrinsics: of the depth image.

    Returns:
        mean (3,) float64 metres, and covariance (3, 3) float64 square metres with N - 1 in the
        denominator, without the ridge εI.
    """
    camera = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    mean, covariance = _camera_moments(pixels.columns, pixels.rows, pixels.depths_m, *camera)
    return mean, covariance


@kernel
def _back_project(
    columns: Int32, rows: Int32, depths_m: Float32, fx: float, fy: float, cx: float, cy: float
) -> Float64:
    """`Intrinsics.back_project`, with the same operations, in one pass."""
    points = np.empty((depths_m.size, 3))
    for index in range(depths_m.size):
        depth = np.float64(depths_m[index])
        points[index, 0] = (columns[index] - cx) / fx * depth
        points[index, 1] = (rows[index] - cy) / fy * depth
        points[index, 2] = depth
    return points


@kernel
def _camera_moments(
    columns: Int32,
    rows: Int32,
    depths_m: Float32,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> tuple[Float64, Float64]:
    count = depths_m.size
    # The sums are taken about a point of the object, not about the origin. A covariance of square
    # centimetres at a distance of metres would lose its digits otherwise.
    middle = count // 2
    z0 = np.float64(depths_m[middle])
    x0 = (columns[middle] - cx) / fx * z0
    y0 = (rows[middle] - cy) / fy * z0
    per_fx, per_fy = 1.0 / fx, 1.0 / fy
    sx = sy = sz = 0.0
    sxx = sxy = sxz = syy = syz = szz = 0.0
    # Points are computed in parallel, sums one after the other: their order decides the rounding.
    xs, ys, zs = np.empty(CHUNK), np.empty(CHUNK), np.empty(CHUNK)
    for start in range(0, count, CHUNK):
        u, v = columns[start : start + CHUNK], rows[start : start + CHUNK]
        depths = depths_m[start : start + CHUNK]
        for index in range(depths.size):
            depth = np.float64(depths[index])
            xs[index] = (u[index] - cx) * per_fx * depth - x0
            ys[index] = (v[index] - cy) * per_fy * depth - y0
            zs[index] = depth - z0
        for index in range(depths.size):
            x, y, z = xs[index], ys[index], zs[index]
            sx += x
            sy += y
            sz += z
            sxx += x * x
            sxy += x * y
            sxz += x * z
            syy += y * y
            syz += y * z
            szz += z * z
    mean = np.array([sx / count, sy / count, sz / count])
    covariance = np.array([[sxx, sxy, sxz], [sxy, syy, syz], [sxz, syz, szz]])
    for i in range(3):
        for j in range(3):
            covariance[i, j] = (covariance[i, j] - count * mean[i] * mean[j]) / (count - 1)
    return mean + np.array([x0, y0, z0]), covariance
