"""The fused geometry of two nodes: shapes of nodes, and features of ordered pairs.

All lengths are metres in an upright frame: axes 0 and 1 are horizontal, axis 2 is up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import DTypeLike

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.relations.reach import REACH_M
from deworldsg_ros.scene.arrays import Columns, Float32, Float64, Int64

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
# Nodes in arrays of turned points at once, so that a whole map needs no large ones.
TURNED_AT_ONCE = 256
_NO_TURN = np.eye(3)

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


class NodeShapes(Columns):
    """Shapes of n nodes in the upright frame; see `Columns` for rows and ids.

    Attributes:
        low, high: (n, 3) trimmed bounds.
        means: (n, 3), and
        covariances: (n, 3, 3) of the points.
        counts: (n,) int64, number of points used.
    """

    low: Float64
    high: Float64
    means: Float64
    covariances: Float64
    counts: Int64

    def __init__(self, more: Mapping[str, tuple[DTypeLike, tuple[int, ...]]] | None = None) -> None:
        super().__init__(
            {
                "low": (np.float64, (3,)),
                "high": (np.float64, (3,)),
                "means": (np.float64, (3,)),
                "covariances": (np.float64, (3, 3)),
                "counts": (np.int64, ()),
                **(more or {}),
            }
        )

    def put(
        self,
        rows: Int64,
        points_world: Float32,
        counts: Int64,
        point_rows: Int64,
        R_up_world: Float64,
    ) -> None:
        """Replace the shapes of rows.

        Args:
            rows: (k,) of the nodes.
            points_world: (S, K, 3) samples of surfaces, world frame.
            counts: (S,) numbers of their points.
            point_rows: (k,) which sample each node has.
            R_up_world: (3, 3) rotation from the world frame to the upright frame.
        """
        self.counts[rows] = np.minimum(counts[point_rows], SHAPE_POINTS)
        shapes = (self.low, self.high, self.means, self.covariances, self.counts)
        if is_upright(R_up_world):
            _measure(rows, points_world, point_rows, *shapes)
            return
        for start in range(0, len(rows), TURNED_AT_ONCE):
            part = slice(start, start + TURNED_AT_ONCE)
            turned = upright(points_world[point_rows[part]], R_up_world)
            _measure(rows[part], turned, np.arange(len(turned)), *shapes)


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
def _measure(
    rows: Int64,
    points: Float32,
    point_rows: Int64,
    low: Float64,
    high: Float64,
    means: Float64,
    covariances: Float64,
    counts: Int64,
) -> None:
    """The shape of each of some rows, from the first of its points in (S, K, 3)."""
    for index in range(len(rows)):
        cloud = points[point_rows[index]]
        _measure_row(rows[index], cloud, low, high, means, covariances, counts)


@kernel
def _measure_row(
    row: int,
    points: Float32,
    low: Float64,
    high: Float64,
    means: Float64,
    covariances: Float64,
    counts: Int64,
) -> None:
    """Bounds without outer points, mean and covariance of the first of points (K, 3)."""
    if not counts[row]:
        return
    cloud = points[: counts[row]]
    cut = int(np.rint(TRIM_FRACTION * (counts[row] - 1)))
    for axis in range(3):
        least, greatest, total = _ends(cloud[:, axis], cut)
        # Give back what the quantiles cut off an evenly covered surface. Not in height: most
        # visible points of a table are at one height.
        given = 0.0
        if axis < 2:
            given = (greatest - least) * TRIM_FRACTION / (1.0 - 2.0 * TRIM_FRACTION)
        low[row, axis], high[row, axis] = least - given, greatest + given
        means[row, axis] = total / len(cloud)
    for i in range(3):
        for j in range(i, 3):
            total = 0.0
            for k in range(len(cloud)):
                total += (cloud[k, i] - means[row, i]) * (cloud[k, j] - means[row, j])
            covariances[row, i, j] = covariances[row, j, i] = total / len(cloud)


@kernel
def _ends(values: Float32, cut: int) -> tuple[float, float, float]:
    """The values (k,) that `cut` others are below, and above; and the sum of all."""
    least = np.full(cut + 1, np.inf)
    greatest = np.full(cut + 1, -np.inf)
    total = 0.0
    for k in range(len(values)):
        value = np.float64(values[k])
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


@kernel
def pair_features(  # noqa: D417
    first: Int64,
    second: Int64,
    low: Float64,
    high: Float64,
    means: Float64,
    covariances: Float64,
    counts: Int64,
    points: Float32,
    floor_m: float,
) -> Float64:
    """Features (2, m, len(FEATURES)) of pairs of rows: first to second, and second to first.

    Args:
        first: (m,) rows, and
        second: (m,) rows of the pairs.
        low, high, means, covariances, counts: columns of `NodeShapes`.
        points: (n, K, 3) points of the rows in the upright frame; the first `counts` are used.
        floor_m: height of the floor.
    """
    result = np.zeros((2, len(first), len(FEATURES)))
    for pair in range(len(first)):
        a, b = first[pair], second[pair]
        there, back = result[0, pair], result[1, pair]
        _bounds(there, a, b, low, high, counts, floor_m)
        _contact(there, a, b, low, high, counts, points)
        _contact(back, b, a, low, high, counts, points)
        there[15] = _enclosure(a, b, low, high, counts, points)
        there[16] = _enclosure(b, a, low, high, counts, points)
        there[17] = _inside(a, b, low, high, counts, points)
        there[18] = _inside(b, a, low, high, counts, points)
        there[19] = _distance(a, b, low, high, counts, points)
        there[20] = _mahalanobis(a, b, means, covariances)
        _reverse(there, back)
    return result


@kernel
def centre_steps(first: Int64, second: Int64, low: Float64, high: Float64) -> Float64:
    """Horizontal distances (m,) of the centres of the bounds of pairs of rows, (m,) each."""
    steps = np.empty(len(first), np.float64)
    for pair in range(len(first)):
        a, b = first[pair], second[pair]
        x = (low[a, 0] + high[a, 0]) / 2.0 - (low[b, 0] + high[b, 0]) / 2.0
        y = (low[a, 1] + high[a, 1]) / 2.0 - (low[b, 1] + high[b, 1]) / 2.0
        steps[pair] = math.sqrt(x * x + y * y)
    return steps


@kernel
def _bounds(
    out: Float64, a: int, b: int, low: Float64, high: Float64, counts: Int64, floor_m: float
) -> None:
    """Features 0 to 5 and 21 to 35: sizes, gaps and heights of the bounds."""
    overlap_x = min(high[a, 0], high[b, 0]) - max(low[a, 0], low[b, 0])
    overlap_y = min(high[a, 1], high[b, 1]) - max(low[a, 1], low[b, 1])
    gap_x, gap_y = max(0.0, -overlap_x), max(0.0, -overlap_y)
    out[0] = math.sqrt(gap_x * gap_x + gap_y * gap_y)
    out[1], out[2] = min(overlap_x, overlap_y), max(overlap_x, overlap_y)
    out[3] = min(high[a, 2], high[b, 2]) - max(low[a, 2], low[b, 2])
    shared = max(0.0, overlap_x) * max(0.0, overlap_y)
    out[4] = min(1.0, shared / _area(a, low, high))
    out[5] = min(1.0, shared / _area(b, low, high))
    out[21] = low[a, 2] - low[b, 2]
    out[22] = high[a, 2] - high[b, 2]
    out[23] = low[a, 2] - high[b, 2]
    out[24] = high[a, 2] - low[b, 2]
    out[25] = low[a, 2] - floor_m
    out[26] = low[b, 2] - floor_m
    for row, place in ((a, 27), (b, 30)):
        x, y = high[row, 0] - low[row, 0], high[row, 1] - low[row, 1]
        out[place] = math.log(max(0.01, max(x, y)))
        out[place + 1] = math.log(max(0.01, min(x, y)))
        out[place + 2] = math.log(max(0.01, high[row, 2] - low[row, 2]))
    out[33] = out[27] - out[30]
    out[34] = math.log(float(counts[a]))
    out[35] = math.log(float(counts[b]))


@kernel
def _reverse(there: Float64, back: Float64) -> None:
    """Fill the features of the opposite direction, except `_contact`'s."""
    for place in (0, 1, 2, 3, 19, 20):
        back[place] = there[place]
    for place in (21, 22, 33):
        back[place] = -there[place]
    for one, other in (
        (4, 5),
        (15, 16),
        (17, 18),
        (25, 26),
        (34, 35),
        (27, 30),
        (28, 31),
        (29, 32),
    ):
        back[one], back[other] = there[other], there[one]
    back[23], back[24] = -there[24], -there[23]


