"""The extent of a surface: even moments, a gravity-aligned box, and its points as compact bytes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.scene.checks import check_array
from deworldsg_ros.scene.limits import MAX_GRAPH_COORDINATE_M
from deworldsg_ros.wire import messages as wire

# Radius in which the density of points is counted: half a cell of the surface map.
EVEN_RADIUS_M = 0.015
# A point is an outlier if its third neighbour is farther away than this many times the
# median of that distance. Mixed pixels at depth edges lie apart from the surface. Chosen on the two
# rendered rooms: 1.5 cuts corners off, 3 keeps mixed pixels.
OUTLIER_FACTOR = 2.0
# Where the images tell which points are the node's, a point so near its third neighbour is never an
# outlier: the seat of a chair behind a table is in few views, and its points lie far apart.
NEAR_ENOUGH_M = 0.06
# So few points have no outliers.
FEW_POINTS = 6
# A part of a surface so far from the rest, horizontally, and with so much fewer points than the
# largest one, belongs to something else: the legs of a chair are nearer to one another.
PART_GAP_M, SMALL_PART = 0.12, 0.1
# With fewer points that the images show as the node's, its box is around all points.
MIN_SHOWN_POINTS = 8
# Weights of points with these many points around.
_EVEN_WEIGHTS = np.append(0.0, np.arange(1.0, 4097.0) ** -0.5)
# Headings of a box, over 90 degrees, about up from the first of `horizontal_axes`. The smallest
# rectangle around two sides of a cabinet lies along its diagonal; the one whose sides are nearest
# to the points does not.
HEADINGS = 45
_HEADINGS = 0.5 * math.pi * np.arange(HEADINGS) / HEADINGS
_COSINES = np.array([math.cos(heading) for heading in _HEADINGS])
_SINES = np.array([math.sin(heading) for heading in _HEADINGS])
# Bounds of all headings, in whole cache lines: across lines, they take up to twice the time.
ALIGNED_HEADINGS = 48
# Points of a box, the first ones: surfaces are stored in random order, and have no more in a graph.
# With 256, ten of 154 boxes lose a part that few views show. Without images, which tell the points
# of other objects apart, that many are enough.
MOST_POINTS, FEWER_POINTS = 512, 256
# A box has the heading of its room unless its points are nearer to the sides of another one, on
# average, by more than their noise: plates have no heading, books and clocks have few points.
CLEARER_M = 0.006
# The up of the world frame if nothing tells it (REP 103).
DEFAULT_UP = (0.0, 0.0, 1.0)
# Points that spread less are at one place: the number of buckets for each metre stays finite.
LEAST_SPREAD_M = 1e-12
# Decimals of numbers in messages: positions to 0.1 mm, variances to (0.3 mm)², so that a thin
# object keeps its thickness.
POSITION_DECIMALS, VARIANCE_DECIMALS = 4, 7
BOX_DECIMALS, QUATERNION_DECIMALS = 3, 4
# Of mean, covariance, centre, size and quaternion.
_DECIMALS = [POSITION_DECIMALS] * 3 + [VARIANCE_DECIMALS] * 9 + [BOX_DECIMALS] * 6
_SCALES = 10.0 ** np.array([*_DECIMALS, *[QUATERNION_DECIMALS] * 4])
# Points in messages are int16 millimetres.
_MOST_MM = 32767


class Extent(NamedTuple):
    """The extent of one surface, as messages have it.

    Attributes:
        mean_m: (3,) and
        covariance_m2: (9,); see `even_moments`.
        box: without outliers.
        side_m: the longer one of the footprint whose sides are nearest to the points, and
        step: its heading, in `HEADINGS`: the box may have that of the room.
    """

    mean_m: list[float]
    covariance_m2: list[float]
    box: wire.GravityBox
    side_m: float
    step: int


def extents_of(
    points_world: Float32,
    counts: Int64,
    rows: Int64,
    up: Sequence[float],
    shown: Bool | None = None,
    room_step: int | None = None,
) -> list[Extent]:
    """Extents of the surfaces of some rows.

    Args:
        points_world: (S, K, 3) metres; the first `counts` of each row are used.
        counts: (S,) 1 or more in the rows.
        rows: (n,).
        up: unit vector against gravity.
        shown: (n, K) bool, points that the images show as the node's. The boxes are around these;
            None = not known.
        room_step: heading of the room, in `HEADINGS`: boxes whose points tell no other one have
            it. None = not known.
    """
    step, clearer_m = (0, 0.0) if room_step is None or shown is None else (room_step, CLEARER_M)
    frame, measured = _frame_of(tuple(up), step), np.empty((len(rows), 24))
    for index, (row, count) in enumerate(zip(rows.tolist(), counts[rows].tolist())):
        columns, result = _columns(points_world[row, :count]), measured[index]
        _even_moments(columns, result[:12])
        if shown is not None and shown[index, :count].sum() >= MIN_SHOWN_POINTS:
            columns = np.ascontiguousarray(columns[:, shown[index, :count]])
        _box_around(columns, *frame, shown is None, clearer_m, result[12:])
    sides_m, turns = measured[:, 22].tolist(), measured[:, 23].astype(np.int64)
    steps = ((turns + step) % HEADINGS).tolist()
    return [
        Extent(row[:3], row[3:12], wire.GravityBox(row[12:15], row[15:18], row[18:]), *own)
        for row, *own in zip(_rounded(measured[:, :22]).tolist(), sides_m, steps)
    ]


def _box_around(
    columns: Float64,
    axes: Float64,
    quat_axes: Float64,
    is_smallest: bool,
    clearer_m: float,
    box: Float64,
) -> None:
    """Write the box around columns (3, n) without outliers, see `_box`.

    The smallest one is around all parts of fewer points.
    """
    if is_smallest:
        columns = columns[:, :FEWER_POINTS].copy()
    upright, squared = _third_neighbours(columns, axes)
    limit = OUTLIER_FACTOR**2 * float(np.median(squared))
    if not is_smallest:
        limit = max(limit, NEAR_ENOUGH_M**2)
    upright = upright[:, squared <= limit]
    if not is_smallest:
        upright = upright[:, _in_main_parts(np.ascontiguousarray(upright))]
    _box(np.ascontiguousarray(upright), axes, quat_axes, is_smallest, clearer_m, box)


def rounded_gaussians(means: Float64, covariances: Float64, rows: Int64) -> list[list[float]]:
    """Mean and covariance (12,) of some rows of (N, 3) and (N, 3, 3), as messages have them."""
    gaussians = np.concatenate([means[rows], covariances[rows].reshape(-1, 9)], axis=1)
    found: list[list[float]] = _rounded(gaussians).tolist()
    return found


def _rounded(numbers: Float64) -> Float64:
    """The first columns of (n, 22) as `rounded`, each with its decimals."""
    scales = _SCALES[: numbers.shape[1]]
    return np.asarray(np.rint(numbers * scales) / scales + 0.0)


def even_moments(points_world: Float32) -> tuple[Float64, Float64]:
    """Mean (3,) and covariance (3, 3) of a surface with uneven point density.

    Points (n, 3), n >= 1, are dense on parts that were seen longer or from nearby. The weight of a
    point is the inverse square root of the number of points within `EVEN_RADIUS_M`. The inverse
    itself would give a stray point the weight of a whole patch. The covariance of a ball of that
    radius is added.

    Raises:
        ValueError: without points, or for one that is not finite or out of reach.
    """
    _check_points(points_world)
    moments = np.empty(12)
    _even_moments(_columns(points_world), moments)
    return moments[:3], moments[3:].reshape(3, 3)


def box_of(points_world: Float32 | Float64, up: Sequence[float]) -> wire.GravityBox:
    """The box around points (n, 3), n >= 1, without outliers.

    Args:
        points_world: metres.
        up: unit vector against gravity.

    Raises:
        ValueError: without points, or for one that is not finite or out of reach.
    """
    _check_points(points_world)
    box = np.empty(12)
    _box_around(_columns(points_world), *_frame_of(tuple(up), 0), True, 0.0, box)
    return wire.GravityBox(
        rounded(box[:3], BOX_DECIMALS),
        rounded(box[3:6], BOX_DECIMALS),
        rounded(box[6:10], QUATERNION_DECIMALS),
    )


def _check_points(points_world: Float32 | Float64) -> None:
    """The kernels take their indices from the points."""
    if not len(points_world):
        raise ValueError("a surface without points: expected at least one")
    # Corners of a box around a Gaussian may lie outside of the limit of its mean.
    check_array("points", points_world, (len(points_world), 3), 4 * MAX_GRAPH_COORDINATE_M)


def _columns(points: Float32 | Float64) -> Float64:
    """Points (n, 3) as the kernels take them: (3, n) float64."""
    return np.ascontiguousarray(points.T, np.float64)


def horizontal_axes(up: Sequence[float]) -> Float64:
    """Rows (3, 3): two horizontal unit vectors and up, right-handed; the identity for +z."""
    third = np.asarray(up, np.float64) / np.linalg.norm(up)
    first = np.eye(3)[0 if abs(third[0]) < 0.9 else 1]
    first = first - third * (first @ third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


@lru_cache(maxsize=4)
def _frame_of(up: tuple[float, ...], step: int) -> tuple[Float64, Float64]:
    """`horizontal_axes` turned to a heading, and their quaternion: both change seldom."""
    axes = horizontal_axes(up)
    if step:
        turn_rad = _HEADINGS[step] - (0.5 * math.pi if step > HEADINGS // 2 else 0.0)
        cos, sin = math.cos(turn_rad), math.sin(turn_rad)
        axes = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ axes
    # A column of eigenvectors has another layout than its opposite: one kernel is enough.
    return axes, np.ascontiguousarray(quaternion_from_rotation(axes.T))


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
def _along_widest(columns: Float64) -> tuple[Float64, int]:
    """Points, columns (3, n), in the order of the coordinate that spreads most; and its axis."""
    count = columns.shape[1]
    widest, low, spread = 0, 0.0, -1.0
    for axis in range(3):
        least, most = columns[axis, 0], columns[axis, 0]
        for place in range(1, count):
            least, most = min(least, columns[axis, place]), max(most, columns[axis, place])
        if most - least > spread:
            widest, low, spread = axis, least, most - least
    # As many buckets as points; then each point is near its place.
    per_m = (count - 1) / spread if spread > LEAST_SPREAD_M else 0.0
    starts = np.zeros(count + 1, np.int64)
    for place in range(count):
        starts[int((columns[widest, place] - low) * per_m) + 1] += 1
    for bucket in range(count):
        starts[bucket + 1] += starts[bucket]
    order = np.empty(count, np.int64)
    for place in range(count):
        bucket = int((columns[widest, place] - low) * per_m)
        order[starts[bucket]] = place
        starts[bucket] += 1
    for index in range(1, count):
        place, at = order[index], index
        while at > 0 and columns[widest, order[at - 1]] > columns[widest, place]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = place
    ordered = np.empty((3, count), np.float64)
    for axis in range(3):
        for index in range(count):
            ordered[axis, index] = columns[axis, order[index]]
    return ordered, widest


@kernel
def _even_moments(columns: Float64, moments: Float64) -> None:
    """Write `even_moments` of columns (3, n): the mean and the covariance, (12,)."""
    ordered, widest = _along_widest(columns)
    x, y, z, along = ordered[0], ordered[1], ordered[2], ordered[widest]
    count = len(along)
    weights = np.empty(count, np.float64)
    first, last, total = 0, 0, 0.0
    for a in range(count):
        while along[a] - along[first] > EVEN_RADIUS_M:
            first += 1
        while last < count and along[last] - along[a] <= EVEN_RADIUS_M:
            last += 1
        # The compiler makes vectors of this.
        xs, ys, zs, near = x[first:last], y[first:last], z[first:last], 0
        for b in range(len(xs)):
            step_x, step_y, step_z = x[a] - xs[b], y[a] - ys[b], z[a] - zs[b]
            squared = step_x * step_x + step_y * step_y + step_z * step_z
            near += int(squared <= EVEN_RADIUS_M * EVEN_RADIUS_M)
        weights[a] = _EVEN_WEIGHTS[min(near, len(_EVEN_WEIGHTS) - 1)]
        total += weights[a]
    # One pass for all sums: the processor adds to them at the same time.
    mean_x = mean_y = mean_z = 0.0
    for a in range(count):
        weights[a] = weights[a] / total
        mean_x += weights[a] * x[a]
        mean_y += weights[a] * y[a]
        mean_z += weights[a] * z[a]
    xx = yy = zz = EVEN_RADIUS_M**2 / 5
    xy = xz = yz = 0.0
    for a in range(count):
        step_x, step_y, step_z = x[a] - mean_x, y[a] - mean_y, z[a] - mean_z
        by_x, by_y = weights[a] * step_x, weights[a] * step_y
        xx += by_x * step_x
        xy += by_x * step_y
        xz += by_x * step_z
        yy += by_y * step_y
        yz += by_y * step_z
        zz += weights[a] * step_z * step_z
    moments[0], moments[1], moments[2] = mean_x, mean_y, mean_z
    moments[3], moments[7], moments[11] = xx, yy, zz
    moments[4] = moments[6] = xy
    moments[5] = moments[9] = xz
    moments[8] = moments[10] = yz


@kernel
def _third_neighbours(columns: Float64, axes: Float64) -> tuple[Float64, Float64]:
    """The first of columns (3, n), turned to axes, and squared distances from the third neighbour.

    Of few points, all distances are 0.
    """
    count = min(columns.shape[1], MOST_POINTS)
    upright, squared = np.zeros((3, count), np.float64), np.zeros(count, np.float64)
    for axis in range(3):
        for k in range(3):
            if axes[axis, k] != 0.0:
                for place in range(count):
                    upright[axis, place] += axes[axis, k] * columns[k, place]
    ordered, widest = _along_widest(upright)
    x, y, z, along = ordered[0], ordered[1], ordered[2], ordered[widest]
    for row in range(count if count > FEW_POINTS else 0):
        # Squared distances of the three nearest points so far. Without branches: on new points, no
        # processor predicts them.
        near_1 = near_2 = near_3 = np.inf
        for step in (1, -1):
            other = row + step
            while 0 <= other < count:
                apart = along[other] - along[row]
                if apart * apart >= near_3:
                    break
                step_x, step_y, step_z = x[other] - x[row], y[other] - y[row], z[other] - z[row]
                found = step_x * step_x + step_y * step_y + step_z * step_z
                near_3 = min(near_3, max(near_2, found))
                near_2 = min(near_2, max(near_1, found))
                near_1 = min(near_1, found)
                other += step
        squared[row] = near_3
    return ordered, squared


@kernel
def _in_main_parts(upright: Float64) -> Bool:
    """Which of points (3, n) belong to a part of the footprint that is not small; (n,) bool.

    Points within `PART_GAP_M` of one another, horizontally, are of one part.
    """
    count, parts = upright.shape[1], 0
    part_of, sizes = np.full(count, -1), np.zeros(count, np.int64)
    waiting = np.empty(count, np.int64)
    for first in range(count):
        if part_of[first] >= 0:
            continue
        part_of[first], waiting[0], last = parts, first, 1
        while last > 0:
            last -= 1
            place = waiting[last]
            sizes[parts] += 1
            for other in range(count):
                step_x = upright[0, other] - upright[0, place]
                step_y = upright[1, other] - upright[1, place]
                near = step_x * step_x + step_y * step_y <= PART_GAP_M * PART_GAP_M
                if near and part_of[other] < 0:
                    part_of[other], waiting[last] = parts, other
                    last += 1
        parts += 1
    large: Bool = sizes[part_of] >= SMALL_PART * sizes.max()
    return large


@kernel
def _box(
    upright: Float64,
    axes: Float64,
    quat_axes: Float64,
    is_smallest: bool,
    clearer_m: float,
    box: Float64,
) -> None:
    """Write the box around upright points (3, n): centre, size and quaternion, (10,).

    Its footprint is the smallest, or the one whose sides are nearest to the points. It lies along
    the axes unless the points are nearer to another by `clearer_m`. The last two numbers are the
    longer side of the nearest, and the step of its heading.
    """
    # Vertical bounds, and horizontal ones along the axes of each heading.
    low, high, bounds = np.inf, -np.inf, np.empty((4, ALIGNED_HEADINGS), np.float64)
    lefts, rights, backs, fronts = bounds[0], bounds[1], bounds[2], bounds[3]
    for step in range(HEADINGS):
        lefts[step], rights[step], backs[step], fronts[step] = np.inf, -np.inf, np.inf, -np.inf
    for place in range(upright.shape[1]):
        x, y, z = upright[0, place], upright[1, place], upright[2, place]
        low, high = min(low, z), max(high, z)
        # The compiler makes vectors of this.
        for step in range(HEADINGS):
            u = _COSINES[step] * x + _SINES[step] * y
            v = _COSINES[step] * y - _SINES[step] * x
            lefts[step], rights[step] = min(lefts[step], u), max(rights[step], u)
            backs[step], fronts[step] = min(backs[step], v), max(fronts[step], v)
    costs = np.zeros(ALIGNED_HEADINGS, np.float64)
    for step in range(HEADINGS if is_smallest else 0):
        costs[step] = (rights[step] - lefts[step]) * (fronts[step] - backs[step])
    for place in range(0 if is_smallest else upright.shape[1]):
        x, y = upright[0, place], upright[1, place]
        for step in range(HEADINGS):
            u = _COSINES[step] * x + _SINES[step] * y
            v = _COSINES[step] * y - _SINES[step] * x
            apart = min(u - lefts[step], rights[step] - u)
            costs[step] += min(apart, v - backs[step], fronts[step] - v) / upright.shape[1]
    best = 0
    for step in range(1, HEADINGS):
        # Ties go to the axes.
        if costs[step] < costs[best] - 1e-12:
            best = step
    box[10] = max(rights[best] - lefts[best], fronts[best] - backs[best])
    box[11] = best
    if costs[0] <= costs[best] + clearer_m:
        best = 0
    left, right, back, front = lefts[best], rights[best], backs[best], fronts[best]
    turn_rad = _HEADINGS[best]
    if not is_smallest and best > HEADINGS // 2:
        # The same, a quarter turn back: the sides keep their names if a heading of 0 varies.
        turn_rad -= 0.5 * math.pi
        left, right, back, front = -front, -back, left, right
    box[3], box[4], box[5] = right - left, front - back, high - low
    u, v, w = (left + right) / 2, (back + front) / 2, (low + high) / 2
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    for axis in range(3):
        box[axis] = (
            (cos * u - sin * v) * axes[0, axis]
            + (sin * u + cos * v) * axes[1, axis]
            + w * axes[2, axis]
        )
    # The turn about the third axis, after the axes.
    qx, qy, qz, qw = quat_axes[0], quat_axes[1], quat_axes[2], quat_axes[3]
    cos, sin = math.cos(turn_rad / 2), math.sin(turn_rad / 2)
    sign = -1.0 if qw * cos - qz * sin < 0 else 1.0
    box[6], box[7] = sign * (qx * cos + qy * sin), sign * (qy * cos - qx * sin)
    box[8], box[9] = sign * (qz * cos + qw * sin), sign * (qw * cos - qz * sin)
