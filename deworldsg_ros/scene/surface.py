"""A bounded, deterministic sample of an object's surface points.

Of all distinct points ever seen, the sample keeps those with the smallest content hash. The hash
depends on the point alone, so the sample does not depend on the order of the frames, on how often
a point was seen, or on which nodes were merged on the way; and it is a uniform draw.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
UInt64 = NDArray[np.uint64]

# The constants of SplitMix64.
_GOLDEN_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)


class SurfaceSample(NamedTuple):
    """Points of a surface, by ascending hash.

    Attributes:
        hashes: (k,) uint64, strictly ascending.
        points_world: (k, 3) float32, metres.
    """

    hashes: UInt64
    points_world: Float32


EMPTY_SAMPLE = SurfaceSample(np.zeros(0, np.uint64), np.zeros((0, 3), np.float32))


def content_hashes(points: Float32) -> UInt64:
    """64-bit hash (n,) of each point (n, 3), a function of its float32 values alone."""
    # Adding zero turns -0.0 into 0.0: equal values hash alike.
    bits = (np.ascontiguousarray(points, np.float32) + np.float32(0)).view(np.uint32)
    state = np.zeros(len(bits), np.uint64)
    for axis in range(3):
        state = (state ^ bits[:, axis]) + _GOLDEN_GAMMA
        state = (state ^ (state >> np.uint64(30))) * _MIX_1
        state = (state ^ (state >> np.uint64(27))) * _MIX_2
        state ^= state >> np.uint64(31)
    return state


def sample_each(point_sets: tuple[Float32, ...], capacity: int) -> list[SurfaceSample]:
    """The sample of each set of points (k, 3), hashed in one pass."""
    if capacity == 0 or not point_sets:
        return [EMPTY_SAMPLE] * len(point_sets)
    hashes = content_hashes(np.concatenate(point_sets))
    samples = []
    start = 0
    for points in point_sets:
        stop = start + len(points)
        samples.append(_smallest(hashes[start:stop], points, capacity))
        start = stop
    return samples


def merge_samples(a: SurfaceSample, b: SurfaceSample, capacity: int) -> SurfaceSample:
    """The sample of the union: commutative, associative, idempotent."""
    if len(a.hashes) < len(b.hashes):
        a, b = b, a
    if len(a.hashes) == capacity:
        # What lies beyond the largest hash kept can no longer enter: most points of most frames.
        entering = int(np.searchsorted(b.hashes, a.hashes[-1])) if capacity else 0
        if entering == 0:
            return a
        b = SurfaceSample(b.hashes[:entering], b.points_world[:entering])
    elif len(b.hashes) == 0:
        return a
    return _smallest(
        np.concatenate((a.hashes, b.hashes)),
        np.concatenate((a.points_world, b.points_world)),
        capacity,
    )


def _smallest(hashes: UInt64, points: Float32, capacity: int) -> SurfaceSample:
    # Points of equal hash are equal points: 64 bits do not collide on what a node sees.
    kept, first = np.unique(hashes, return_index=True)
    return SurfaceSample(kept[:capacity], np.asarray(points[first[:capacity]], np.float32))
