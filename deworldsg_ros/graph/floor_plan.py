"""What the camera saw, from above: where a robot can go, and what stands on tables.

The floor plan is made of the views that a graph keeps and of the surface that they show, as
planners want it: `nav_msgs/OccupancyGrid`, or the map of Nav2.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.graph.provenance import SeenSpace, TrailChange
from deworldsg_ros.graph.surface import Surface, surface_of
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int8, Int64, UInt8, UInt16
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.wire import messages as wire

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


# --- Things that no detector fires at: what is compact and stands on a level surface.
#
# Depth grids of many views are fused. A support is a level patch above the floor. What stands on
# it, in cells above it, is a thing if it is compact, touches its support, has the support around
# it, and is seen from several viewpoints. Cells that more views see through than see are errors of
# the depth. What is a node already is left out first, so that parts of two things that touch
# can still be told apart. The numbers were chosen on one rendered room and the shipped recording.

# The newest 512 views are kept: 5 MB if each has 80 x 60 pixels. A view is kept if the camera moved
# by STEP_M or turned by 3 degrees. Things are few pixels wide, so the views are denser than those
# of `SeenSpace`.
MOST_GLANCES = 512
STEP_M, STEP_TRACE = 0.05, 1.0 + 2.0 * math.cos(math.radians(3.0))
# Views within this distance of the newest one are searched.
REACH_M = 15.0
# Whether a cell can be seen through is tested in at most about this number of them.
LOOKS = 60
# Depth is used from and to here; farther away, a pixel is wider than a cup.
NEAREST_M, FARTHEST_M = 0.25, 3.5
# Edge of a cell. Surfaces are level whose normals are within 32 degrees of up.
THING_CELL_M, LEVEL = 0.02, 0.85
# A column of cells belongs to a wall or to the side of furniture if at least TALL of its layers,
# each 10 cm high, have points.
LAYER_TALL_M, TALL = 0.1, 10
# A support: its least area, and the greatest, which a floor exceeds; its least height above the
# floor; the width of gaps and bays that things on it leave.
SUPPORT_M2, FLOOR_M2, ABOVE_FLOOR_M, BAY_M = 0.03, 6.0, 0.15, 0.32
# What is lower above the support may be noise; what is higher or wider is no small thing.
LIFT_M, MOST_M = 0.014, 0.5
# The least points, width, area and height of a thing; the least number of views and viewpoints.
THING_POINTS, THING_M, THING_M2, THING_HEIGHT_M = 60, 0.05, 0.0012, 0.02
THING_VIEWS, THING_VIEWPOINTS = 3, 2
# Around a thing, at least AROUND of the cells show the support. Of the cells there that show
# anything, at most OTHERS show something else.
AROUND, OTHERS = 0.2, 0.3
# At least AGREED of the views of its cells show a surface there; the others see through.
AGREED = 0.8
# Viewpoints differ by an angle, or by a factor of the distance.
VIEWPOINT_RAD, VIEWPOINT_RATIO = math.radians(15.0), 1.4
# Boxes of nodes are wider by this; larger ones are of furniture, which is below things.
BOX_MARGIN_M, NODE_WIDE_M, NODE_TALL_M = 0.02, 0.6, 0.7


class Glance(NamedTuple):
    """The depth grid of a frame: its stamp and keyframe, (h, w) mm, fx fy cx cy, (4, 4) pose."""

    stamp_ns: int
    keyframe: int
    depth_mm: UInt16
    camera: Float64
    T_world_camera: Float64


class Thing(NamedTuple):
    """Surface points (n, 3) float32 of a thing, metres, world, and their keyframes (n,).

    first_ns and last_ns are the stamps of the first and the last of the `views` that show it.
    """

    points_world: Float32
    keyframes: UInt16
    first_ns: int
    last_ns: int
    views: int


class FoundThings(NamedTuple):
    """What was found, the stamp from which on all views were searched, and `Things.moves` then."""

    things: list[Thing]
    since_ns: int
    moves: int


class Things:
    """Finds compact things on level surfaces in the depth of many views.

    Attributes:
        is_new: whether there are views since something was last looked for.
        moves: how often the views have moved: what was found before lies elsewhere now.

    A copy keeps the views of its moment.
    """

    def __init__(self) -> None:
        self._glances: list[Glance] = []
        self._poses: Float64 = np.zeros((0, 4, 4))
        self.is_new, self.moves = False, 0

    def __len__(self) -> int:
        return len(self._glances)

    def note(self, local: LocalGraph, keyframe: int) -> None:
        """Keep the depth grid of a frame if no view so far is like it."""
        grid, pose = local.depth_grid, local.T_world_camera
        if grid is None:
            return
        traces = self._poses[:, :3, :3].reshape(-1, 9) @ pose[:3, :3].ravel()
        steps_m = self._poses[traces >= STEP_TRACE, :3, 3] - pose[:3, 3]
        if ((steps_m**2).sum(axis=1) < STEP_M**2).any():
            return
        i, per_px = grid.intrinsics, 1.0 / grid.stride_px
        camera = per_px * np.array([i.fx, i.fy, i.cx, i.cy])
        self.is_new = True
        glance = Glance(local.stamp_ns, keyframe, grid.depth_mm, camera, pose)
        self._glances = [*self._glances[1 - MOST_GLANCES :], glance]
        self._poses = np.concatenate([self._poses[1 - MOST_GLANCES :], pose[None]])

    def move(self, change: TrailChange) -> None:
        """Move the views with the poses that they were seen from."""
        stamps_ns = np.array([one.stamp_ns for one in self._glances], np.int64)
        self._poses = change.at(stamps_ns) @ self._poses
        self.is_new, self.moves = True, self.moves + 1
        self._glances = [
            one._replace(T_world_camera=pose) for one, pose in zip(self._glances, self._poses)
        ]

    def forget(self) -> None:
        """Drop all views: their keyframes have other numbers now."""
        self._glances, self._poses = [], self._poses[:0]

    def find(self, up: Sequence[float], nodes: Iterable[wire.NodeState]) -> FoundThings:
        """The things that are none of the nodes; it takes some seconds.

        Args:
            up: against gravity, world.
            nodes: of the graph; they may be newer than the views.
        """
        if not self._glances:
            return FoundThings([], 0, self.moves)
        axes, places = horizontal_axes(up), self._poses[:, :3, 3]
        near = np.abs(places - places[-1]).max(axis=1) < REACH_M
        glances = [one for one, is_near in zip(self._glances, near) if is_near]
        left_out = [one.stamp_ns + 1 for one, is_near in zip(self._glances, near) if not is_near]
        cloud = _Cloud(glances, axes, [_ends(node.box, axes) for node in nodes if node.box])
        stamps_ns = np.array([one.stamp_ns for one in glances])
        keyframes = np.array([one.keyframe for one in glances], np.uint16)
        found: list[tuple[Float32, Thing]] = []
        supports = _supports(cloud)
        standing = [rows for one in supports for rows in _standing(cloud, one, supports)]
        for rows in sorted(standing, key=len, reverse=True):
            points = cloud.points[rows]
            ends = np.quantile(points, (0.02, 0.98), axis=0)
            if any(_overlap(ends, other) for other, _ in found):
                continue
            views = np.unique(cloud.of[rows])
            seen_ns = stamps_ns[views]
            thing = Thing(
                (points @ axes).astype(np.float32), keyframes[cloud.of[rows]],
                int(seen_ns.min()), int(seen_ns.max()), len(views),
            )  # fmt: skip
            found.append((ends, thing))
        since_ns = max(left_out, default=int(stamps_ns.min()))
        return FoundThings([thing for _, thing in found], since_ns, self.moves)


class _Cloud:
    """The points of views, in cells.

    Attributes:
        points: (n, 3) float32 metres, in the frame of `horizontal_axes`.
        of: (n,) the view of each.
        level: (n,) whether its surface is level.
        known: (n,) whether it is of a node that is as small as a thing.
        at: (n, 2) its cell, and shape: the number of cells; corner: of the first, metres.
        views: rotation and position of the camera in the frame, and its glance, of each view.
    """

    def __init__(self, glances: Sequence[Glance], axes: Float64, boxes: Sequence[Float64]) -> None:
        self.views = [
            (axes @ one.T_world_camera[:3, :3], axes @ one.T_world_camera[:3, 3], one)
            for one in glances
        ]
        parts = [_shown(*view) for view in self.views]
        self.points = np.concatenate([points for points, _ in parts])
        self.level = np.concatenate([level for _, level in parts])
        counts = [len(points) for points, _ in parts]
        self.of = np.repeat(np.arange(len(parts), dtype=np.int32), counts)
        self.known = np.zeros(len(self.points), np.bool_)
        order = self.points[:, 0].argsort()
        first_axis = self.points[order, 0]
        for low, high in boxes:
            if (high - low)[:2].max() <= NODE_WIDE_M and (high - low)[2] <= NODE_TALL_M:
                low, high = low - BOX_MARGIN_M, high + BOX_MARGIN_M
                rows = order[slice(*first_axis.searchsorted((low[0], high[0])))]
                near = self.points[rows]
                self.known[rows] |= ((near >= low) & (near <= high)).all(axis=1)
        plan = self.points[:, :2]
        self.corner = plan.min(axis=0, initial=np.inf) if len(plan) else np.zeros(2)
        self.at = ((plan - self.corner) / THING_CELL_M).astype(np.int64)
        self.shape = tuple((self.at.max(axis=0, initial=0) + 1).tolist())
        self.floor_m = 0.0
        if self.level.any():
            self.floor_m = float(np.quantile(self.points[self.level, 2], 0.01))
        self.upright = self._upright()

    def _upright(self) -> Bool:
        """Which points (n,) are of walls and of sides of furniture: of tall columns of cells."""
        import cv2

        rows = np.flatnonzero(~self.level)
        flat = np.ravel_multi_index(tuple(self.at[rows].T), self.shape)
        layers = np.floor(self.points[rows, 2] / LAYER_TALL_M).astype(np.int64)
        low, count = int(layers.min(initial=0)), math.prod(self.shape)
        columns = np.unique((layers - low) * count + flat) % count
        tall = np.bincount(columns, minlength=count) >= TALL
        tall = cv2.dilate(tall.reshape(self.shape).astype(np.uint8), _BESIDE) > 0
        return np.asarray(tall[tuple(self.at.T)] & ~self.level)


def _shown(turn: Float64, place: Float64, glance: Glance) -> tuple[Float32, Bool]:
    """The points (n, 3) of a view, and which are level; those between two surfaces are left out."""
    depth = 1e-3 * glance.depth_mm.astype(np.float32)
    rays = rays_of(glance.camera, depth.shape) @ turn.T
    points = (rays * depth[..., None] + place).astype(np.float32)
    right, down = np.zeros_like(points), np.zeros_like(points)
    right[:, 1:-1], down[1:-1] = points[:, 2:] - points[:, :-2], points[2:] - points[:-2]
    normals = np.cross(right, down)
    level = np.abs(normals[..., 2]) > LEVEL * np.linalg.norm(normals, axis=2)
    near_m = 0.03 + 0.01 * depth
    aside = np.abs(np.diff(depth, axis=1)) > near_m[:, 1:]
    below = np.abs(np.diff(depth, axis=0)) > near_m[1:]
    good = (depth > NEAREST_M) & (depth < FARTHEST_M)
    good[:, 1:-1] &= ~(aside[:, 1:] & aside[:, :-1])
    good[1:-1] &= ~(below[1:] & below[:-1])
    return points[good], level[good]


class _Support(NamedTuple):
    """A level patch: its height, its cells (rows, columns), and the first of these."""

    height_m: float
    cells: Bool
    first: Int64

    @property
    def area_m2(self) -> float:
        return float(self.cells.sum()) * THING_CELL_M**2


def _supports(cloud: _Cloud) -> list[_Support]:
    """The level patches above the floor, the largest layers of 3 cm first."""
    import cv2  # slow to import, and only for plans
    from scipy import ndimage

    rows = np.flatnonzero(cloud.level & ~cloud.known)
    heights = cloud.points[rows, 2] - cloud.floor_m
    flat = np.ravel_multi_index(tuple(cloud.at[rows].T), cloud.shape)
    layers = np.floor(heights / 0.01).astype(np.int64)
    above = heights > ABOVE_FLOOR_M
    rows, heights, flat, layers = rows[above], heights[above], flat[above], layers[above]
    if not len(rows):
        return []
    count = math.prod(cloud.shape)
    areas = np.bincount(np.unique(layers * count + flat) // count) * THING_CELL_M**2
    areas = np.convolve(areas, np.ones(3), "same")
    found: list[_Support] = []
    for layer in np.argsort(-areas, kind="stable"):
        if areas[layer] < SUPPORT_M2:
            break
        near = np.abs(layers - layer) <= 1
        cells = np.zeros(cloud.shape, np.uint8)
        cells.reshape(-1)[flat[near]] = 1
        for other in found:
            # Noise puts the same patch into several layers.
            if abs(other.height_m - cloud.floor_m - 0.01 * layer) < 0.08:
                own = tuple(slice(a, a + n) for a, n in zip(other.first, other.cells.shape))
                cells[own][cv2.dilate(other.cells.astype(np.uint8), _BESIDE) > 0] = 0
        cells = cv2.morphologyEx(cells, cv2.MORPH_CLOSE, _BESIDE)
        parts, _ = ndimage.label(cells)
        counts = np.bincount(parts.ravel())
        part_of = parts.reshape(-1)[flat[near]]
        for part, where in enumerate(ndimage.find_objects(parts), 1):
            area = counts[part] * THING_CELL_M**2
            if SUPPORT_M2 <= area < FLOOR_M2:
                height = float(np.median(heights[near][part_of == part])) + cloud.floor_m
                first = np.array([side.start for side in where])
                found.append(_Support(height, parts[where] == part, first))
    return found


def _standing(cloud: _Cloud, support: _Support, supports: Sequence[_Support]) -> list[Int64]:
    """The rows of the points of each thing that stands on a support."""
    import cv2
    from scipy import ndimage

    # Things hide a part of their support: its gaps and bays belong to it.
    reach = round(BAY_M / 2 / THING_CELL_M)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    cells = np.pad(support.cells.astype(np.uint8), reach)
    first = support.first - reach
    whole = ndimage.binary_fill_holes(cv2.morphologyEx(cells, cv2.MORPH_CLOSE, disc))
    top_m = _room_above(support, whole, first, supports)
    at = cloud.at - first
    rows = np.flatnonzero(((at >= 0) & (at < whole.shape)).all(axis=1))
    heights = cloud.points[rows, 2] - support.height_m
    rows, heights = (each[(heights > -LIFT_M) & (heights < top_m)] for each in (rows, heights))
    at, known = at[rows], cloud.known[rows]
    shows = np.zeros(whole.shape, np.bool_)
    low = (heights <= LIFT_M) & ~known
    shows[tuple(at[low].T)] = True
    high = heights > LIFT_M
    blocked = np.zeros(whole.shape, np.int64)
    np.add.at(blocked, tuple(at[high].T), 1)
    shows &= blocked < 3
    own = high & ~known & ~cloud.upright[rows] & whole[tuple(at.T)]
    rows, at, heights = rows[own], at[own], heights[own]
    if len(rows) < THING_POINTS:
        return []
    boxes = np.column_stack([at, ((heights - LIFT_M) / THING_CELL_M).astype(np.int64)])
    counts = np.zeros((*whole.shape, int(boxes[:, 2].max()) + 1), np.int64)
    np.add.at(counts, tuple(boxes.T), 1)
    solid = np.argwhere(counts > 1)
    centers = np.asarray((solid + 0.5) * THING_CELL_M, np.float64)
    centers[:, :2] += cloud.corner + first * THING_CELL_M
    centers[:, 2] += support.height_m + LIFT_M
    seen, through = _looks(cloud, centers)
    kept = through <= np.maximum(seen, 1)
    parts = np.zeros(counts.shape, np.int64)
    parts[tuple(solid[kept].T)] = 1
    parts, _ = ndimage.label(parts, np.ones((3, 3, 3)))
    of_solid, of_row = parts[tuple(solid.T)], parts[tuple(boxes.T)]
    found = []
    for part in range(1, int(parts.max(initial=0)) + 1):
        cells, inside = solid[of_solid == part], of_row == part
        looks = seen[of_solid == part].sum(), through[of_solid == part].sum()
        if (
            _is_compact(cells, heights[inside])
            and looks[0] >= AGREED * sum(looks)
            and _is_apart(cells, shows, blocked >= 3)
            and _is_seen(cloud, rows[inside])
        ):
            found.append(rows[inside])
    return found


def _room_above(
    support: _Support, whole: Bool, first: Int64, supports: Sequence[_Support]
) -> float:
    """Height above a support up to which things may stand: below the next board of a shelf."""
    top_m = MOST_M + 0.15
    for other in supports:
        rise_m = other.height_m - support.height_m
        if 0.1 < rise_m < top_m + 0.05 and other.area_m2 > 0.5 * support.area_m2:
            board = np.zeros(whole.shape, np.bool_)
            at = np.argwhere(other.cells) + other.first - first
            at = at[((at >= 0) & (at < whole.shape)).all(axis=1)]
            board[tuple(at.T)] = True
            if (board & whole).sum() > 0.5 * whole.sum():
                top_m = rise_m - 0.04
    return top_m


def _looks(cloud: _Cloud, centers: Float64) -> tuple[Int64, Int64]:
    """How many views see something at each place (n, 3), and how many see through it."""
    seen, through = np.zeros(len(centers), np.int64), np.zeros(len(centers), np.int64)
    for turn, place, glance in cloud.views[:: max(1, len(cloud.views) // LOOKS)]:
        x, y, z = ((centers - place) @ turn).T
        fx, fy, cx, cy = glance.camera
        ahead = np.maximum(z, 0.1)
        u, v = np.floor(fx * x / ahead + cx), np.floor(fy * y / ahead + cy)
        height, width = glance.depth_mm.shape
        inside = (z > 0.2) & (z < FARTHEST_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        at = np.flatnonzero(inside)
        depth = 1e-3 * glance.depth_mm[v[at].astype(np.int64), u[at].astype(np.int64)]
        behind, near_m = depth - z[at], 0.04 + 0.01 * z[at]
        seen[at] += (depth > 0) & (np.abs(behind) <= near_m)
        through[at] += behind > near_m
    return seen, through


def _is_compact(cells: Int64, heights: Float64) -> bool:
    """Whether cells (n, 3) have the size of a thing, and touch the support.

    Args:
        cells: in which it is.
        heights: (m,) of its points above the support, metres.
    """
    import cv2

    if len(heights) < THING_POINTS:
        return False
    plan = np.unique(cells[:, :2], axis=0)
    sides = (np.array(cv2.minAreaRect(plan.astype(np.float32))[1]) + 1) * THING_CELL_M
    return bool(
        THING_HEIGHT_M <= np.quantile(heights, 0.98) <= MOST_M
        and sides.min() >= THING_M
        and sides.max() <= MOST_M
        and len(plan) * THING_CELL_M**2 >= THING_M2
        and cells[:, 2].min() * THING_CELL_M <= 0.045
    )


def _is_apart(cells: Int64, shows: Bool, blocked: Bool) -> bool:
    """Whether the support is seen around cells, and hardly anything else."""
    import cv2

    low = np.maximum(cells[:, :2].min(axis=0) - 3, 0)
    high = cells[:, :2].max(axis=0) + 4
    part = tuple(slice(a, b) for a, b in zip(low, high))
    foot = np.zeros(shows[part].shape, np.uint8)
    foot[tuple((cells[:, :2] - low).T)] = 1
    ring = cv2.dilate(foot, np.ones((7, 7), np.uint8)) > cv2.dilate(foot, _BESIDE)
    around, others = (ring & shows[part]).sum(), (ring & blocked[part]).sum()
    return bool(around >= AROUND * ring.sum() and others <= OTHERS * (around + others))


def _is_seen(cloud: _Cloud, rows: Int64) -> bool:
    """Whether enough views and viewpoints show the points of rows."""
    views = np.unique(cloud.of[rows])
    middle = cloud.points[rows].mean(axis=0)
    x, y, z = np.array([cloud.views[view][1] - middle for view in views]).T
    far = np.sqrt(x * x + y * y + z * z)
    turns = np.floor(np.stack([np.arctan2(y, x), np.arcsin(z / far)]) / VIEWPOINT_RAD)
    steps = np.floor(np.log(far) / math.log(VIEWPOINT_RATIO))
    viewpoints = len(np.unique(np.vstack([turns, steps]), axis=1).T)
    return len(views) >= THING_VIEWS and viewpoints >= THING_VIEWPOINTS


def _ends(box: wire.GravityBox, axes: Float64) -> Float64:
    """The lowest and highest corner (2, 3) of a box along axes."""
    from scipy.spatial.transform import Rotation  # slow to import

    turn = axes @ Rotation.from_quat(box.orientation_xyzw).as_matrix()
    half = 0.5 * np.abs(turn) @ np.array(box.size_m)
    return np.stack([axes @ box.center_m - half, axes @ box.center_m + half])


def _overlap(a: Float32, b: Float32) -> bool:
    """Whether two boxes (2, 3) share a fifth of their volume, or one has the other's middle."""
    shared = np.prod(np.maximum(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0]), 0.0))
    both = np.prod(a[1] - a[0]) + np.prod(b[1] - b[0]) - shared
    middles = ((a[0] <= b.mean(axis=0)) & (b.mean(axis=0) <= a[1])).all() or (
        (b[0] <= a.mean(axis=0)) & (a.mean(axis=0) <= b[1])
    ).all()
    return bool(shared > 0.2 * both or middles)