@kernel
def _mahalanobis(a: int, b: int, means: Float64, covariances: Float64) -> float:
    """Distance of the means in standard deviations of both objects."""
    offset = means[a] - means[b]
    s = covariances[a] + covariances[b]
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
    return math.sqrt(x * x + y * y + z * z)


@kernel
def _contact(
    out: Float64, a: int, b: int, low: Float64, high: Float64, counts: Int64, points: Float32
) -> None:
    """Features 6 to 14: the surface of b around the bottom of a."""
    bottom = low[a, 2]
    around, layer, higher, lower, level = 0, 0, 0, 0, 0
    soft, soft_step = 0.0, 0.0
    top = -1e9
    total, squares = 0.0, 0.0
    cells = np.zeros((8, 8), np.bool_)
    width_x = high[a, 0] - low[a, 0] + 2 * MARGIN_M
    width_y = high[a, 1] - low[a, 1] + 2 * MARGIN_M
    for k in range(counts[b]):
        x = points[b, k, 0] - low[a, 0] + MARGIN_M
        y = points[b, k, 1] - low[a, 1] + MARGIN_M
        step = bottom - points[b, k, 2]
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
        z = np.float64(points[b, k, 2])
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
    cell_limit = min(64.0, max(8.0, counts[b] * width_x * width_y / _area(b, low, high)))
    out[7] = min(1.0, cells.sum() / cell_limit)
    out[8] = np.log(1.0 + layer)
    out[9] = higher / max(1, around)
    out[10] = lower / max(1, around)
    out[12] = soft_step / soft if soft > 1e-3 else 0.3
    out[13] = np.log(1.0 + soft)
    out[14] = level / max(1, counts[b])
    if layer > 1:
        out[11] = np.sqrt(max(0.0, squares / layer - (total / layer) ** 2))


