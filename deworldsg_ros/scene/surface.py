"""A bounded, deterministic sample of an object's surface points.

Of all distinct points, the sample keeps those with the smallest hash. The hash depends on the point
alone. So the sample is uniform, and it does not depend on the order of frames, on repeated points,
or on the order of merges.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt32, UInt64

# Radius in which the density of points is counted: half a cell of the surface map.
EVEN_RADIUS_M = 0.015

# The constants of SplitMix64.
_GOLDEN_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)


NO_POINTS: Float32 = np.zeros((0, 3), np.float32)


def add_points(
    hashes: UInt64,
    points_world: Float32,
    counts: Int64,
    rows: Sequence[int],
    point_sets: Sequence[Float32],
) -> None:
    """Add a set of points (k, 3) to each of n different samples.

    Args:
        hashes: (S, K) uint64, the content hashes of S samples of at most K points; they ascend
            strictly.
        points_world: (S, K, 3) float32, the points, metres.
        counts: (S,) int64, number of points of each sample.
        rows: (n,) indices of the samples.
        point_sets: n sets of points.
    """
    if not len(point_sets) or not hashes.shape[1]:
        return
    points = np.ascontiguousarray(np.concatenate(point_sets), np.float32)
    _add(
        hashes,
        points_world.view(np.uint32),
        counts,
        np.array(rows, np.int64),
        points.view(np.uint32),
        np.array([0, *accumulate(map(len, point_sets))]),
    )


@kernel
def _hash(bits: UInt32) -> np.uint64:
    """64-bit hash of a point, a function of its three float32 values alone."""
    state = np.uint64(0)
    for axis in range(3):
        # Equal values hash alike, and -0.0 is 0.0.
        value = np.uint64(0) if bits[axis] == 0x80000000 else np.uint64(bits[axis])
        state = (state ^ value) + _GOLDEN_GAMMA
        state = (state ^ (state >> np.uint64(30))) * _MIX_1
        state = (state ^ (state >> np.uint64(27))) * _MIX_2
        state ^= state >> np.uint64(31)
    return state


@kernel
def _add(
    hashes: UInt64, bits: UInt32, counts: Int64, rows: Int64, new_bits: UInt32, starts: Int64
) -> None:
    capacity = hashes.shape[1]
    all_hashes = np.empty(capacity, np.uint64)
    all_bits = np.empty((capacity, 3), np.uint32)
    entering = np.empty(len(new_bits), np.int64)
    entering_hashes = np.empty(len(new_bits), np.uint64)
    for index in range(len(rows)):
        row = rows[index]
        known = counts[row]
        # Most frames add nothing to a full sample.
        count = 0
        for place in range(starts[index], starts[index + 1]):
            entering[count] = place
            entering_hashes[count] = _hash(new_bits[place])
            count += int(known < capacity or entering_hashes[count] < hashes[row, known - 1])
        if count == 0:
            continue
        order = np.argsort(entering_hashes[:count])
        size = min(capacity, known + count)
        kept = old = new = 0
        while kept < size and (old < known or new < count):
            if new == count or (old < known and hashes[row, old] <= entering_hashes[order[new]]):
                all_hashes[kept] = hashes[row, old]
                for axis in range(3):
                    all_bits[kept, axis] = bits[row, old, axis]
                old += 1
            else:
                all_hashes[kept] = entering_hashes[order[new]]
                for axis in range(3):
                    all_bits[kept, axis] = new_bits[entering[order[new]], axis]
                new += 1
            # Equal hashes mean equal points: with 64 bits, collisions within a node are negligible.
            kept += int(kept == 0 or all_hashes[kept] != all_hashes[kept - 1])
        counts[row] = kept
        for place in range(kept):
            hashes[row, place] = all_hashes[place]
            for axis in range(3):
                bits[row, place, axis] = all_bits[place, axis]


@kernel
def drop_points(
    hashes: UInt64, points_world: Float32, counts: Int64, rows: Int64, dropped: Bool
) -> None:
    """Remove points of n different samples, `dropped` (n, K), but never all points of a sample.

    The other arguments are those of `add_points`.
    """
    for index in range(len(rows)):
        row = rows[index]
        if dropped[index, : counts[row]].all():
            continue
        kept = 0
        for place in range(counts[row]):
            hashes[row, kept] = hashes[row, place]
            for axis in range(3):
                points_world[row, kept, axis] = points_world[row, place, axis]
            kept += int(not dropped[index, place])
        counts[row] = kept


def even_moments(points_world: Float32) -> tuple[Float64, Float64]:
    """Mean (3,) and covariance (3, 3) of a surface with uneven point density.

    Points (n, 3), n >= 1, are dense on parts that were seen longer or from nearby. The weight of a
    point is the inverse square root of the number of points within `EVEN_RADIUS_M`. The inverse
    itself would give a stray point the weight of a whole patch. The covariance of a ball of that
    radius is added.
    """
    points = points_world.astype(np.float64)
    weights = _neighbours(np.ascontiguousarray(points_world), EVEN_RADIUS_M) ** -0.5
    weights /= weights.sum()
    mean = weights @ points
    offsets = points - mean
    covariance = (weights[:, None] * offsets).T @ offsets + EVEN_RADIUS_M**2 / 5 * np.eye(3)
    return mean, (covariance + covariance.T) / 2


def _neighbours(points: Float32, radius: float) -> Float64:
    """Number of points within a radius of each point, itself included."""
    columns = np.ascontiguousarray(points.T, np.float64)
    widest = int(np.argmax(columns.max(axis=1) - columns.min(axis=1)))
    # Points in the order of one coordinate: only those that follow closely can be near.
    order = np.argsort(columns[widest])
    columns = columns[:, order]
    counts = np.empty(len(points))
    counts[order] = _count_near(columns, widest, radius)
    return counts


@kernel
def _count_near(columns: Float64, widest: int, radius: float) -> Float64:
    """Number of points within a radius; columns (3, n) ascend along axis `widest`."""
    x, y, z = columns[0], columns[1], columns[2]
    along = columns[widest]
    count = len(along)
    counts = np.ones(count)
    last = 0
    for a in range(count):
        while last < count and along[last] - along[a] <= radius:
            last += 1
        for b in range(a + 1, last):
            step_x, step_y, step_z = x[a] - x[b], y[a] - y[b], z[a] - z[b]
            near = step_x * step_x + step_y * step_y + step_z * step_z <= radius * radius
            counts[a] += near
            counts[b] += near
    return counts
