"""How well two depth images fit, and a point-to-plane refinement of the motion between them.

The refinement is projective ICP on a coarse grid: it needs a guess, reaches further than the image
pyramid of the odometry when the camera turns fast, and costs a few milliseconds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deworldsg_ros.poses.motion import rigid_motion
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.camera import Intrinsics

# Points are compared on every so many pixels; normals are taken from a finer grid.
POINT_STEP_PX = 8
NORMAL_STEP_PX = 4
# A point fits where its depth is within this, and this share of it, of what is seen there.
FIT_M = 0.03
FIT_SHARE = 0.02
MIN_POINTS = 50
# Correspondences further apart than this are left out, iteration by iteration.
REACHES_M = (0.3, 0.3, 0.3, 0.3, 0.2, 0.2, 0.1, 0.1, 0.05, 0.05)
# Residuals well beyond this share of it count little (Cauchy): coarse first, then fine.
RESIDUAL_SHARE = 0.3
# Inverse depth is linear on a plane, however it is tilted: bent by more than this share of it,
# neighbours are not one surface.
BEND_SHARE = 0.04


def points_of(depth_m: Float32, intrinsics: Intrinsics, step_px: int = POINT_STEP_PX) -> Float64:
    """Points (n, 3) float64 of a depth image's valid pixels on a grid, camera frame, metres."""
    rows, columns = np.nonzero(depth_m[::step_px, ::step_px])
    z = depth_m[::step_px, ::step_px][rows, columns].astype(np.float64)
    return intrinsics.back_project(columns * step_px, rows * step_px, z)


def fit_fraction(
    points_a: Float64, depth_b_m: Float32, T_b_a: Float64, intrinsics: Intrinsics
) -> float:
    """Share of the points of camera a that lie on depth image b, of those that b sees.

    0 where too few can be compared.
    """
    moved = points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    row, column, inside = _project(moved, intrinsics)
    seen_m = depth_b_m[row[inside], column[inside]].astype(np.float64)
    gap_m = np.abs(seen_m - moved[inside, 2])[seen_m > 0]
    if len(gap_m) < max(MIN_POINTS, len(points_a) // 8):
        return 0.0
    return float(np.mean(gap_m < FIT_M + FIT_SHARE * seen_m[seen_m > 0]))


class Surface(NamedTuple):
    """Points (h, w, 3) of a depth image on the finer grid, and unit normals; NaN = unknown."""

    points: Float64
    normals: Float64


def surface_of(depth_m: Float32, intrinsics: Intrinsics) -> Surface:
    """The surface that a depth image shows."""
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
    is_edge = bend > BEND_SHARE * middle
    with np.errstate(invalid="ignore", divide="ignore"):
        normals[1:-1, 1:-1] = np.where(is_edge[..., None], np.nan, normal / length)
    return Surface(points, normals)


def refine(
    points_a: Float64, surface_b: Surface, T_b_a: Float64, intrinsics: Intrinsics
) -> Float64:
    """T_b_a (4, 4) that lays points of camera a on the surface that camera b sees, from a guess.

    What the geometry leaves open (along a bare wall) stays as it was guessed.
    """
    height, width = surface_b.points.shape[:2]
    for reach_m in REACHES_M:
        moved = points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]
        row, column, inside = _project(moved, intrinsics)
        moved = moved[inside]
        row, column = (
            np.minimum((row[inside] + NORMAL_STEP_PX // 2) // NORMAL_STEP_PX, height - 1),
            np.minimum((column[inside] + NORMAL_STEP_PX // 2) // NORMAL_STEP_PX, width - 1),
        )
        gaps, normals = surface_b.points[row, column] - moved, surface_b.normals[row, column]
        residuals = np.einsum("ij,ij->i", gaps, normals)
        # Comparisons with NaN are false: what has no normal is left out.
        near = np.abs(residuals) < reach_m
        near &= np.linalg.norm(gaps, axis=1) < 2 * reach_m
        if np.count_nonzero(near) < MIN_POINTS:
            return T_b_a
        normals, residuals = normals[near], residuals[near]
        jacobian = np.hstack([np.cross(moved[near], normals), normals])
        weights = 1.0 / (1.0 + (residuals / (RESIDUAL_SHARE * reach_m)) ** 2)
        weighted = jacobian * weights[:, None]
        # Damped a little, so that what nothing constrains does not move.
        hessian = jacobian.T @ weighted + 1e-4 * weights.sum() * np.eye(6)
        step = np.linalg.solve(hessian, weighted.T @ residuals)
        T_b_a = rigid_motion(step[3:], step[:3]) @ T_b_a
    return T_b_a


def _project(points: Float64, intrinsics: Intrinsics) -> tuple[Int64, Int64, Bool]:
    """Row and column of the pixel of each point, and whether it is in the image."""
    z = np.where(points[:, 2] > 1e-3, points[:, 2], np.inf)
    column = np.rint(intrinsics.fx * points[:, 0] / z + intrinsics.cx).astype(np.int64)
    row = np.rint(intrinsics.fy * points[:, 1] / z + intrinsics.cy).astype(np.int64)
    inside = (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
    return row, column, inside & np.isfinite(z)
