"""Back-projection (Eq. 3) and the Gaussian of an object (Eq. 4)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.lifting.pixels import Pixels
from deworldsg_ros.scene.arrays import Float32, Float64, Int32
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.gaussian import transform


def back_project(pixels: Pixels, intrinsics: Intrinsics, T_world_camera: Float64) -> Float64:
    """Points of pixels in the world frame (Eq. 3): x~ = z K⁻¹ [u v 1]ᵀ, x = R x~ + t.

    Returns:
        (N, 3) float64, metres.
    """
    depths_m = pixels.depths_m.astype(np.float64)
    points_camera = intrinsics.back_project(pixels.columns, pixels.rows, depths_m)
    return points_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def estimate_gaussians(
    objects: Sequence[Pixels], intrinsics: Intrinsics, T_world_camera: Float64, ridge_m2: float
) -> tuple[Float64, Float64, Float64]:
    """Sample mean and covariance of each object's points, world frame (Eq. 4).

    The moments are computed in the camera frame, then μ → Rμ + t, Σ → RΣRᵀ. The ridge εI is the
    same in both frames. The points themselves are never stored.

    Args:
        objects: the final inliers of n objects, two pixels or more each.
        intrinsics: of the depth image.
        T_world_camera: (4, 4) float64.
        ridge_m2: the ε of εI, square metres.

    Returns:
        means (n, 3) metres, covariances (n, 3, 3) square metres with N - 1 in the denominator, and
        the mean depths in the camera frame (n,) metres; all float64.
    """
    means_camera = np.empty((len(objects), 3))
    covariances_camera = np.empty((len(objects), 3, 3))
    for row, pixels in enumerate(objects):
        means_camera[row], covariances_camera[row] = _camera_moments(
            pixels.columns,
            pixels.rows,
            pixels.depths_m,
            intrinsics.fx,
            intrinsics.fy,
            intrinsics.cx,
            intrinsics.cy,
        )
    means, covariances = transform(means_camera, covariances_camera, T_world_camera)
    return means, covariances + ridge_m2 * np.eye(3), means_camera[:, 2].copy()


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
    for index in range(count):
        depth = np.float64(depths_m[index])
        x = (columns[index] - cx) * per_fx * depth - x0
        y = (rows[index] - cy) * per_fy * depth - y0
        z = depth - z0
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