@kernel
def _area(row: int, low: Float64, high: Float64) -> float:
    return float(max(0.01, high[row, 0] - low[row, 0]) * max(0.01, high[row, 1] - low[row, 1]))


@kernel
def _enclosure(
    a: int, b: int, low: Float64, high: Float64, counts: Int64, points: Float32
) -> float:
    """Fraction of eight directions around the centre of a in which b has points beside a."""
    x = (low[a, 0] + high[a, 0]) / 2
    y = (low[a, 1] + high[a, 1]) / 2
    reach = REACH_M / 2 + max(high[a, 0] - low[a, 0], high[a, 1] - low[a, 1]) / 2
    bottom, top = low[a, 2] + 0.02, high[a, 2] + 0.1
    found = 0
    for k in range(counts[b]):
        if points[b, k, 2] < bottom or points[b, k, 2] > top:
            continue
        step_x, step_y = points[b, k, 0] - x, points[b, k, 1] - y
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
def _within(point: Float32, low: Float64, high: Float64, margin_m: float) -> bool:
    """Whether a point is inside bounds, or at most a margin outside."""
    within = True
    for axis in range(3):
        within &= low[axis] - margin_m < point[axis] < high[axis] + margin_m
    return within


@kernel
def _inside(a: int, b: int, low: Float64, high: Float64, counts: Int64, points: Float32) -> float:
    """Fraction of the points of a inside the bounds of b."""
    inside = 0
    for k in range(counts[a]):
        inside += int(_within(points[a, k], low[b], high[b], 0.01))
    fraction: float = inside / max(1, counts[a])
    return fraction


@kernel
def _distance(a: int, b: int, low: Float64, high: Float64, counts: Int64, points: Float32) -> float:
    """Smallest distance of two points that are near the other's bounds; at most 1 m.

    Only the first points near the other object are compared.
    """
    best = 1.0
    near_a = _near(a, b, low, high, counts, points)
    near_b = _near(b, a, low, high, counts, points)
    for i in near_a:
        for j in near_b:
            squared = 0.0
            for axis in range(3):
                step = np.float64(points[a, i, axis]) - np.float64(points[b, j, axis])
                squared += step * step
            best = min(best, squared)
    return math.sqrt(best)


@kernel
def _near(a: int, b: int, low: Float64, high: Float64, counts: Int64, points: Float32) -> Int64:
    """Indices of the first 48 points of a that are within 0.15 m of the bounds of b."""
    found = np.empty(48, np.int64)
    count = 0
    for k in range(counts[a]):
        if _within(points[a, k], low[b], high[b], 0.15):
            found[count] = k
            count += 1
            if count == len(found):
                break
    return found[:count]
