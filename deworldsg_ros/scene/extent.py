"""The extent of a surface: a gravity-aligned box, and its points as compact bytes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float32, Float64, Int64
from deworldsg_ros.scene.camera import quaternion_from_rotation

# A point is an outlier if its `NEIGHBOURS`-th neighbour is farther away than this many times the
# median of that distance. Mixed pixels at depth edges lie apart from the surface. Chosen on the two
# rendered rooms: 1.5 cuts corners off, 3 keeps mixed pixels.
NEIGHBOURS = 3
OUTLIER_FACTOR = 2.0
# Heading of a box: the smallest rectangle of this many directions over 90 degrees.
DIRECTIONS = 45
# Points of a box, the first ones: surfaces are stored in random order. 256 of 512 take a quarter of
# the time and cost 0.2 cm of the median extent.
MOST_POINTS = 256
# The up of the world frame if nothing tells it (REP 103).
DEFAULT_UP = (0.0, 0.0, 1.0)
# Points in messages are int16 millimetres.
_MOST_MM = 32767


def box_of(points_world: Float32 | Float64, up: Sequence[float]) -> wire.GravityBox:
    """The box around points (n, 3), n >= 1, without outliers.

    Args:
        points_world: metres.
        up: unit vector against gravity.
    """
    axes, quat_axes = _frame_of(tuple(up))
    points = np.ascontiguousarray(points_world[:MOST_POINTS], np.float64) @ axes.T
    low, high, heading = _bounds(points)
    cos, sin = math.cos(heading), math.sin(heading)
    turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    rotation = turn @ axes  # rows: axes of the box in the world
    return wire.GravityBox(
        center_m=rounded((low + high) / 2 @ rotation, 3),
        size_m=rounded(high - low, 3),
        orientation_xyzw=rounded(_turned(quat_axes, heading), 4),
    )


def horizontal_axes(up: Sequence[float]) -> Float64:
    """Rows (3, 3): two horizontal unit vectors and up, right-handed; the identity for +z."""
    third = np.asarray(up, np.float64) / np.linalg.norm(up)
    first = np.eye(3)[0 if abs(third[0]) < 0.9 else 1]
    first = first - third * (first @ third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


@lru_cache(maxsize=4)
def _frame_of(up: tuple[float, ...]) -> tuple[Float64, Float64]:
    """`horizontal_axes`, and their quaternion: every box needs them, and up changes seldom."""
    axes = horizontal_axes(up)
    return axes, quaternion_from_rotation(axes.T)


def _turned(quat_xyzw: Float64, heading: float) -> Float64:
    """A quaternion after a turn about its own third axis; w >= 0."""
    x, y, z, w = quat_xyzw.tolist()
    cos, sin = math.cos(heading / 2), math.sin(heading / 2)
    turned = np.array([x * cos + y * sin, y * cos - x * sin, z * cos + w * sin, w * cos - z * sin])
    return -turned if turned[3] < 0 else turned


def rounded(values: Float64, decimals: int) -> list[float]:
    """Flat list of rounded values, without negative zeros."""
    flat: list[float] = (np.round(values, decimals) + 0.0).ravel().tolist()
    return flat


def surface_bytes(points_world: Float32, mean_m: Sequence[float]) -> bytes:
    """Points (n, 3) for `NodeState.surface_mm`; points farther than 32 m are left out."""
    offsets = np.rint((points_world.astype(np.float64) - mean_m) * 1e3)
    offsets = offsets[(np.abs(offsets) <= _MOST_MM).all(axis=1)]
    return offsets.astype("<i2").tobytes()


def surface_points(node: wire.NodeState) -> Float64:
    """The surface points (n, 3) of a message of any version, metres; (0, 3) without them."""
    if isinstance(node.surface_mm, bytes):
        whole = len(node.surface_mm) // 6 * 6
        offsets = np.frombuffer(node.surface_mm[:whole], "<i2").reshape(-1, 3)
        return np.asarray(offsets * 1e-3 + np.array(node.mean_m))
    points = node.surface_points_m if isinstance(node.surface_points_m, list) else []
    return np.array(points, np.float64).reshape(-1, 3)


@kernel
def _bounds(points: Float64) -> tuple[Float64, Float64, float]:
    """Lower and upper corner (3,) along the axes of the smallest box, and its heading."""
    by_y = points[np.argsort(points[:, 1])]
    ordered = by_y[np.argsort(by_y[:, 0], kind="mergesort")]
    inliers = ordered[_inliers(ordered)]
    # Only corners of the convex hull touch a box.
    hull = _hull(inliers)
    best, heading = np.inf, 0.0
    for step in range(DIRECTIONS):
        angle = 0.5 * np.pi * step / DIRECTIONS
        low, high = _corners(hull, np.cos(angle), np.sin(angle))
        area = (high[0] - low[0]) * (high[1] - low[1])
        # Ties go to the axes of the world.
        if area < best - 1e-12:
            best, heading = area, angle
    low, high = _corners(hull, np.cos(heading), np.sin(heading))
    low[2], high[2] = inliers[:, 2].min(), inliers[:, 2].max()
    return low, high, heading


@kernel
def _corners(points: Float64, cos: float, sin: float) -> tuple[Float64, Float64]:
    """Horizontal bounds along turned axes; the third value is not set."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for row in range(len(points)):
        x, y = points[row, 0], points[row, 1]
        u, v = cos * x + sin * y, cos * y - sin * x
        low[0], high[0] = min(low[0], u), max(high[0], u)
        low[1], high[1] = min(low[1], v), max(high[1], v)
    return low, high


@kernel
def _hull(ordered: Float64) -> Float64:
    """Corners (k, 3) of the convex hull of points seen from above, sorted by x and y."""
    count = len(ordered)
    rows = np.empty(2 * count + 2, np.int64)
    size = 0
    for turn in range(2):  # the lower side from the left, then the upper side from the right
        start = size
        for index in range(count):
            row = index if turn == 0 else count - 1 - index
            while size - start >= 2 and _turns_right(ordered, rows[size - 2], rows[size - 1], row):
                size -= 1
            rows[size] = row
            size += 1
    return ordered[rows[:size]]


@kernel
def _turns_right(points: Float64, a: int, b: int, c: int) -> bool:
    ux, uy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
    vx, vy = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1]
    return bool(ux * vy - uy * vx <= 0.0)


@kernel
def _inliers(ordered: Float64) -> Int64:
    """Rows of points, sorted by x, that have neighbours as close as the others have."""
    count = len(ordered)
    if count <= 2 * NEIGHBOURS:
        return np.arange(count)
    last = np.empty(count)
    nearest = np.empty(NEIGHBOURS)
    for row in range(count):
        nearest[:] = np.inf
        for step in (1, -1):
            other = row + step
            while 0 <= other < count:
                x = ordered[other, 0] - ordered[row, 0]
                y = ordered[other, 1] - ordered[row, 1]
                z = ordered[other, 2] - ordered[row, 2]
                if x * x >= nearest[NEIGHBOURS - 1]:
                    break
                _insert(nearest, x * x + y * y + z * z)
                other += step
        last[row] = nearest[NEIGHBOURS - 1]
    return np.flatnonzero(last <= OUTLIER_FACTOR**2 * np.median(last))


@kernel
def _insert(smallest: Float64, value: float) -> None:
    """Insert a value into an ascending row that keeps its length."""
    place = len(smallest) - 1
    if value >= smallest[place]:
        return
    while place > 0 and smallest[place - 1] > value:
        smallest[place] = smallest[place - 1]
        place -= 1
    smallest[place] = value
