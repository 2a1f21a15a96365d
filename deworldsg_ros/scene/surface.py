"""A bounded, deterministic sample of an object's surface points.

Of all distinct points ever seen, the sample keeps those with the smallest content hash. The hash
depends on the point alone, so the sample does not depend on the order of the frames, on how often
a point was seen, or on which nodes were merged on the way; and it is a uniform draw.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt64 = NDArray[np.uint64]

# Within this distance points of a surface are of one part of it: half a cell of the surface map.
EVEN_RADIUS_M = 0.015

# The constants of SplitMix64.
_GOLDEN_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)


class HashedPoints(NamedTuple):
    """Surface points with their content hashes, in any order.

    Attributes:
        hashes: (k,) uint64.
        points_world: (k, 3) float32, metres.
    """

    hashes: UInt64
    points_world: Float32


# A sample is a HashedPoints whose hashes ascend strictly.
SurfaceSample = HashedPoints

EMPTY_SAMPLE = SurfaceSample(np.zeros(0, np.uint64), np.zeros((0, 3), np.float32))


def content_hashes(points: Float32) -> UInt64:
    """64-bit hash (n,) of each point (n, 3), a function of its float32 values alone."""
    # Adding zero turns -0.0 into 0.0: equal values hash alike.
    bits = (np.ascontiguousarray(points, np.float32) + np.float32(0)).view(np.uint32)
    hashes: UInt64 = _mix(bits)
    return hashes


@njit(cache=True, nogil=True)
def _mix(bits):  # type: ignore[no-untyped-def]
    hashes = np.empty(len(bits), np.uint64)
    for row in range(len(bits)):
        state = np.uint64(0)
        for axis in range(3):
            state = (state ^ np.uint64(bits[row, axis])) + _GOLDEN_GAMMA
            state = (state ^ (state >> np.uint64(30))) * _MIX_1
            state = (state ^ (state >> np.uint64(27))) * _MIX_2
            state ^= state >> np.uint64(31)
        hashes[row] = state
    return hashes


def hash_each(point_sets: tuple[Float32, ...]) -> list[HashedPoints]:
    """The hashes of each set of points (k, 3), computed in one pass."""
    if not point_sets:
        return []
    points_world = np.concatenate(point_sets)
    hashes = content_hashes(points_world)
    stops = np.cumsum([len(points) for points in point_sets]).tolist()
    return [
        HashedPoints(hashes[start:stop], points_world[start:stop])
        for start, stop in zip([0, *stops], stops)
    ]


def merge_samples(sample: SurfaceSample, points: HashedPoints, capacity: int) -> SurfaceSample:
    """The sample of the union of a sample and more points, or another sample.

    Between samples it is commutative, associative and idempotent. The points are copied: views
    would keep the arrays of whole frames alive.
    """
    if capacity == 0:
        return EMPTY_SAMPLE
    return SurfaceSample(*_union(*sample, *points, capacity))


@njit(cache=True, nogil=True)
def _union(hashes, points, new_hashes, new_points, capacity):  # type: ignore[no-untyped-def]
    full = len(hashes) >= capacity
    # Of most frames nothing enters a sample that is full.
    entering = np.empty(len(new_hashes), np.int64)
    entering_count = 0
    for row in range(len(new_hashes)):
        entering[entering_count] = row
        entering_count += int(not full or new_hashes[row] < hashes[-1])
    if entering_count == 0:
        return hashes, points
    entering = entering[:entering_count]
    order = entering[np.argsort(new_hashes[entering])]

    size = min(capacity, len(hashes) + entering_count)
    all_hashes = np.empty(size, np.uint64)
    all_points = np.empty((size, 3), np.float32)
    kept = old = new = 0
    while kept < size and (old < len(hashes) or new < entering_count):
        if new == entering_count or (old < len(hashes) and hashes[old] <= new_hashes[order[new]]):
            all_hashes[kept] = hashes[old]
            for axis in range(3):
                all_points[kept, axis] = points[old, axis]
            old += 1
        else:
            all_hashes[kept] = new_hashes[order[new]]
            for axis in range(3):
                all_points[kept, axis] = new_points[order[new], axis]
            new += 1
        # Points of equal hash are equal points: 64 bits do not collide on what a node sees.
        kept += int(kept == 0 or all_hashes[kept] != all_hashes[kept - 1])
    return all_hashes[:kept], all_points[:kept]


def even_moments(points_world: Float32) -> tuple[Float64, Float64]:
    """Mean (3,) and covariance (3, 3) of a surface that was not seen evenly.

    Points (n, 3), n >= 1, lie densely where a camera looked long or from near: each weighs with the
    inverse square root of the number within `EVEN_RADIUS_M` of it. The inverse itself would count
    every part once, a stray point as much as a patch. The covariance includes that of such a ball.
    """
    points = points_world.astype(np.float64)
    weights = _neighbours(np.ascontiguousarray(points_world), EVEN_RADIUS_M) ** -0.5
    weights /= weights.sum()
    mean = weights @ points
    offsets = points - mean
    covariance = (weights[:, None] * offsets).T @ offsets + EVEN_RADIUS_M**2 / 5 * np.eye(3)
    return mean, (covariance + covariance.T) / 2


@njit(cache=True, nogil=True)
def _neighbours(points, radius):  # type: ignore[no-untyped-def]
    """Number of points within a radius of each point, itself included."""
    counts = np.ones(len(points))
    for a in range(len(points)):
        for b in range(a + 1, len(points)):
            squared = 0.0
            for axis in range(3):
                step = np.float64(points[a, axis]) - np.float64(points[b, axis])
                squared += step * step
            if squared <= radius * radius:
                counts[a] += 1.0
                counts[b] += 1.0
    return counts


class SurfaceReservoir:
    """A surface sample that grows: at all times that of all points added, in whatever order."""

    __slots__ = ("_capacity", "sample")

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self.sample = EMPTY_SAMPLE

    def add(self, points: HashedPoints) -> None:
        """Take in points, which may be those of another sample."""
        self.sample = merge_samples(self.sample, points, self._capacity)

    @property
    def points_world(self) -> Float32:
        """(k, 3) float32, metres; in the sample's order."""
        return self.sample.points_world

    def some_points(self, count: int) -> Float32:
        """As many points (k, 3) of the surface, or all."""
        return self.sample.points_world[:count]
