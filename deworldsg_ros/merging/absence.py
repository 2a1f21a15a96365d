"""Negative evidence: a depth image that looks through the place where a node should be."""

from __future__ import annotations

import math

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float32, Float64, Int64, UInt16
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.frame_graph import DepthGrid
from deworldsg_ros.scene.nodes import NodeTable

# A surface this far, and this share of its depth, in front of what was measured was seen through:
# well beyond the noise of depth cameras, poses and the grid's step at an edge.
THROUGH_M = 0.08
THROUGH_SHARE = 0.03
# Fewer visible points than this say nothing, nor does a node of which less than this is visible.
MIN_VISIBLE_POINTS = 6
MIN_VISIBLE_SHARE = 0.5
# This share of the visible points has to be seen through, or to be there.
DECISIVE_SHARE = 0.7
# A node with this share of its points in the image is in full view of the camera; one of which less
# than this is visible is not in view.
WHOLE_SHARE = 0.9
LEAST_SHARE = 0.25
# How much of a node is in view: nothing, less than half of it, half, or all.
VIEWS = UNSEEN, LITTLE, HALF, WHOLE = range(4)
# Nearer than this nothing is measured.
NEAR_M = 0.1
# Surface points of a node that the depth image is compared with.
SAMPLED_POINTS = 48


class SeenThrough:
    """Counts, by owner, the frames in a row that looked through a node's place.

    Args:
        enough_frames: after this many, the node is no longer at its position.
    """

    def __init__(self, enough_frames: int) -> None:
        self._enough_frames = enough_frames
        self._points_world = np.zeros((0, SAMPLED_POINTS, 3), np.float32)
        self._point_counts = np.zeros(0, np.int64)
        # Centre and radius of a ball around the points of each.
        self._balls_world = np.zeros((0, 4))
        self._frames = np.zeros(0, np.int64)

    def renew(self, owners: list[int], nodes: NodeTable, rows: list[int]) -> None:
        """Take a few surface points of some nodes, by owner and row, for what is to be seen."""
        if not owners:
            return
        if max(owners) >= len(self._frames):
            more = 64 + max(owners)
            self._points_world = np.pad(self._points_world, ((0, more), (0, 0), (0, 0)))
            self._point_counts = np.pad(self._point_counts, (0, more))
            self._balls_world = np.pad(self._balls_world, ((0, more), (0, 0)))
            self._frames = np.pad(self._frames, (0, more))
        _renew(
            self._points_world,
            self._point_counts,
            self._balls_world,
            self._frames,
            np.array(owners, np.int64),
            nodes.surface_points_world,
            nodes.surface_counts,
            np.array(rows, np.int64),
        )

    def forget(self, owner: int) -> None:
        """Drop what is known of an owner that is gone."""
        if owner < len(self._frames):
            self._point_counts[owner] = self._frames[owner] = 0

    def look(
        self, T_world_camera: Float64, grid: DepthGrid, seen: list[int]
    ) -> tuple[list[int], Int64]:
        """Take in one frame, in which some owners were seen.

        Returns:
            The owners that are gone, and by owner how much of it is there in view.
        """
        camera = grid.intrinsics
        gone, views = _look(
            self._points_world,
            self._point_counts,
            self._balls_world,
            self._frames,
            self._enough_frames,
            np.array(seen, np.int64),
            invert_pose(T_world_camera),
            grid.depth_mm,
            grid.stride_px,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
        )
        return gone.tolist(), views


@kernel
def _renew(
    kept_points: Float32,
    kept_counts: Int64,
    balls: Float64,
    frames: Int64,
    owners: Int64,
    points: Float32,
    counts: Int64,
    rows: Int64,
) -> None:
    for index in range(len(owners)):
        owner, row = owners[index], rows[index]
        count = min(counts[row], SAMPLED_POINTS)
        kept_counts[owner] = count
        frames[owner] = 0
        for axis in range(4):
            balls[owner, axis] = 0.0
        for place in range(count):
            for axis in range(3):
                kept_points[owner, place, axis] = points[row, place, axis]
                balls[owner, axis] += points[row, place, axis] / count
        for place in range(count):
            squared = 0.0
            for axis in range(3):
                squared += (points[row, place, axis] - balls[owner, axis]) ** 2
            # Wider by more than rounding.
            radius = 1.000001 * math.sqrt(squared) + 1e-6
            balls[owner, 3] = max(balls[owner, 3], radius)


@kernel
def _in_camera(T: Float64, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@kernel
def _beside_view(
    ball: Float64,
    T_camera_world: Float64,
    width_px: int,
    height_px: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> bool:
    """Whether all of a ball is behind the camera, or beyond one side of the image."""
    x, y, z = _in_camera(T_camera_world, ball[0], ball[1], ball[2])
    radius = ball[3]
    right, below = cx - width_px, cy - height_px
    return bool(
        z < NEAR_M - radius
        or fx * x + cx * z < -radius * math.hypot(fx, cx)
        or fx * x + right * z > radius * math.hypot(fx, right)
        or fy * y + cy * z < -radius * math.hypot(fy, cy)
        or fy * y + below * z > radius * math.hypot(fy, below)
    )


@kernel
def _look(
    points: Float32,
    counts: Int64,
    balls: Float64,
    frames: Int64,
    enough_frames: int,
    seen: Int64,
    T_camera_world: Float64,
    depth_mm: UInt16,
    stride: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> tuple[Int64, Int64]:
    found = np.zeros(len(points), np.bool_)
    for owner in seen:
        if owner < len(points):
            found[owner] = True
            frames[owner] = 0
    gone = np.zeros(len(points), np.bool_)
    views = np.full(len(points), UNSEEN)
    rows, columns = depth_mm.shape
    for node in range(len(points)):
        gone[node] = enough_frames <= frames[node]
        if _beside_view(
            balls[node], T_camera_world, columns * stride, rows * stride, fx, fy, cx, cy
        ):
            continue
        through = there = inside = 0
        most_hidden = (1.0 - LEAST_SHARE) * counts[node]
        for index in range(counts[node]):
            # Of a node that is too little visible the rest of the points tell nothing.
            if index - through - there > most_hidden:
                break
            x, y, z = _in_camera(
                T_camera_world,
                np.float64(points[node, index, 0]),
                np.float64(points[node, index, 1]),
                np.float64(points[node, index, 2]),
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
            tolerance_m = THROUGH_M + THROUGH_SHARE * z
            if measured_m > z + tolerance_m:
                through += 1
            elif measured_m > z - tolerance_m:
                there += 1
        visible = through + there
        if visible < MIN_VISIBLE_POINTS or visible < LEAST_SHARE * counts[node]:
            continue
        half = visible >= MIN_VISIBLE_SHARE * counts[node]
        if there >= DECISIVE_SHARE * visible:
            views[node] = LITTLE
            if half:
                views[node] = WHOLE if inside >= WHOLE_SHARE * counts[node] else HALF
                frames[node] = 0
                gone[node] = False
        elif half and through >= DECISIVE_SHARE * visible and not found[node]:
            frames[node] += 1
            gone[node] = enough_frames <= frames[node]
    return np.flatnonzero(gone), views
