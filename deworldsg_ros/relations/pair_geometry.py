"""The fused geometry of two nodes: shapes of nodes, and features of ordered pairs.

All lengths are metres in an upright frame: axes 0 and 1 are horizontal, axis 2 is up.
"""

from __future__ import annotations

import math

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float32, Float64, Int64
from deworldsg_ros.scene.columns import Columns

# Points of a node that its shape uses, which is all that a node keeps. With half of them, tables
# have no point near the small objects on them.
SHAPE_POINTS = 512
# A node with fewer points has no reliable bounds; its relations are not judged.
MIN_SHAPE_POINTS = 8
# Bounds leave out this fraction of the points at either end: masks bleed, and edges fly.
TRIM_FRACTION = 0.02
# An object rests on a surface within this horizontal distance of its own bounds.
MARGIN_M = 0.06
# Half the height of the layer in which a bottom touches a surface.
LAYER_M = 0.035
# Points of a surface count for its height beside an object by exp(-(distance / this)²).
SOFT_RADIUS_M = 0.15
# Pairs of objects that are farther apart are not related: horizontally, vertically, and
# vertically for objects that are not over one another.
REACH_M = 0.6
OVER_REACH_M = 1.3
BESIDE_REACH_M = 0.15
# Directions around an object in which a container's wall may be.
SECTORS = 8

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
        revisions: (n,) int64, node revision of the shape.
        low, high: (n, 3) trimmed bounds.
        means: (n, 3), and
        covariances: (n, 3, 3) of the points.
        counts: (n,) int64, number of points used.
        points: (n, SHAPE_POINTS, 3) float32.
    """

    revisions: Int64
    low: Float64
    high: Float64
    means: Float64
    covariances: Float64
    counts: Int64
    points: Float32

    def __init__(self) -> None:
        super().__init__(
            {
                "revisions": (np.int64, ()),
                "low": (np.float64, (3,)),
                "high": (np.float64, (3,)),
                "means": (np.float64, (3,)),
                "covariances": (np.float64, (3, 3)),
                "counts": (np.int64, ()),
                "points": (np.float32, (SHAPE_POINTS, 3)),
            }
        )

    def put(self, row: int, points_world: Float32, R_up_world: Float64) -> None:
        """Replace the shape of a row.

        Args:
            row: of the node.
            points_world: (k, 3) sample of its surface, world frame.
            R_up_world: (3, 3) rotation from the world frame to the upright frame.
        """
        used = points_world[:SHAPE_POINTS]
        count = self.counts[row] = len(used)
        if not count:
            return
        upright = used @ R_up_world.T.astype(np.float32)
        self.points[row, :count] = upright
        ordered = np.sort(upright.astype(np.float64), axis=0)
        cut = round(TRIM_FRACTION * (count - 1))
        low, high = ordered[cut], ordered[count - 1 - cut]
        # Give back what the quantiles cut off an evenly covered surface. Not in height: most
        # visible points of a table are at one height.
        trimmed = (high - low)[:2] * TRIM_FRACTION / (1.0 - 2.0 * TRIM_FRACTION)
        low[:2] -= trimmed
        high[:2] += trimmed
        self.low[row], self.high[row] = low, high
        self.means[row] = ordered.mean(axis=0)
        offsets = upright.astype(np.float64) - self.means[row]
        self.covariances[row] = offsets.T @ offsets / count


def warm_up() -> None:
    """Compile the kernels, or load them from the cache."""
    shapes = NodeShapes()
    points = np.indices((2, 2, 2)).reshape(3, -1).T.astype(np.float32)
    for node_id in (1, 2):
        shapes.put(shapes.append(node_id), points, np.eye(3))
    pairs = pairs_in_reach(np.arange(2), shapes.low, shapes.high, shapes.counts)
    columns = (shapes.low, shapes.high, shapes.means, shapes.covariances, shapes.counts)
    first, second = np.ascontiguousarray(pairs.T)
    pair_features(first, second, *columns, shapes.points, 0.0)


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
def pairs_in_reach(changed: Int64, low: Float64, high: Float64, counts: Int64) -> Int64:
    """Unordered pairs of rows (m, 2) in reach, with at least one of the changed rows.

    Args:
        changed: (k,) rows.
        low: (n, 3) bounds, and
        high: (n, 3).
        counts: (n,) numbers of points.
    """
    is_changed = np.zeros(len(low), np.bool_)
    is_changed[changed] = True
    found = np.empty((len(changed) * len(low), 2), np.int64)
    count = 0
    for a in changed:
        if counts[a] < MIN_SHAPE_POINTS:
            continue
        for b in range(len(low)):
            if b == a or counts[b] < MIN_SHAPE_POINTS or (is_changed[b] and b < a):
                continue
            x = max(low[a, 0], low[b, 0]) - min(high[a, 0], high[b, 0])
            y = max(low[a, 1], low[b, 1]) - min(high[a, 1], high[b, 1])
            z = max(low[a, 2], low[b, 2]) - min(high[a, 2], high[b, 2])
            if x > REACH_M or y > REACH_M or z > OVER_REACH_M:
                continue
            if z > BESIDE_REACH_M and (x > BESIDE_REACH_M or y > BESIDE_REACH_M):
                continue
            found[count, 0], found[count, 1] = a, b
            count += 1
    return found[:count]


@kernel
def pair_features(  # noqa: D417
    subjects: Int64,
    objects: Int64,
    low: Float64,
    high: Float64,
    means: Float64,
    covariances: Float64,
    counts: Int64,
    points: Float32,
    floor_m: float,
) -> Float64:
    """Features (m, len(FEATURES)) of ordered pairs of rows of `NodeShapes`.

    Args:
        subjects: (m,) rows, and
        objects: (m,) rows of the pairs.
        low, high, means, covariances, counts, points: the columns of `NodeShapes`.
        floor_m: height of the floor.
    """
    result = np.zeros((len(subjects), len(FEATURES)))
    for pair in range(len(subjects)):
        a, b = subjects[pair], objects[pair]
        out = result[pair]
        overlap = np.minimum(high[a], high[b]) - np.maximum(low[a], low[b])
        size_a, size_b = high[a] - low[a], high[b] - low[b]
        gap_x, gap_y = max(0.0, -overlap[0]), max(0.0, -overlap[1])
        out[0] = np.sqrt(gap_x * gap_x + gap_y * gap_y)
        out[1] = min(overlap[0], overlap[1])
        out[2] = max(overlap[0], overlap[1])
        out[3] = overlap[2]
        shared = max(0.0, overlap[0]) * max(0.0, overlap[1])
        out[4] = min(1.0, shared / (max(size_a[0], 0.01) * max(size_a[1], 0.01)))
        out[5] = min(1.0, shared / (max(size_b[0], 0.01) * max(size_b[1], 0.01)))
        _contact(out, a, b, low, high, counts, points)
        out[15] = _enclosure(a, b, low, high, means, counts, points)
        out[16] = _enclosure(b, a, low, high, means, counts, points)
        out[17] = _inside(a, b, low, high, counts, points)
        out[18] = _inside(b, a, low, high, counts, points)
        out[19] = _distance(a, b, low, high, counts, points)
        offset = means[a] - means[b]
        spread = covariances[a] + covariances[b] + 1e-4 * np.eye(3)
        out[20] = np.sqrt(max(0.0, offset @ np.linalg.solve(spread, offset)))
        out[21] = low[a, 2] - low[b, 2]
        out[22] = high[a, 2] - high[b, 2]
        out[23] = low[a, 2] - high[b, 2]
        out[24] = high[a, 2] - low[b, 2]
        out[25] = low[a, 2] - floor_m
        out[26] = low[b, 2] - floor_m
        for size, first in ((size_a, 27), (size_b, 30)):
            out[first] = np.log(max(0.01, max(size[0], size[1])))
            out[first + 1] = np.log(max(0.01, min(size[0], size[1])))
            out[first + 2] = np.log(max(0.01, size[2]))
        out[33] = out[27] - out[30]
        out[34] = np.log(float(counts[a]))
        out[35] = np.log(float(counts[b]))
    return result


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
    a: int, b: int, low: Float64, high: Float64, means: Float64, counts: Int64, points: Float32
) -> float:
    """Fraction of the directions around the centre of a in which b has points beside a."""
    x = (low[a, 0] + high[a, 0]) / 2
    y = (low[a, 1] + high[a, 1]) / 2
    reach = REACH_M / 2 + max(high[a, 0] - low[a, 0], high[a, 1] - low[a, 1]) / 2
    found = np.zeros(SECTORS, np.bool_)
    for k in range(counts[b]):
        if points[b, k, 2] < low[a, 2] + 0.02 or points[b, k, 2] > high[a, 2] + 0.1:
            continue
        step_x, step_y = points[b, k, 0] - x, points[b, k, 1] - y
        if step_x * step_x + step_y * step_y < reach * reach:
            angle = np.arctan2(step_y, step_x) / (2 * np.pi)
            found[min(SECTORS - 1, int(SECTORS * (angle + 0.5)))] = True
    return float(found.sum()) / SECTORS


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
