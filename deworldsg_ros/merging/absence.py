"""Negative evidence: the depth image sees through the position of a node."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float32, Float64, Int64, UInt16
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.frame_graph import DepthGrid
from deworldsg_ros.scene.nodes import NodeTable

# A point is seen through if the measured depth is larger than its own by THROUGH_M and
# THROUGH_FRACTION of its depth. This is well above the noise of depth cameras and poses, and above
# the step of the depth grid at an edge.
THROUGH_M = 0.08
THROUGH_FRACTION = 0.03
# A node is judged only if this many of its points, and this fraction of them, are visible.
MIN_VISIBLE_POINTS = 6
MIN_VISIBLE_FRACTION = 0.5
# This fraction of the visible points decides: seen through, or present.
DECISIVE_FRACTION = 0.7
# A node is in full view if this fraction of its points is in the image, and not in view if less
# than MIN_IN_VIEW_FRACTION is visible.
FULL_VIEW_FRACTION = 0.9
MIN_IN_VIEW_FRACTION = 0.25
# How much of a present node is visible: less than a quarter, a quarter, half, or all of it.
VISIBILITIES = NOT_VISIBLE, QUARTER, HALF, FULL = range(4)
# Depth cameras measure nothing nearer than this.
NEAR_M = 0.1
# Surface points of a node that are compared with the depth image.
SAMPLED_POINTS = 48


class _Samples(NamedTuple):
    """Surface points of each owner, and its number of consecutive frames that see through it.

    Attributes:
        points_world: (n, SAMPLED_POINTS, 3) float32, metres.
        counts: (n,) int64, number of points.
        balls_world: (n, 4) float64, centre and radius of a ball around the points, metres.
        frames: (n,) int64.
    """

    points_world: Float32
    counts: Int64
    balls_world: Float64
    frames: Int64


# The arrays of `_Samples` as a plain tuple, and the camera of a depth grid: fx, fy, cx, cy, stride,
# pixels of the full image. Numba is slower to call with named tuples.
_SampleArrays = tuple[Float32, Int64, Float64, Int64]
_Camera = tuple[float, float, float, float, int]


class AbsenceEvidence:
    """Counts, for each owner, the consecutive frames that see through its position.

    Args:
        absent_frames: number of such frames after which the object is absent.
    """

    def __init__(self, absent_frames: int) -> None:
        self._absent_frames = absent_frames
        self._samples = _Samples(
            np.zeros((0, SAMPLED_POINTS, 3), np.float32),
            np.zeros(0, np.int64),
            np.zeros((0, 4)),
            np.zeros(0, np.int64),
        )

    def update_points(self, owners: list[int], nodes: NodeTable, rows: list[int]) -> None:
        """Sample the surface of some nodes, by owner and row; resets their frame counts."""
        if not owners:
            return
        if max(owners) >= len(self._samples.frames):
            more = 64 + max(owners)
            samples = self._samples
            self._samples = _Samples(
                np.pad(samples.points_world, ((0, more), (0, 0), (0, 0))),
                np.pad(samples.counts, (0, more)),
                np.pad(samples.balls_world, ((0, more), (0, 0))),
                np.pad(samples.frames, (0, more)),
            )
        _update_points(
            self._samples[:],
            np.array(owners, np.int64),
            nodes.surface_points_world,
            nodes.surface_counts,
            np.array(rows, np.int64),
        )

    def forget(self, owner: int) -> None:
        """Drop the data of a removed owner."""
        if owner < len(self._samples.frames):
            self._samples.counts[owner] = self._samples.frames[owner] = 0

    def observe(
        self, T_world_camera: Float64, grid: DepthGrid, detected: list[int]
    ) -> tuple[list[int], Int64]:
        """Compare all owners with the depth of one frame.

        Args:
            T_world_camera: (4, 4) float64.
            grid: depth samples of the frame.
            detected: owners detected in the frame; they are not absent.

        Returns:
            The absent owners, and by owner how much of it is visible (`VISIBILITIES`).
        """
        camera = grid.intrinsics
        absent, visibilities = _observe(
            self._samples[:],
            self._absent_frames,
            np.array(detected, np.int64),
            invert_pose(T_world_camera),
            grid.depth_mm,
            (camera.fx, camera.fy, camera.cx, camera.cy, grid.stride_px),
        )
        return absent.tolist(), visibilities


@kernel
def _update_points(
    samples: _SampleArrays, owners: Int64, points: Float32, counts: Int64, rows: Int64
) -> None:
    kept_points, kept_counts, balls, frames = samples
    for index in range(len(owners)):
        owner, row = owners[index], rows[index]
        count = min(counts[row], SAMPLED_POINTS)
        kept_counts[owner] = count
        frames[owner] = 0
        for axis in range(4):
            balls[owner, axis] = 0.0
        for point in range(count):
            for axis in range(3):
                kept_points[owner, point, axis] = points[row, point, axis]
                balls[owner, axis] += points[row, point, axis] / count
        for point in range(count):
            squared = 0.0
            for axis in range(3):
                squared += (points[row, point, axis] - balls[owner, axis]) ** 2
            # Slightly larger, so that rounding leaves no point outside.
            radius = 1.000001 * math.sqrt(squared) + 1e-6
            balls[owner, 3] = max(balls[owner, 3], radius)


@kernel
def in_camera(T: Float64, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A world point in camera axes, metres."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@kernel
def _is_out_of_view(
    ball: Float64, T_camera_world: Float64, width_px: int, height_px: int, camera: _Camera
) -> bool:
    """Whether a ball is behind the camera, or completely beyond one side of the image."""
    x, y, z = in_camera(T_camera_world, ball[0], ball[1], ball[2])
    radius = ball[3]
    fx, fy, cx, cy, _ = camera
    right, below = cx - width_px, cy - height_px
    return bool(
        z < NEAR_M - radius
        or fx * x + cx * z < -radius * math.hypot(fx, cx)
        or fx * x + right * z > radius * math.hypot(fx, right)
        or fy * y + cy * z < -radius * math.hypot(fy, cy)
        or fy * y + below * z > radius * math.hypot(fy, below)
    )


@kernel
def _compare(
    points: Float32, count: int, T_camera_world: Float64, depth_mm: UInt16, camera: _Camera
) -> tuple[int, int, int]:
    """Number of points that are seen through, present, and in the image."""
    fx, fy, cx, cy, stride = camera
    rows, columns = depth_mm.shape
    through = present = inside = 0
    most_hidden = (1.0 - MIN_IN_VIEW_FRACTION) * count
    for index in range(count):
        # Too little of the node is visible already; the other points do not matter.
        if index - through - present > most_hidden:
            break
        x, y, z = in_camera(
            T_camera_world,
            np.float64(points[index, 0]),
            np.float64(points[index, 1]),
            np.float64(points[index, 2]),
        )
        if z < NEAR_M:
            continue
        column = int(np.floor((fx * x / z + cx) / stride))
        row = int(np.floor((fy * y / z + cy) / stride))
        if column < 0 or row < 0 or column >= columns or row >= rows:
            continue
        inside += 1
        measured_m = depth_mm[row, column] * 0.001
        if measured_m == 0.0:
            continue
        tolerance_m = THROUGH_M + THROUGH_FRACTION * z
        if measured_m > z + tolerance_m:
            through += 1
        elif measured_m > z - tolerance_m:
            present += 1
    return through, present, inside


@kernel
def _observe(
    samples: _SampleArrays,
    absent_frames: int,
    detected: Int64,
    T_camera_world: Float64,
    depth_mm: UInt16,
    camera: _Camera,
) -> tuple[Int64, Int64]:
    points, counts, balls, frames = samples
    stride = camera[4]
    is_detected = np.zeros(len(counts), np.bool_)
    for owner in detected:
        if owner < len(counts):
            is_detected[owner] = True
            frames[owner] = 0
    absent = np.zeros(len(counts), np.bool_)
    visibilities = np.full(len(counts), NOT_VISIBLE)
    width_px, height_px = depth_mm.shape[1] * stride, depth_mm.shape[0] * stride
    for owner in range(len(counts)):
        absent[owner] = absent_frames <= frames[owner]
        if _is_out_of_view(balls[owner], T_camera_world, width_px, height_px, camera):
            continue
        count = counts[owner]
        through, present, inside = _compare(points[owner], count, T_camera_world, depth_mm, camera)
        visible = through + present
        if visible < MIN_VISIBLE_POINTS or visible < MIN_IN_VIEW_FRACTION * count:
            continue
        half = visible >= MIN_VISIBLE_FRACTION * count
        if present >= DECISIVE_FRACTION * visible:
            visibilities[owner] = QUARTER
            if half:
                visibilities[owner] = FULL if inside >= FULL_VIEW_FRACTION * count else HALF
                frames[owner] = 0
                absent[owner] = False
        elif half and through >= DECISIVE_FRACTION * visible and not is_detected[owner]:
            frames[owner] += 1
            absent[owner] = absent_frames <= frames[owner]
    return np.flatnonzero(absent), visibilities
