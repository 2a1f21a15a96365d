"""Negative evidence: a depth image that looks through the place where a node should be."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.frame_graph import DepthGrid, Float64

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

# A surface this far, and this share of its depth, in front of what was measured was seen through:
# well beyond the noise of depth cameras, poses and the grid's step at an edge.
THROUGH_M = 0.08
THROUGH_SHARE = 0.03
# Fewer visible points than this say nothing, nor does a node of which less than this is visible.
MIN_VISIBLE_POINTS = 6
MIN_VISIBLE_SHARE = 0.5
# This share of the visible points has to be seen through, or to be there.
DECISIVE_SHARE = 0.7
# A node with this share of its points in the image is in full view of the camera.
WHOLE_SHARE = 0.9
# Surface points of a node that the depth image is compared with.
SAMPLED_POINTS = 48


class SeenThrough:
    """Counts, by owner, the frames in a row that looked through a node's place.

    Args:
        enough_frames: so many, and the node is gone from there; 0 = never.
    """

    def __init__(self, enough_frames: int) -> None:
        self._enough_frames = enough_frames
        self._points_world = np.zeros((0, SAMPLED_POINTS, 3), np.float32)
        self._point_counts = np.zeros(0, np.int64)
        self._frames = np.zeros(0, np.int64)

    def renew(self, owner: int, points_world: Float32) -> None:
        """Take a few of these surface points (k, 3) for those of the node."""
        if owner >= len(self._frames):
            more = max(64, owner)
            self._points_world = np.pad(self._points_world, ((0, more), (0, 0), (0, 0)))
            self._point_counts = np.pad(self._point_counts, (0, more))
            self._frames = np.pad(self._frames, (0, more))
        points = points_world[:SAMPLED_POINTS]
        self._points_world[owner, : len(points)] = points
        self._point_counts[owner] = len(points)
        self._frames[owner] = 0

    def forget(self, owner: int) -> None:
        """Drop what is known of an owner that is gone."""
        if owner < len(self._frames):
            self._point_counts[owner] = self._frames[owner] = 0

    def look(
        self, T_world_camera: Float64, grid: DepthGrid, seen: list[int]
    ) -> tuple[list[int], list[int]]:
        """Take in one frame, in which some owners were seen.

        Returns:
            The owners that are gone, and those that were there in full view but not seen.
        """
        through, present, whole = look(self._points_world, self._point_counts, T_world_camera, grid)
        seen = [owner for owner in seen if owner < len(present)]
        present[seen] = True
        whole[seen] = False
        self._frames[through] += 1
        self._frames[present] = 0
        gone = self._frames >= self._enough_frames if self._enough_frames else through & False
        return np.flatnonzero(gone).tolist(), np.flatnonzero(whole).tolist()


def look(
    points_world: Float32, point_counts: Int64, T_world_camera: Float64, grid: DepthGrid
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Which nodes' surfaces were seen through, which were there, and which of these in full view.

    Args:
        points_world: (S, K, 3) float32 surface points of S nodes, metres.
        point_counts: (S,) how many of the K are filled.
        T_world_camera: (4, 4) pose of the depth image.
        grid: the depth image.

    Returns:
        seen_through (S,), present (S,) and whole (S,) bool; all false where too little was visible,
        because it is out of view, occluded or without valid depth.
    """
    camera = grid.intrinsics
    through, there, inside = _count(
        points_world,
        point_counts,
        invert_pose(T_world_camera),
        grid.depth_mm,
        grid.stride_px,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
    )
    visible = through + there
    enough = (visible >= MIN_VISIBLE_POINTS) & (visible >= MIN_VISIBLE_SHARE * point_counts)
    present = enough & (there >= DECISIVE_SHARE * visible)
    return (
        enough & (through >= DECISIVE_SHARE * visible),
        present,
        present & (inside >= WHOLE_SHARE * point_counts),
    )


@njit(cache=True, nogil=True)
def _count(points, counts, T_camera_world, depth_mm, stride, fx, fy, cx, cy):  # type: ignore[no-untyped-def]
    through = np.zeros(len(points), np.int64)
    there = np.zeros(len(points), np.int64)
    inside = np.zeros(len(points), np.int64)
    rows, columns = depth_mm.shape
    for node in range(len(points)):
        most_hidden = (1.0 - MIN_VISIBLE_SHARE) * counts[node]
        for index in range(counts[node]):
            # Of a node that is too little visible the rest of the points tell nothing.
            if index - through[node] - there[node] > most_hidden:
                break
            x = np.float64(points[node, index, 0])
            y = np.float64(points[node, index, 1])
            z = np.float64(points[node, index, 2])
            z_camera = (
                T_camera_world[2, 0] * x
                + T_camera_world[2, 1] * y
                + T_camera_world[2, 2] * z
                + T_camera_world[2, 3]
            )
            if z_camera < 0.1:
                continue
            x_camera = (
                T_camera_world[0, 0] * x
                + T_camera_world[0, 1] * y
                + T_camera_world[0, 2] * z
                + T_camera_world[0, 3]
            )
            y_camera = (
                T_camera_world[1, 0] * x
                + T_camera_world[1, 1] * y
                + T_camera_world[1, 2] * z
                + T_camera_world[1, 3]
            )
            column = int(np.floor((fx * x_camera / z_camera + cx) / stride))
            row = int(np.floor((fy * y_camera / z_camera + cy) / stride))
            if column < 0 or row < 0 or column >= columns or row >= rows:
                continue
            inside[node] += 1
            measured_m = depth_mm[row, column] * 0.001
            if measured_m == 0.0:
                continue
            tolerance_m = THROUGH_M + THROUGH_SHARE * z_camera
            if measured_m > z_camera + tolerance_m:
                through[node] += 1
            elif measured_m > z_camera - tolerance_m:
                there[node] += 1
    return through, there, inside
