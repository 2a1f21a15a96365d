"""Fit of two depth images, and point-to-plane refinement of the motion between them.

The refinement is projective ICP on a coarse grid. It needs an initial guess and takes a few
milliseconds. For fast rotations it reaches further than the image pyramid of the odometry.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.rigid import point_to_plane, rigid_motion

# Points are compared on every N-th pixel; normals are computed on a finer grid.
POINT_STEP_PX = 8
NORMAL_STEP_PX = 4
# A point fits if its depth differs from the measured depth by less than FIT_M and FIT_FRACTION of
# the depth.
FIT_M = 0.03
FIT_FRACTION = 0.02
# With fewer points, nothing is aligned.
MIN_POINTS = 50
# Maximum distance of corresponding points, iteration by iteration: coarse first, then fine.
REACHES_M = (0.3, 0.3, 0.3, 0.3, 0.2, 0.2, 0.1, 0.1, 0.05, 0.05)
# Residuals beyond this fraction of the reach have small weights (Cauchy).
OUTLIER_FRACTION = 0.3
# On a plane, inverse depth is linear. If it bends by more than this fraction, the pixels do not
# belong to one surface.
MAX_BEND_FRACTION = 0.04
# Damping of the normal equations, times the sum of the weights: directions that the geometry does
# not constrain do not move.
DAMPING = 1e-4


class Surface(NamedTuple):
    """Surface of a depth image on the normals' grid, camera frame.

    Attributes:
        points: (h, w, 3) float64, metres; NaN = no depth.
        normals: (h, w, 3) float64, unit; NaN = unknown.
    """

    points: Float64
    normals: Float64


def points_of(depth_m: Float32, intrinsics: Intrinsics, step_px: int = POINT_STEP_PX) -> Float64:
    """Points (n, 3) float64 of the valid pixels on a grid, camera frame, metres."""
    rows, columns = np.nonzero(depth_m[::step_px, ::step_px])
    z = depth_m[::step_px, ::step_px][rows, columns].astype(np.float64)
    return intrinsics.back_project(columns * step_px, rows * step_px, z)


def fit_fraction(
    points_a: Float64, depth_b_m: Float32, T_b_a: Float64, intrinsics: Intrinsics
) -> float:
    """Fraction of the points (n, 3) of camera a, visible in camera b, that fit depth image b.

    0 if too few points can be compared.
    """
    moved = points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    row, column, inside = _pixels_of(moved, intrinsics)
    measured_m = depth_b_m[row[inside], column[inside]].astype(np.float64)
    gap_m = np.abs(measured_m - moved[inside, 2])[measured_m > 0]
    if len(gap_m) < max(MIN_POINTS, len(points_a) // 8):
        return 0.0
    return float(np.mean(gap_m < FIT_M + FIT_FRACTION * measured_m[measured_m > 0]))


def surface_of(depth_m: Float32, intrinsics: Intrinsics) -> Surface:
    """Points and normals of a depth image (H, W), metres, 0 = invalid."""
    step = NORMAL_STEP_PX
    z = depth_m[::step, ::step].astype(np.float64)
    z[z <= 0] = np.nan
    rows, columns = np.mgrid[: z.shape[0], : z.shape[1]]
    points = intrinsics.back_project(columns * step, rows * step, z)
    normals = np.full(points.shape, np.nan)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normal = np.cross(across, down)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    inverse = 1.0 / z
    middle = inverse[1:-1, 1:-1]
    bend = np.maximum(
        np.abs(inverse[1:-1, 2:] + inverse[1:-1, :-2] - 2 * middle),
        np.abs(inverse[2:, 1:-1] + inverse[:-2, 1:-1] - 2 * middle),
    )
    is_edge = bend > MAX_BEND_FRACTION * middle
    with np.errstate(invalid="ignore", divide="ignore"):
        normals[1:-1, 1:-1] = np.where(is_edge[..., None], np.nan, normal / length)
    return Surface(points, normals)


def refine(
    points_a: Float64, surface_b: Surface, T_b_a: Float64, intrinsics: Intrinsics
) -> Float64:
    """T_b_a (4, 4) that moves the points of camera a onto the surface of camera b.

    Directions that the geometry leaves open, such as along a bare wall, keep the initial guess.

    Args:
        points_a: (n, 3) metres, camera a.
        surface_b: of camera b.
        T_b_a: (4, 4) initial guess.
        intrinsics: of camera b.
    """
    height, width = surface_b.points.shape[:2]
    for reach_m in REACHES_M:
        moved = points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]
        row, column, inside = _pixels_of(moved, intrinsics)
        moved = moved[inside]
        row, column = (
            np.minimum((row[inside] + NORMAL_STEP_PX // 2) // NORMAL_STEP_PX, height - 1),
            np.minimum((column[inside] + NORMAL_STEP_PX // 2) // NORMAL_STEP_PX, width - 1),
        )
        gaps, normals = surface_b.points[row, column] - moved, surface_b.normals[row, column]
        distances = np.einsum("ij,ij->i", gaps, normals)
        # Comparisons with NaN are false: points without a normal are ignored.
        near = np.abs(distances) < reach_m
        near &= np.linalg.norm(gaps, axis=1) < 2 * reach_m
        if np.count_nonzero(near) < MIN_POINTS:
            return T_b_a
        distances = distances[near]
        jacobian, weights = point_to_plane(
            moved[near], normals[near], distances, OUTLIER_FRACTION * reach_m
        )
        weighted = jacobian * weights[:, None]
        hessian = jacobian.T @ weighted + DAMPING * weights.sum() * np.eye(6)
        step = np.linalg.solve(hessian, weighted.T @ distances)
        T_b_a = rigid_motion(step[3:], step[:3]) @ T_b_a
    return T_b_a


def _pixels_of(points: Float64, intrinsics: Intrinsics) -> tuple[Int64, Int64, Bool]:
    """Row and column of the pixel of each point (n, 3), and whether it is in the image."""
    z = np.where(points[:, 2] > 1e-3, points[:, 2], np.inf)
    uv = intrinsics.project(np.column_stack((points[:, :2], z)))
    column, row = np.rint(uv).astype(np.int64).T
    inside = (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
    return row, column, inside & np.isfinite(z)
