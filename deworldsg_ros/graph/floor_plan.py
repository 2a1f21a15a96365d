"""The floor plan of what the camera saw: where a robot can go, and where something is.

It is made of the views that a graph keeps and of the surface that they show, as planners want it:
`nav_msgs/OccupancyGrid`, or the map of Nav2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.graph.surface import Surface, surface_of
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int8, Int64, UInt8

# As in nav_msgs/OccupancyGrid.
UNKNOWN, FREE, OCCUPIED = -1, 0, 100
CELL_M = 0.05
# Cells along one side of a plan: 100 m of `CELL_M`. A larger place has wider cells.
MOST_CELLS = 2000
# What is lower is floor: thresholds, carpets, and the error of the depth.
LOWEST_M = 0.1
# A cell is occupied from this number of surface points on; one alone may be an error, unless such a
# cell is beside it.
LEAST_POINTS = 2
_BESIDE = np.ones((3, 3), np.uint8)
# The floor is the lowest layer of this height with this part of the points of the largest one.
LAYER_M, FLOOR_PART = 0.05, 0.25
# It is looked for up to so far above the lowest point.
MOST_RISE_M = 200.0


@dataclass(frozen=True)
class FloorPlan:
    """Cells on the floor.

    Attributes:
        cells: (rows, columns) int8, `UNKNOWN`, `FREE` or `OCCUPIED`; as seen from above, columns go
            along the x axis of the plan and rows along its y axis.
        cell_m: width of a cell.
        T_world_plan: (4, 4): the corner of the first cell on the floor; its z axis points up.
    """

    cells: Int8
    cell_m: float
    T_world_plan: Float64

    def at(self, point_world: Sequence[float]) -> int:
        """The cell below or above a point; `UNKNOWN` outside of the plan."""
        offset = np.asarray(point_world, np.float64) - self.T_world_plan[:3, 3]
        column, row = np.floor(self.T_world_plan[:3, :2].T @ offset / self.cell_m).astype(int)
        rows, columns = self.cells.shape
        inside = 0 <= row < rows and 0 <= column < columns
        return int(self.cells[row, column]) if inside else UNKNOWN


def floor_plan(
    space: SeenSpace,
    up: Sequence[float],
    height_m: float,
    surface: Surface | None = None,
    cell_m: float = CELL_M,
) -> FloorPlan | None:
    """The plan for a robot.

    A cell is occupied if the surface has points between the floor and the top of the robot; else it
    is free if a view saw through its air at such a height, or saw its floor. Free cells that
    occupied ones enclose are unknown if none of them has a floor.

    Args:
        space: the views.
        up: against gravity, world.
        height_m: of the robot; what is higher is not in its way.
        surface: that of `space`, if it is at hand.
        cell_m: width of a cell.

    Returns:
        None if no view shows anything.
    """
    import cv2  # slow to import, and only for plans

    surface = surface_of(space) if surface is None else surface
    axes = horizontal_axes(up)
    points, _, sides = surface.kept()
    placed = points @ axes.T.astype(np.float32)
    if not len(placed):
        return None
    floor = floor_height_m(placed[:, 2], sides @ axes[2])
    cameras = space.poses[:, :3, 3] @ axes.T
    corner = np.minimum(placed[:, :2].min(axis=0), cameras[:, :2].min(axis=0)) - cell_m
    size = np.maximum(placed[:, :2].max(axis=0), cameras[:, :2].max(axis=0)) + cell_m - corner
    cell_m = max(cell_m, float(size.max()) / MOST_CELLS)
    columns, rows = (int(count) for count in np.ceil(size / cell_m))
    free: UInt8 = np.zeros((rows, columns), np.uint8)
    band = floor + LOWEST_M, floor + height_m
    for depth_mm, _, intrinsics, pose in space.views():
        rays = rays_of(intrinsics, depth_mm.shape) @ (axes @ pose[:3, :3]).T
        for fan in fans(axes @ pose[:3, 3], rays, 1e-3 * depth_mm.astype(np.float64), band):
            cv2.fillPoly(free, [np.floor((fan - corner) / cell_m).astype(np.int32)], 1)
    cells = np.full((rows, columns), UNKNOWN, np.int8)
    cells[free > 0] = FREE
    on_floor = np.abs(placed[:, 2] - floor) < LOWEST_M
    has_floor = _counted(placed[on_floor, :2], corner, cell_m, (rows, columns)) > 0
    cells[has_floor] = FREE
    inside = (placed[:, 2] > band[0]) & (placed[:, 2] < band[1])
    found = _counted(placed[inside, :2], corner, cell_m, (rows, columns))
    cells[_occupied(found)] = OCCUPIED
    if has_floor.any():
        # Such as the air over a worktop, with something all around.
        _, parts = cv2.connectedComponents((cells == FREE).astype(np.uint8), connectivity=4)
        cells[(cells == FREE) & ~np.isin(parts, parts[has_floor])] = UNKNOWN
    T_world_plan = np.eye(4)
    T_world_plan[:3, :3] = axes.T
    T_world_plan[:3, 3] = np.array([*corner, floor]) @ axes
    return FloorPlan(cells, cell_m, T_world_plan)


def floor_height_m(heights: Float32, upward: Float64) -> float:
    """Height of the floor: that of the lowest large layer of points that are seen from above.

    Args:
        heights: (n,) of the points of a surface.
        upward: (n,) by how much the camera was above each one; positive = above.
    """
    above = heights[upward > 0] if (upward > 0).any() else heights
    low = float(above.min())
    above = above[above - low < MOST_RISE_M]
    layers = np.bincount(((above - low) / LAYER_M).astype(np.int64))
    # A floor may lie on the border of two layers.
    pairs = layers + np.append(layers[1:], 0)
    first = int(np.flatnonzero(pairs >= FLOOR_PART * pairs.max())[0])
    inside = np.abs(above - (low + (first + 1) * LAYER_M)) <= LAYER_M
    return float(np.median(above[inside])) if inside.any() else low


def rays_of(intrinsics: Float64, shape: tuple[int, ...]) -> Float64:
    """Rays (h, w, 3) through the pixels of an image, camera frame, z = 1."""
    fx, fy, cx, cy = intrinsics
    height, width = shape
    x, y = (np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=2)


def fans(
    camera: Float64, rays: Float64, hits: Float64, band: tuple[float, float]
) -> Iterable[Float64]:
    """The areas (n, 2) that rays pass within the heights `band`, for each row of an image.

    Columns whose rays stay above or below divide a row.
    """
    rise = np.where(np.abs(rays[..., 2]) < 1e-9, 1e-9, rays[..., 2])
    ends = np.sort((np.asarray(band)[:, None, None] - camera[2]) / rise, axis=0)
    near, far = np.clip(ends[0], 0.0, hits), np.clip(ends[1], 0.0, hits)
    passes = far > near
    edges = np.diff(np.pad(passes, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    starts, stops = np.argwhere(edges > 0), np.argwhere(edges < 0)
    for (row, first), (_, last) in zip(starts, stops):
        own = slice(first, last)
        plan = rays[row, own, :2]
        nearer, farther = plan * near[row, own, None], plan * far[row, own, None]
        yield camera[:2] + np.concatenate([nearer, farther[::-1]])


def _occupied(counts: Int64) -> Bool:
    """The occupied cells, by their numbers of points; gaps of a cell in something are closed."""
    import cv2

    sure = counts >= LEAST_POINTS
    beside = cv2.dilate(sure.astype(np.uint8), _BESIDE) > 0
    found = (sure | ((counts > 0) & beside)).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(found, cv2.MORPH_CLOSE, _BESIDE)) > 0


def _counted(plan: Float32, corner: Float64, cell_m: float, shape: tuple[int, int]) -> Int64:
    """Number of points (n, 2) in each cell."""
    columns, rows = np.floor((plan - corner) / cell_m).astype(np.int64).T
    numbers = np.bincount(rows * shape[1] + columns, minlength=shape[0] * shape[1])
    return np.asarray(numbers.reshape(shape))
