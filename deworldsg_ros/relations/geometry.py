"""The fused geometry of two nodes: their shapes, whether they are in reach, and features of both.

All lengths are metres in an upright frame: axes 0 and 1 are horizontal, axis 2 is up.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64

# Points of a node that its shape uses, which is all that a node keeps. With half of them, tables
# have no point near the small objects on them.
SHAPE_POINTS = 512
# Bounds leave out this fraction of the points at either end: masks bleed, and edges fly.
TRIM_FRACTION = 0.02
# An object rests on a surface within this horizontal distance of its own bounds.
MARGIN_M = 0.06
# Half the height of the layer in which a bottom touches a surface.
LAYER_M = 0.035
# Points of a surface count for its height beside an object by exp(-(distance / this)²).
SOFT_RADIUS_M = 0.15
# Points of an object so near the bounds of the other one are compared, this many of them.
NEAR_BOUNDS_M, NEAR_POINTS = 0.15, 48
# Nodes in arrays of turned points at once, so that a whole map needs no large ones.
TURNED_AT_ONCE = 256
_NO_TURN = np.eye(3)
_SLANT = np.float32(0.5**0.5)

FEATURES = (
    "gap_m", "overlap_small_m", "overlap_large_m", "overlap_up_m", "covered", "covers",
    "bottom_to_surface_m", "ring", "ring_points", "higher", "lower", "surface_spread_m",
    "soft_bottom_to_surface_m", "soft_points", "level_fraction",
    "enclosed", "encloses", "inside", "around", "distance_m", "mahalanobis",
    "bottom_over_bottom_m", "top_over_top_m", "bottom_over_top_m", "top_over_bottom_m",
    "bottom_over_floor_m", "object_bottom_over_floor_m",
    "log_length", "log_width", "log_height",
    "object_log_length", "object_log_width", "object_log_height", "log_length_ratio",
    "log_points", "object_log_points",
)  # fmt: skip


def measure(
    shapes: NDArray[np.void],
    slots: Int64,
    points_world: Float32,
    counts: Int64,
    R_up_world: Float64,
) -> None:
    """Write the shapes of nodes.

    Args:
        shapes: (n,) of `SHAPE`.
        slots: (k,) of the nodes, in it and in
        points_world: (n, K, 3) samples of surfaces, world frame, and
        counts: (n,) numbers of their points.
        R_up_world: (3, 3) rotation from the world frame to the upright frame.
    """
    shapes["count"][slots] = np.minimum(counts[slots], SHAPE_POINTS)
    if is_upright(R_up_world):
        _measure(shapes, slots, points_world, slots)
        return
    for start in range(0, len(slots), TURNED_AT_ONCE):
        part = slots[start : start + TURNED_AT_ONCE]
        turned = upright(points_world[part], R_up_world)
        _measure(shapes, part, turned, np.arange(len(turned)))


def is_upright(R_up_world: Float64) -> bool:
    """Whether the world frame is the upright frame."""
    # One number tells it of most frames; to compare all takes longer.
    return R_up_world.item(8) == 1.0 and bool((R_up_world == _NO_TURN).all())


def upright(points_world: Float32, R_up_world: Float64) -> Float32:
    """Points (..., 3) float32 in the upright frame."""
    if is_upright(R_up_world):
        return points_world
    turned: Float32 = points_world @ R_up_world.T.astype(np.float32)
    return turned


@kernel
def _measure(shapes: NDArray[Any], slots: Int64, points: Float32, point_rows: Int64) -> None:
    """Bounds without outer points, mean and covariance of the points of nodes, in (S, K, 3)."""
    for index in range(len(slots)):
        shape = shapes[slots[index]]
        if not shape.count:
            continue
        cloud = points[point_rows[index], : shape.count]
        cut = int(np.rint(TRIM_FRACTION * (shape.count - 1)))
        for axis in range(5):
            # x, y, z and the diagonals x + y, y - x.
            along = cloud[:, axis] if axis < 3 else cloud[:, axis - 3] * _SLANT
            if axis >= 3:
                along += cloud[:, 4 - axis] * (_SLANT if axis == 3 else -_SLANT)
            least, greatest, total = _ends(along, cut)
            # Give back what the quantiles cut off an evenly covered surface. Not in height: most
            # visible points of a table are at one height.
            given = 0.0
            if axis != 2:
                given = (greatest - least) * TRIM_FRACTION / (1.0 - 2.0 * TRIM_FRACTION)
            if axis < 3:
                shape.low[axis], shape.high[axis] = least - given, greatest + given
                shape.mean[axis] = total / len(cloud)
            else:
                shape.slant_low[axis - 3] = least - given
                shape.slant_high[axis - 3] = greatest + given
        for i in range(3):
            for j in range(i, 3):
                total = 0.0
                for k in range(len(cloud)):
                    total += (cloud[k, i] - shape.mean[i]) * (cloud[k, j] - shape.mean[j])
                shape.covariance[i, j] = shape.covariance[j, i] = total / len(cloud)


@kernel
def _ends(coordinates: Float32, cut: int) -> tuple[float, float, float]:
    """The coordinates (n,) that `cut` others are below, and above; and the sum of all."""
    least = np.full(cut + 1, np.inf)
    greatest = np.full(cut + 1, -np.inf)
    total = 0.0
    for coordinate in coordinates:
        value = np.float64(coordinate)
        total += value
        if value < least[cut]:
            place = cut
            while place > 0 and least[place - 1] > value:
                least[place] = least[place - 1]
                place -= 1
            least[place] = value
        if value > greatest[cut]:
            place = cut
            while place > 0 and greatest[place - 1] < value:
                greatest[place] = greatest[place - 1]
                place -= 1
            greatest[place] = value
    return least[cut], greatest[cut], total


def rotation_to_upright(up_world: Float64) -> Float64:
    """Rotation (3, 3) from the world frame to a frame whose axis 2 is `up_world` (3,).

    It is the smallest such rotation; for a world whose z axis is up, it is the identity.
    """
    up = up_world / np.linalg.norm(up_world)
    cosine = up[2]
    if cosine < -0.9999:
        return np.diag([1.0, -1.0, -1.0])
    x, y = up[0], up[1]
    factor = 1.0 / (1.0 + cosine)
    return np.array(
        [
            [1.0 - factor * x * x, -factor * x * y, -x],
            [-factor * x * y, 1.0 - factor * y * y, -y],
            [x, y, cosine],
        ]
    )


# --- A grid over the ground that finds the objects in reach of an object.
#
# Objects are places in an array of `SHAPE`. The cells that the bounds of an object touch are lists
# of entries, linked through arrays. Cells share a list if their hashes are equal.

# About the size of furniture: most objects touch one cell or two.
CELL_M = 2.0
# An object over more cells lies in all of them by another way: in a list that is always searched.
MAX_CELLS = 1024
# Lists of cells. The last one is of the objects over more cells than `MAX_CELLS`.
LISTS = 1 << 15
# Pairs of objects that are farther apart are not related: horizontally, vertically, and
# vertically for objects that are not over one another.
REACH_M = 0.6
OVER_REACH_M = 1.3
BESIDE_REACH_M = 0.15
# A node with fewer points has no reliable bounds; its relations are not judged.
MIN_SHAPE_POINTS = 8

# A span that no object has.
_NOWHERE = np.iinfo(np.int64).max


class _Lists(NamedTuple):
    """The arrays of a grid.

    Attributes:
        heads: (LISTS + 1,) first entry of each list; 0 = none.
        items: by entry, the object.
        next_: by entry, the next one of its list. Free entries are linked from entry 0.
        spans: by object, its cells, from left back to right front.
        seen: by object, the number of the last search that met it.
    """

    heads: Int64
    items: Int64
    next_: Int64
    spans: Int64
    seen: Int64


class ReachGrid:
    """The objects by the cells that they touch."""

    def __init__(self) -> None:
        self._lists = _Lists(
            np.zeros(LISTS + 1, np.int64),
            np.zeros(64, np.int64),
            np.append(np.arange(1, 64), 0),
            np.full((64, 4), _NOWHERE),
            np.zeros(64, np.int64),
        )
        self._searches = 0

    def put(self, item: int, low: Float64, high: Float64) -> None:
        """Set the bounds of an object; (3,) metres, axes 0 and 1 are horizontal."""
        while item >= len(self._lists.spans):
            spans, seen = self._lists.spans, self._lists.seen
            self._lists = self._lists._replace(
                spans=np.concatenate([spans, np.full_like(spans, _NOWHERE)]),
                seen=np.concatenate([seen, np.zeros_like(seen)]),
            )
        while not _put(self._lists, item, low, high):
            items, next_ = self._lists.items, self._lists.next_
            # The new entries are free; the old ones that are free come last.
            more = np.append(np.arange(len(items) + 1, 2 * len(items)), next_[0])
            self._lists = self._lists._replace(
                items=np.concatenate([items, np.zeros_like(items)]),
                next_=np.concatenate([next_, more]),
            )
            self._lists.next_[0] = len(items)

    def remove(self, item: int) -> None:
        """Forget an object, if it is known."""
        if item < len(self._lists.spans):
            _remove(self._lists, item)

    def pairs(self, changed: Int64, shapes: NDArray[np.void]) -> Int64:
        """Pairs (m, 2) of objects in reach, the first one of the changed ones; some twice.

        Args:
            changed: (k,) different places in
            shapes: (n,) of `SHAPE`, of all objects.
        """
        self._searches += len(changed)
        return _pairs(self._lists, self._searches - len(changed), changed, shapes)


def pairs_in_reach(shapes: NDArray[np.void]) -> Int64:
    """All pairs (m, 2) of places in reach, the smaller first; see `ReachGrid.pairs`."""
    grid = ReachGrid()
    solid = np.flatnonzero(shapes["count"] >= MIN_SHAPE_POINTS)
    for place in solid.tolist():
        grid.put(place, shapes["low"][place], shapes["high"][place])
    return np.unique(np.sort(grid.pairs(solid, shapes), axis=1), axis=0)


@kernel
def _span(low: Float64, high: Float64, more_m: float) -> tuple[int, int, int, int]:
    return (
        int(np.floor((low[0] - more_m) / CELL_M)),
        int(np.floor((low[1] - more_m) / CELL_M)),
        int(np.floor((high[0] + more_m) / CELL_M)),
        int(np.floor((high[1] + more_m) / CELL_M)),
    )


@kernel
def _cells(left: int, back: int, right: int, front: int) -> Int64:
    """The lists of the cells of a span."""
    if float(right - left + 1) * float(front - back + 1) > MAX_CELLS:
        return np.full(1, LISTS)
    lists = np.empty((right - left + 1) * (front - back + 1), np.int64)
    count = 0
    for x in range(left, right + 1):
        for y in range(back, front + 1):
            lists[count] = (x * 73856093 ^ y * 19349663) & (LISTS - 1)
            count += 1
    return lists


@kernel
def _put(lists: _Lists, item: int, low: Float64, high: Float64) -> bool:
    """False, and nothing is done, if there are too few free entries."""
    heads, items, next_, spans, _ = lists
    left, back, right, front = _span(low, high, 0.0)
    known = spans[item]
    if known[0] == left and known[1] == back and known[2] == right and known[3] == front:
        return True
    cells = _cells(left, back, right, front)
    free = 0
    entry = next_[0]
    while entry and free < len(cells):
        free += 1
        entry = next_[entry]
    if free < len(cells):
        return False
    _remove(lists, item)
    for cell in cells:
        entry = next_[0]
        next_[0] = next_[entry]
        items[entry] = item
        next_[entry] = heads[cell]
        heads[cell] = entry
    spans[item, 0], spans[item, 1], spans[item, 2], spans[item, 3] = left, back, right, front
    return True


@kernel
def _remove(lists: _Lists, item: int) -> None:
    heads, items, next_, spans, _ = lists
    if spans[item, 0] == _NOWHERE:
        return
    for cell in _cells(spans[item, 0], spans[item, 1], spans[item, 2], spans[item, 3]):
        before, entry = 0, heads[cell]
        while items[entry] != item:
            before, entry = entry, next_[entry]
        if before:
            next_[before] = next_[entry]
        else:
            heads[cell] = next_[entry]
        next_[entry] = next_[0]
        next_[0] = entry
    spans[item] = _NOWHERE


@kernel
def _pairs(lists: _Lists, searches: int, changed: Int64, shapes: NDArray[Any]) -> Int64:
    heads, items, next_, spans, seen = lists
    found = [(0, 0)][:0]
    for a in changed:
        searches += 1
        if shapes[a].count < MIN_SHAPE_POINTS:
            continue
        seen[a] = searches
        left, back, right, front = _span(shapes[a].low, shapes[a].high, REACH_M)
        cells = _cells(left, back, right, front)
        if len(cells) == 1 and cells[0] == LISTS:  # over as many cells: all objects
            for b in range(len(spans)):
                if spans[b, 0] != _NOWHERE and b != a and _in_reach(shapes[a], shapes[b]):
                    found.append((int(a), int(b)))
            continue
        for index in range(len(cells) + 1):
            entry = heads[cells[index] if index < len(cells) else LISTS]
            while entry:
                b = items[entry]
                if seen[b] != searches and _in_reach(shapes[a], shapes[b]):
                    found.append((int(a), int(b)))
                seen[b] = searches
                entry = next_[entry]
    pairs = np.empty((len(found), 2), np.int64)
    for index in range(len(found)):
        pairs[index, 0], pairs[index, 1] = found[index]
    return pairs


@kernel
def in_reach(pairs: Int64, shapes: NDArray[Any]) -> Bool:
    """Whether pairs of places (m, 2) are in reach, (m,) bool."""
    result = np.zeros(len(pairs), np.bool_)
    for index in range(len(pairs)):
        a, b = shapes[pairs[index, 0]], shapes[pairs[index, 1]]
        solid = a.count >= MIN_SHAPE_POINTS and b.count >= MIN_SHAPE_POINTS
        result[index] = solid and _in_reach(a, b)
    return result


@kernel
def _in_reach(a: Any, b: Any) -> bool:
    x = max(a.low[0], b.low[0]) - min(a.high[0], b.high[0])
    y = max(a.low[1], b.low[1]) - min(a.high[1], b.high[1])
    z = max(a.low[2], b.low[2]) - min(a.high[2], b.high[2])
    if x > REACH_M or y > REACH_M or z > OVER_REACH_M:
        return False
    return not (z > BESIDE_REACH_M and (x > BESIDE_REACH_M or y > BESIDE_REACH_M))


# --- Features of ordered pairs.


@kernel
def pair_features(
    first: Int64, second: Int64, shapes: NDArray[Any], points: Float32, floor_m: float
) -> Float64:
    """Features (2, m, len(FEATURES)) of pairs: first to second, and second to first.

    Args:
        first: (m,) places in the shapes, and
        second: (m,) places of the pairs.
        shapes: (n,) of `SHAPE`.
        points: (n, K, 3) points of the shapes in the upright frame; the first ``count`` are used.
        floor_m: height of the floor.
    """
    result = np.zeros((2, len(first), len(FEATURES)))
    for pair in range(len(first)):
        one, other = shapes[first[pair]], shapes[second[pair]]
        of_one, of_other = points[first[pair], : one.count], points[second[pair], : other.count]
        there, back = result[0, pair], result[1, pair]
        _bounds(there, one, other, floor_m)
        _contact(there, one, other, of_other)
        _contact(back, other, one, of_one)
        there[15] = _enclosure(one, of_other)
        there[16] = _enclosure(other, of_one)
        # Fractions of the points inside the bounds of the other object.
        inside_one = len(_near(of_one, other, 0.01, len(of_one)))
        inside_other = len(_near(of_other, one, 0.01, len(of_other)))
        there[17] = inside_one / max(1, len(of_one))
        there[18] = inside_other / max(1, len(of_other))
        there[19] = _distance(one, other, of_one, of_other)
        # The opposite direction, without what `_contact` writes.
        for place in (0, 1, 2, 3, 19, 20):
            back[place] = there[place]
        for place in (21, 22, 33):
            back[place] = -there[place]
        for place in (4, 15, 17, 25, 34):
            back[place], back[place + 1] = there[place + 1], there[place]
        for place in (27, 28, 29):
            back[place], back[place + 3] = there[place + 3], there[place]
        back[23], back[24] = -there[24], -there[23]
    return result


@kernel
def _bounds(out: Float64, one: Any, other: Any, floor_m: float) -> None:
    """Features 0 to 5 and 20 to 35: sizes, gaps and heights of the bounds, and their distance."""
    overlap_x = min(one.high[0], other.high[0]) - max(one.low[0], other.low[0])
    overlap_y = min(one.high[1], other.high[1]) - max(one.low[1], other.low[1])
    gap_x, gap_y = max(0.0, -overlap_x), max(0.0, -overlap_y)
    out[0] = math.sqrt(gap_x * gap_x + gap_y * gap_y)
    out[1], out[2] = min(overlap_x, overlap_y), max(overlap_x, overlap_y)
    out[3] = min(one.high[2], other.high[2]) - max(one.low[2], other.low[2])
    shared = max(0.0, overlap_x) * max(0.0, overlap_y)
    for place in range(2):
        shape = one if place == 0 else other
        x, y = shape.high[0] - shape.low[0], shape.high[1] - shape.low[1]
        out[4 + place] = min(1.0, shared / (max(0.01, x) * max(0.01, y)))
    out[21] = one.low[2] - other.low[2]
    out[22] = one.high[2] - other.high[2]
    out[23] = one.low[2] - other.high[2]
    out[24] = one.high[2] - other.low[2]
    out[25] = one.low[2] - floor_m
    out[26] = other.low[2] - floor_m
    for shape, place in ((one, 27), (other, 30)):
        x, y = shape.high[0] - shape.low[0], shape.high[1] - shape.low[1]
        out[place] = math.log(max(0.01, max(x, y)))
        out[place + 1] = math.log(max(0.01, min(x, y)))
        out[place + 2] = math.log(max(0.01, shape.high[2] - shape.low[2]))
    out[33] = out[27] - out[30]
    out[34] = math.log(float(one.count))
    out[35] = math.log(float(other.count))
    # The distance of the means in standard deviations of both objects.
    offset = one.mean - other.mean
    s = one.covariance + other.covariance
    for axis in range(3):
        s[axis, axis] += 1e-4
    # Cholesky factor of the symmetric matrix, and forward substitution.
    l00 = math.sqrt(s[0, 0])
    l10, l20 = s[1, 0] / l00, s[2, 0] / l00
    l11 = math.sqrt(max(1e-12, s[1, 1] - l10 * l10))
    l21 = (s[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(max(1e-12, s[2, 2] - l20 * l20 - l21 * l21))
    x = offset[0] / l00
    y = (offset[1] - l10 * x) / l11
    z = (offset[2] - l20 * x - l21 * y) / l22
    out[20] = math.sqrt(x * x + y * y + z * z)


@kernel
def _contact(out: Float64, one: Any, other: Any, points: Float32) -> None:
    """Features 6 to 14: the surface of the other one, its points, around the bottom of one."""
    left, back, bottom = one.low[0], one.low[1], one.low[2]
    around, layer, higher, lower, level = 0, 0, 0, 0, 0
    soft, soft_step = 0.0, 0.0
    top = -1e9
    total, squares = 0.0, 0.0
    cells = np.zeros((8, 8), np.bool_)
    width_x = one.high[0] - left + 2 * MARGIN_M
    width_y = one.high[1] - back + 2 * MARGIN_M
    for k in range(len(points)):
        x = points[k, 0] - left + MARGIN_M
        y = points[k, 1] - back + MARGIN_M
        step = bottom - points[k, 2]
        level += int(abs(step) < LAYER_M)
        if -0.05 < step < 0.3:
            off_x = max(0.0, -x, x - width_x)
            off_y = max(0.0, -y, y - width_y)
            radii = (off_x * off_x + off_y * off_y) / SOFT_RADIUS_M**2
            if radii < 9.0:  # beyond, the weight is below 1e-3
                weight = math.exp(-radii)
                soft += weight
                soft_step += weight * step
        if x < 0.0 or y < 0.0 or x > width_x or y > width_y:
            continue
        around += 1
        z = np.float64(points[k, 2])
        if z < bottom + 0.025:
            top = max(top, z)
        if abs(z - bottom) < LAYER_M:
            layer += 1
            total += z
            squares += z * z
            cells[min(7, int(8 * x / width_x)), min(7, int(8 * y / width_y))] = True
        elif z > bottom:
            higher += 1
        else:
            lower += 1
    out[6] = min(1.0, bottom - top) if top > -1e8 else 1.0
    # Cells of the footprint that the layer covers. A surface with few points cannot cover all.
    area = max(0.01, other.high[0] - other.low[0]) * max(0.01, other.high[1] - other.low[1])
    cell_limit = min(64.0, max(8.0, len(points) * width_x * width_y / area))
    out[7] = min(1.0, cells.sum() / cell_limit)
    out[8] = np.log(1.0 + layer)
    out[9] = higher / max(1, around)
    out[10] = lower / max(1, around)
    out[12] = soft_step / soft if soft > 1e-3 else 0.3
    out[13] = np.log(1.0 + soft)
    out[14] = level / max(1, len(points))
    if layer > 1:
        out[11] = np.sqrt(max(0.0, squares / layer - (total / layer) ** 2))


@kernel
def _enclosure(one: Any, points: Float32) -> float:
    """Fraction of eight directions around the centre of one in which points are beside it."""
    x = (one.low[0] + one.high[0]) / 2
    y = (one.low[1] + one.high[1]) / 2
    reach = REACH_M / 2 + max(one.high[0] - one.low[0], one.high[1] - one.low[1]) / 2
    bottom, top = one.low[2] + 0.02, one.high[2] + 0.1
    found = 0
    for k in range(len(points)):
        if points[k, 2] < bottom or points[k, 2] > top:
            continue
        step_x, step_y = points[k, 0] - x, points[k, 1] - y
        if step_x * step_x + step_y * step_y < reach * reach:
            half = int(step_y >= 0.0)
            quarter = int(step_x >= 0.0)
            steep = int(abs(step_y) >= abs(step_x))
            found |= 1 << (4 * half + 2 * quarter + steep)
    sectors = 0
    while found:
        found &= found - 1
        sectors += 1
    return sectors / 8


@kernel
def _distance(one: Any, other: Any, of_one: Float32, of_other: Float32) -> float:
    """Smallest distance of two points that are near the other's bounds; at most 1 m.

    Only the first NEAR_POINTS points near the other object are compared.
    """
    best = 1.0
    near_one = _near(of_one, other, NEAR_BOUNDS_M, NEAR_POINTS)
    near_other = _near(of_other, one, NEAR_BOUNDS_M, NEAR_POINTS)
    for i in near_one:
        for j in near_other:
            squared = 0.0
            for axis in range(3):
                step = np.float64(of_one[i, axis]) - np.float64(of_other[j, axis])
                squared += step * step
            best = min(best, squared)
    return math.sqrt(best)


@kernel
def _near(points: Float32, shape: Any, margin_m: float, most: int) -> Int64:
    """Indices of the first points that are in the bounds of a shape, or a margin outside."""
    found = np.empty(most, np.int64)
    count = 0
    for k in range(len(points)):
        within = True
        for axis in range(3):
            value = points[k, axis]
            within &= shape.low[axis] - margin_m < value < shape.high[axis] + margin_m
        if within and count < most:
            found[count] = k
            count += 1
    return found[:count]


def plan_gaps(one: NDArray[np.void], other: NDArray[np.void]) -> Float64:
    """Horizontal gaps (m,) of the outlines of two shapes each, (m,) of `SHAPE`.

    An outline has eight sides: bounds along x and y, and along the diagonals. Each two of them
    are a rectangle around the object, and the larger gap of the rectangles counts. Negative: how
    deep the outlines are in each other. The gap of things that stand askew is too small by the axes
    alone: the median error of pieces of furniture that are 12 to 30 cm apart is 8 cm, and 4 with
    the diagonals.
    """
    apart = [
        np.maximum(one[low] - other[high], other[low] - one[high])[:, :2]
        for low, high in (("low", "high"), ("slant_low", "slant_high"))
    ]
    straight, slant = (np.sqrt((np.maximum(gap, 0.0) ** 2).sum(axis=1)) for gap in apart)
    depths = np.minimum(np.maximum(*apart).max(axis=1), 0.0)
    larger: Float64 = np.maximum(straight, slant) + depths
    return larger


def centre_steps(shapes: NDArray[np.void], first: Int64, second: Int64) -> Float64:
    """Horizontal distances (m,) of the centres of the bounds of pairs of places (m,)."""
    centres = (shapes["low"] + shapes["high"]) / 2.0
    steps = centres[first] - centres[second]
    distances: Float64 = np.sqrt(steps[:, 0] * steps[:, 0] + steps[:, 1] * steps[:, 1])
    return distances
