"""Which nodes a frame may show, and what it shows of them, before it is merged."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.base.kernels import kernel, read_only
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt16
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph

# --- What a frame shows of the nodes of the graph, before it is merged.
#
# The surface points of the nodes are projected into the depth image of the frame. A point is
# present if the image shows a surface there, and seen through if the image shows something behind
# it. A point that is present may lie in the mask of an object.

# A point is seen through if the measured depth is larger than its own by THROUGH_M and
# THROUGH_FRACTION of its depth. This is well above the noise of depth cameras and poses, and above
# the step of the depth grid at an edge.
THROUGH_M = 0.08
THROUGH_FRACTION = 0.03
# A node counts as seen through only if its points fall into at least this many cells of the depth
# grid (3 x 3). The grid holds every 8th pixel, so a small object far away, such as a cup at 3 m,
# can lie between the pixels that it holds.
MIN_THROUGH_CELLS = 9
# A node is judged only if this many of its points are visible, and this fraction of them.
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
# Surface points of a node that are compared with the image: the first in the order of their
# hashes, which are a sample.
SAMPLED_POINTS = 48

# A frame: T_camera_world (4, 4); depth in millimetres and instances, both (h, w); and fx, fy, cx
# and cy of these images in their own pixels.
FrameArrays = tuple[Float64, UInt16, UInt16, tuple[float, float, float, float]]


@dataclass(frozen=True)
class View:
    """The m nodes that a frame with n objects may show.

    Attributes:
        slots: (m,) int64, slots of the nodes before the frame is merged, ascending.
        ids: (m,) int64, ids of the nodes.
        visibilities: (m,) int64, how much of each is visible and present, of `VISIBILITIES`.
        through: (m,) bool, whether the frame sees through most of it.
        covered: (n, m) float64, the fraction of its present points in the mask of each object; NaN
            if too few are present, or without instances.
    """

    slots: Int64
    ids: Int64
    visibilities: Int64
    through: Bool
    covered: Float64


def see(nodes: NodeTable, slots: Int64, local: LocalGraph, frame: FrameArrays) -> View:
    """Compare a frame with some nodes.

    Args:
        nodes: of the graph.
        slots: (m,) of the nodes to compare with it.
        local: the frame.
        frame: its arrays, with those of its depth grid.
    """
    visibilities, through, covered = _see(
        nodes.surface_points_world, nodes.surface_counts, slots, local.instance_ids, frame
    )
    if local.depth_grid is None or local.depth_grid.instances is None:
        covered[:] = np.nan
    return View(slots, nodes.ids[slots], visibilities, through, covered)


def see_nothing(local: LocalGraph) -> View:
    """The view of a frame without a depth grid."""
    none = np.zeros(0, np.int64)
    return View(none, none, none, none.astype(bool), np.zeros((len(local), 0)))


def frame_arrays(T_camera_world: Float64, grid: DepthGrid) -> FrameArrays:
    """The arrays of a frame for kernels; without instances, no pixel shows an object."""
    camera, per_px = grid.intrinsics, 1.0 / grid.stride_px
    instances = np.zeros_like(grid.depth_mm) if grid.instances is None else grid.instances
    # Images of a message are read-only, those of the lifting stage are not.
    depth_mm, instances = read_only(grid.depth_mm, np.uint16), read_only(instances, np.uint16)
    intrinsics = camera.fx * per_px, camera.fy * per_px, camera.cx * per_px, camera.cy * per_px
    return T_camera_world, depth_mm, instances, intrinsics


def with_seen(covered: Float64, slots: Int64, view: View) -> Float64:
    """Fractions (n, k) of some nodes, from the view where it knows the node."""
    if not len(view.slots):
        return covered
    places = view.slots.searchsorted(slots)
    places[places == len(view.slots)] = 0
    seen = view.covered.take(places, 1)
    known = (view.slots.take(places) == slots) & (seen == seen)  # not NaN
    return np.where(known, seen, covered)


@kernel
def _see(
    points: Float32, counts: Int64, slots: Int64, values: Int64, frame: FrameArrays
) -> tuple[Int64, Bool, Float64]:
    """The arrays of a `View` of some nodes; values (n,) are those of the objects in the image."""
    visibilities, through = np.empty(len(slots), np.int64), np.zeros(len(slots), np.bool_)
    covered = np.empty((len(values), len(slots)), np.float64)
    most = 0
    for index in range(len(values)):
        most = max(most, int(values[index]))
    object_of = np.empty(most + 1, np.int64)
    for value in range(most + 1):
        object_of[value] = -1
    for index in range(len(values)):
        object_of[values[index]] = index
    hits, cells = np.empty(len(values), np.int64), np.empty(SAMPLED_POINTS, np.int64)
    for column in range(len(slots)):
        count = min(counts[slots[column]], SAMPLED_POINTS)
        visibilities[column] = NOT_VISIBLE
        for index in range(len(values)):
            hits[index], covered[index, column] = 0, np.nan
        behind, present, inside = _compare(
            points[slots[column]], count, object_of, hits, cells, frame
        )
        if present >= MIN_VISIBLE_POINTS:
            for index in range(len(values)):
                covered[index, column] = hits[index] / present
        visible = behind + present
        if visible < MIN_VISIBLE_POINTS or visible < MIN_IN_VIEW_FRACTION * count:
            continue
        half = visible >= MIN_VISIBLE_FRACTION * count
        if present >= DECISIVE_FRACTION * visible:
            visibilities[column] = QUARTER
            if half:
                visibilities[column] = FULL if inside >= FULL_VIEW_FRACTION * count else HALF
        if half and behind >= DECISIVE_FRACTION * visible:
            different = 0
            for index in range(behind):
                different += not (cells[:index] == cells[index]).any()
            through[column] = different >= MIN_THROUGH_CELLS
    return visibilities, through, covered


@kernel
def _compare(
    points: Float32,
    count: int,
    object_of: Int64,
    hits: Int64,
    cells: Int64,
    frame: FrameArrays,
) -> tuple[int, int, int]:
    """Number of points that are seen through, present, and in the image.

    Counts those in masks, and notes the cells of the depth grid that are seen through.
    """
    T, depth_mm, instances, (fx, fy, cx, cy) = frame
    height, width = depth_mm.shape
    behind = present = inside = 0
    for index in range(count):
        x, y = np.float64(points[index, 0]), np.float64(points[index, 1])
        z = np.float64(points[index, 2])
        right = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        down = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        ahead = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if ahead < NEAR_M:
            continue
        u, v = fx * right / ahead + cx, fy * down / ahead + cy
        if u < 0.0 or v < 0.0 or u >= width or v >= height:
            continue
        inside += 1
        measured_m = depth_mm[int(v), int(u)] * 0.001
        if measured_m == 0.0:
            continue
        tolerance_m = THROUGH_M + THROUGH_FRACTION * ahead
        if measured_m > ahead + tolerance_m:
            cells[behind] = int(v) * width + int(u)
            behind += 1
        elif measured_m > ahead - tolerance_m:
            present += 1
            value = instances[int(v), int(u)]
            if value < len(object_of) and object_of[value] >= 0:
                hits[object_of[value]] += 1
    return behind, present, inside


# --- Which nodes a frame may show: a grid over the means of the nodes.
#
# Space is divided into cubes. A frame is compared with the cubes that have nodes, and then with the
# nodes of the cubes in view. So its cost follows the nodes in view, and a fraction of a microsecond
# for each cube elsewhere.

# Edge of a cube: about a room, so that few cubes are in view, and few nodes of them are not.
CUBE_M = 4.0
# A node is compared if a ball of this many standard deviations around its mean may be in view.
BALL_DEVIATIONS = 3.0

# Of a frame: the principal point from the right and the lower side of the image, and the lengths of
# the normals of its four sides.
_Sides = tuple[float, float, float, float, float, float]


class NodeGrid:
    """The slots of nodes by the cube that contains their mean."""

    def __init__(self) -> None:
        self._cube_of: dict[tuple[int, ...], int] = {}
        # Of each cube: its place in cubes, a ball around the balls of all nodes ever in it, and its
        # first slot.
        self._keys, self._cubes = np.zeros((16, 3)), np.zeros((16, 4))
        self._firsts = np.full(16, -1)
        # Of each slot: the ball of its node, its cube, and the slots before and after it there.
        self._balls = np.zeros((64, 4))
        self._links = np.full((64, 3), -1)

    def put(self, slots: Int64, means_world: Float64, eigenvalue_bounds: Float64) -> None:
        """Set the Gaussians of n nodes, new or known.

        Args:
            slots: (n,) of the nodes in
            means_world: (N, 3) metres, and
            eigenvalue_bounds: (N,) square metres, see `NodeTable`.
        """
        if not len(slots):
            return
        while slots.max() >= len(self._balls):
            self._balls = np.concatenate((self._balls, np.zeros_like(self._balls)))
            self._links = np.concatenate((self._links, np.full_like(self._links, -1)))
        known = self._keys, self._cubes, self._balls, self._links
        moved = _stay(*known, slots, means_world, eigenvalue_bounds)
        if len(moved):
            keys = np.floor(means_world[moved] / CUBE_M).astype(np.int64)
            cube_of = self._cube_of
            cubes = np.array(
                [
                    cube_of[key] if key in cube_of else self._cube(key)
                    for key in map(tuple, keys.tolist())
                ]
            )
            _put(self._cubes, self._firsts, self._balls, self._links, moved, cubes)

    def remove(self, slot: int) -> None:
        """Remove a slot, if it is in the grid."""
        if slot < len(self._links):
            _remove(self._firsts, self._links, slot)

    def in_view(self, frame: FrameArrays) -> Int64:
        """Slots whose nodes a frame may show, in any order.

        Their balls are not wholly behind the camera, beyond one side of the image, or farther than
        all measured depth.
        """
        known = len(self._cube_of)
        return _in_view(self._cubes[:known], self._firsts, self._balls, self._links, frame)

    def _cube(self, key: tuple[int, ...]) -> int:
        cube = self._cube_of.get(key)
        if cube is None:
            cube = self._cube_of[key] = len(self._cube_of)
            if cube == len(self._cubes):
                self._keys = np.concatenate((self._keys, np.zeros_like(self._keys)))
                self._cubes = np.concatenate((self._cubes, np.zeros_like(self._cubes)))
                self._firsts = np.concatenate((self._firsts, np.full_like(self._firsts, -1)))
            self._keys[cube] = key
            self._cubes[cube, :3] = [CUBE_M * (index + 0.5) for index in key]
        return cube


@kernel
def _remove(firsts: Int64, links: Int64, slot: int) -> None:
    cube, before, after = links[slot]
    if cube < 0:
        return
    if before >= 0:
        links[before, 2] = after
    else:
        firsts[cube] = after
    if after >= 0:
        links[after, 1] = before
    links[slot] = -1


@kernel
def _stay(
    keys: Float64,
    cubes: Float64,
    balls: Float64,
    links: Int64,
    slots: Int64,
    means: Float64,
    eigenvalue_bounds: Float64,
) -> Int64:
    """Set the balls of nodes; returns the slots of those that are in another cube now."""
    moved, count = np.empty(len(slots), np.int64), 0
    for slot in slots:
        is_same, cube = True, links[slot, 0]
        for axis in range(3):
            balls[slot, axis] = means[slot, axis]
            is_same &= cube >= 0 and math.floor(means[slot, axis] / CUBE_M) == keys[cube, axis]
        balls[slot, 3] = BALL_DEVIATIONS * math.sqrt(eigenvalue_bounds[slot])
        if is_same:
            reach = math.sqrt(0.75) * CUBE_M + balls[slot, 3]
            cubes[cube, 3] = max(cubes[cube, 3], reach)
        else:
            moved[count] = slot
            count += 1
    return moved[:count].copy()


@kernel
def _put(
    cubes: Float64,
    firsts: Int64,
    balls: Float64,
    links: Int64,
    slots: Int64,
    new_cubes: Int64,
) -> None:
    """Put nodes, whose balls are known, into other cubes."""
    for index in range(len(slots)):
        slot, cube = slots[index], new_cubes[index]
        reach = math.sqrt(0.75) * CUBE_M + balls[slot, 3]
        cubes[cube, 3] = max(cubes[cube, 3], reach)
        if links[slot, 0] == cube:
            continue
        _remove(firsts, links, slot)
        links[slot, 0], links[slot, 2] = cube, firsts[cube]
        if firsts[cube] >= 0:
            links[firsts[cube], 1] = slot
        firsts[cube] = slot


@kernel
def _may_show(ball: Float64, frame: FrameArrays, sides: _Sides, far_m: float) -> bool:
    """Whether a ball, centre and radius, may be in view."""
    T, _, _, (fx, fy, cx, cy) = frame
    right, below, leftwards, rightwards, upwards, downwards = sides
    x, y, z, radius = ball
    ahead = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    # Some points may lie outside the ball: near the far end, twice its radius counts.
    if ahead < NEAR_M - radius or ahead > far_m + 2.0 * radius:
        return False
    across = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    down = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    return not (
        fx * across + cx * ahead < -radius * leftwards
        or fx * across + right * ahead > radius * rightwards
        or fy * down + cy * ahead < -radius * upwards
        or fy * down + below * ahead > radius * downwards
    )


@kernel
def _in_view(
    cubes: Float64, firsts: Int64, balls: Float64, links: Int64, frame: FrameArrays
) -> Int64:
    depth_mm, farthest = frame[1], np.uint16(0)
    for row in range(depth_mm.shape[0]):
        for column in range(depth_mm.shape[1]):
            farthest = max(farthest, depth_mm[row, column])
    _, _, _, (fx, fy, cx, cy) = frame
    right, below = cx - depth_mm.shape[1], cy - depth_mm.shape[0]
    lengths = math.hypot(fx, cx), math.hypot(fx, right), math.hypot(fy, cy), math.hypot(fy, below)
    sides = right, below, *lengths
    # Beyond this, no measured depth is within the tolerance of a point.
    far_m = (0.001 * farthest + THROUGH_M) / (1.0 - THROUGH_FRACTION)
    slots, count = np.empty(64, np.int64), 0
    for cube in range(len(cubes)):
        slot = firsts[cube]
        if slot < 0 or not _may_show(cubes[cube], frame, sides, far_m):
            continue
        while slot >= 0:
            if count == len(slots):
                slots = np.concatenate((slots, slots))
            slots[count] = slot
            count += int(_may_show(balls[slot], frame, sides, far_m))
            slot = links[slot, 2]
    return slots[:count].copy()
