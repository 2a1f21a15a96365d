"""Back-projection (Eq. 3) and the Gaussian of an object (Eq. 4)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.lifting.constants import LARGE_SURFACE_FACTOR, POINT_AREA_M2
from deworldsg_ros.lifting.pixels import Pixels
from deworldsg_ros.scene.arrays import Float32, Float64, Int32
from deworldsg_ros.scene.camera import Intrinsics

# Points that are computed at once; they fit into the first-level cache.
CHUNK = 256


class Estimate(NamedTuple):
    """An object in the camera frame.

    Attributes:
        pixel_count: number of its inliers. With fewer than the minimum, the rest is empty.
        mean: (3,) float64, metres.
        covariance: (3, 3) float64, square metres, N - 1 in the denominator, without the ridge εI.
        points: (k, 3) float64, metres, a sample of the inliers: evenly spaced in row order.
    """

    pixel_count: int
    mean: Float64
    covariance: Float64
    points: Float64


def estimate_gaussian(
    pixels: Pixels,
    layer_m: tuple[float, float],
    intrinsics: Intrinsics,
    min_pixels: int,
    surface_points: int,
) -> Estimate:
    """Sample mean and covariance of an object's points, camera frame (Eq. 4), and some points.

    The Gaussian of the points in the world frame follows by `scene.gaussian.transform`: μ → Rμ + t,
    Σ → RΣRᵀ. All points together are never stored.

    Args:
        pixels: of the object.
        layer_m: lowest and highest depth of its inliers, metres (Eq. 2).
        intrinsics: of the depth image.
        min_pixels: an object with fewer inliers is not estimated; at least 2.
        surface_points: usual size of the sample. A large surface gets more points, see
            `POINT_AREA_M2`; no object gets more than it has inliers.
    """
    camera = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    arrays = pixels.columns, pixels.rows, pixels.depths_m
    return Estimate(*_estimate(*arrays, *layer_m, *camera, min_pixels, surface_points))


@kernel
def back_project(
    column: int, row: int, depth_m: float, fx: float, fy: float, cx: float, cy: float
) -> tuple[float, float, float]:
    """`Intrinsics.back_project` of one pixel, with the same operations (Eq. 3)."""
    return (column - cx) / fx * depth_m, (row - cy) / fy * depth_m, depth_m


@kernel
def _estimate(
    all_columns: Int32,
    all_rows: Int32,
    all_depths_m: Float32,
    lowest_m: float,
    highest_m: float,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    min_pixels: int,
    surface_points: int,
) -> tuple[int, Float64, Float64, Float64]:
    columns = np.empty(all_columns.size, np.int32)
    rows, depths_m = np.empty(columns.size, np.int32), np.empty(columns.size, np.float32)
    count = 0
    for index in range(all_depths_m.size):
        z = all_depths_m[index]
        columns[count], rows[count], depths_m[count] = all_columns[index], all_rows[index], z
        count += (z >= lowest_m) & (z <= highest_m)
    if count < min_pixels:
        nothing = np.empty((0, 0), np.float64)
        return count, np.empty(0, np.float64), nothing, nothing
    mean, covariance = _moments(columns[:count], rows[:count], depths_m[:count], fx, fy, cx, cy)
    area_m2 = count * mean[2] ** 2 / (fx * fy)
    by_area = min(int(area_m2 / POINT_AREA_M2), LARGE_SURFACE_FACTOR * surface_points)
    points = np.empty((min(max(by_area, surface_points), count), 3), np.float64)
    for index in range(len(points)):
        place = index * count // len(points)
        x, y, z = back_project(
            columns[place], rows[place], np.float64(depths_m[place]), fx, fy, cx, cy
        )
        points[index, 0], points[index, 1], points[index, 2] = x, y, z
    return count, mean, covariance, points


@kernel
def _moments(
    columns: Int32, rows: Int32, depths_m: Float32, fx: float, fy: float, cx: float, cy: float
) -> tuple[Float64, Float64]:
    """Sample mean and covariance of the points of pixels."""
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
    xs, ys = np.empty(CHUNK, np.float64), np.empty(CHUNK, np.float64)
    zs = np.empty(CHUNK, np.float64)
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
    mean, covariance = np.empty(3, np.float64), np.empty((3, 3), np.float64)
    mean[0], mean[1], mean[2] = sx / count, sy / count, sz / count
    covariance[0, 0], covariance[1, 1], covariance[2, 2] = sxx, syy, szz
    covariance[0, 1] = covariance[1, 0] = sxy
    covariance[0, 2] = covariance[2, 0] = sxz
    covariance[1, 2] = covariance[2, 1] = syz
    for i in range(3):
        for j in range(3):
            covariance[i, j] = (covariance[i, j] - count * mean[i] * mean[j]) / (count - 1)
    mean[0], mean[1], mean[2] = mean[0] + x0, mean[1] + y0, mean[2] + z0
    return mean, covariance
