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
UInt64 = NDArray[np.uint64]

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
    hashes = content_hashes(np.concatenate(point_sets))
    hashed = []
    start = 0
    for points in point_sets:
        stop = start + len(points)
        hashed.append(HashedPoints(hashes[start:stop], points))
        start = stop
    return hashed


def merge_samples(sample: SurfaceSample, points: HashedPoints, capacity: int) -> SurfaceSample:
    """The sample of the union of a sample and more points, or another sample.

    Between samples it is commutative, associative and idempotent.
    """
    if capacity == 0:
        return EMPTY_SAMPLE
    points = _entering(sample, points, capacity)
    if len(points.hashes) == 0:
        return sample
    hashes = np.concatenate((sample.hashes, points.hashes))
    points_world = np.concatenate((sample.points_world, points.points_world))
    # Stable sorting is by runs here, and the sample is one long run.
    order = np.argsort(hashes, kind="stable")
    ascending = hashes[order]
    # Points of equal hash are equal points: 64 bits do not collide on what a node sees.
    distinct = np.flatnonzero(ascending[1:] != ascending[:-1]) + 1
    kept = order[np.concatenate(([0], distinct))[:capacity]]
    return SurfaceSample(hashes[kept], points_world[kept])


def _entering(sample: SurfaceSample, points: HashedPoints, capacity: int) -> HashedPoints:
    """Copies of the points that may enter a sample: none beyond the largest hash of a full one."""
    if len(sample.hashes) < capacity:
        return HashedPoints(points.hashes.copy(), points.points_world.copy())
    entering = np.flatnonzero(points.hashes < sample.hashes[-1])
    return HashedPoints(points.hashes[entering], points.points_world[entering])


class SurfaceReservoir:
    """A surface sample that grows: points wait until there are enough of them to be merged in.

    What it shows is at all times the sample of all points added, in whatever order.
    """

    __slots__ = ("_capacity", "_sample", "_waiting", "_waiting_count")

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._sample = EMPTY_SAMPLE
        self._waiting: list[HashedPoints] = []
        self._waiting_count = 0

    def add(self, points: HashedPoints) -> None:
        """Take in points, which may be those of another sample."""
        if self._capacity == 0 or len(points.hashes) == 0:
            return
        # Copies: views would keep the arrays of whole frames alive. Of most frames nothing enters.
        points = _entering(self._sample, points, self._capacity)
        self._waiting.append(points)
        self._waiting_count += len(points.hashes)
        # What enters is merged in whole capacities: sorting takes most of the time.
        if self._waiting_count >= self._capacity:
            self._merge_in()

    @property
    def sample(self) -> SurfaceSample:
        """The sample of all points added."""
        if self._waiting:
            self._merge_in()
        return self._sample

    @property
    def points_world(self) -> Float32:
        """(k, 3) float32, metres; in the sample's order."""
        return self.sample.points_world

    def some_points(self, count: int) -> Float32:
        """As many points (k, 3) of the surface, or all; those that wait may be left out."""
        enough = len(self._sample.hashes) >= count
        return (self._sample if enough else self.sample).points_world[:count]

    def _merge_in(self) -> None:
        points = HashedPoints(
            np.concatenate([points.hashes for points in self._waiting]),
            np.concatenate([points.points_world for points in self._waiting]),
        )
        self._waiting.clear()
        self._waiting_count = 0
        self._sample = merge_samples(self._sample, points, self._capacity)
