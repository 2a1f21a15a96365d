"""A bounded, deterministic sample of an object's surface points.

Of all distinct points, the sample keeps those with the smallest hash. The hash depends on the point
alone. So the sample is uniform, and it does not depend on the order of frames, on repeated points,
or on the order of merges. Points are stored in the order of their hashes; the hashes are computed
when they are needed, because they would take as much memory as the points. Beside each point, its
keyframe: the number of the pose from which it was seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float32, Int64, UInt16, UInt32, UInt64

# The constants of SplitMix64.
_GOLDEN_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
# A surface keeps the points with the smallest hashes. A point that moves gets a new hash, so up to
# TRIES variants of its last bits are tried for one that is as small as before. Otherwise the points
# of the next frame would take its place.
TRIES = 64

NO_POINTS: Float32 = np.zeros((0, 3), np.float32)
NO_KEYFRAMES: UInt16 = np.zeros(0, np.uint16)


def add_points(
    points_world: Float32,
    keyframes: UInt16,
    counts: Int64,
    rows: Int64,
    point_sets: Sequence[Float32],
    new_keyframes: UInt16,
) -> Bool:
    """Add a set of points (k, 3) to each of n different samples; returns which changed, (n,).

    Args:
        points_world: (S, K, 3) float32, metres: S samples of at most K points; the hashes of each
            ascend strictly.
        keyframes: (S, K) uint16, of each point.
        counts: (S,) int64, number of points of each sample.
        rows: (n,) indices of the samples.
        point_sets: n sets of points, which have m points together.
        new_keyframes: (m,) uint16, of each of these. A point that is known keeps its own.
    """
    if not len(point_sets) or not points_world.shape[1]:
        return np.zeros(len(point_sets), np.bool_)
    points = np.ascontiguousarray(np.concatenate(point_sets), np.float32)
    return add_flat(
        (points_world, keyframes, counts),
        rows,
        points,
        new_keyframes,
        np.array([0, *accumulate(map(len, point_sets))]),
    )


def add_flat(
    samples: tuple[Float32, UInt16, Int64],
    rows: Int64,
    points: Float32,
    new_keyframes: UInt16,
    starts: Int64,
    greatest: UInt64 | None = None,
) -> Bool:
    """As `add_points`; set k is points[starts[k] : starts[k + 1]].

    Points that have moved, and whose hashes were at most `greatest` (n,), see `greatest_hashes`,
    are changed in their last bits until it is so again: as any new points they would be rare in a
    sample of many frames, and the next frame would push them out.
    """
    points_world, keyframes, counts = samples
    bits = points_world.view(np.uint32), keyframes
    if greatest is None:
        greatest = np.full(len(rows), np.iinfo(np.uint64).max)
    new_bits = np.require(points, requirements="W").view(np.uint32)
    return _add(*bits, counts, rows, new_bits, new_keyframes, starts, greatest)


def greatest_hashes(points_world: Float32, counts: Int64, rows: Int64) -> UInt64:
    """The greatest hash (n,) of each of n samples; see `add_points`. That of an empty one is 0."""
    found = np.zeros(len(rows), np.uint64)
    for index in np.flatnonzero(counts[rows]).tolist():
        found[index] = _hash(points_world[rows[index], counts[rows[index]] - 1].view(np.uint32))
    return found


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
    bits: UInt32,
    keyframes: UInt16,
    counts: Int64,
    rows: Int64,
    new_bits: UInt32,
    new_keyframes: UInt16,
    starts: Int64,
    most: UInt64,
) -> Bool:
    capacity = bits.shape[1]
    changed = np.zeros(len(rows), np.bool_)
    # The points that may enter a sample, and their hashes.
    entering, hashes = np.empty(len(new_bits), np.int64), np.empty(len(new_bits), np.uint64)
    for index in range(len(rows)):
        row = rows[index]
        known = counts[row]
        greatest = _hash(bits[row, known - 1]) if known == capacity else np.uint64(0)
        count = 0
        for point in range(starts[index], starts[index + 1]):
            least = _hash(new_bits[point])
            if least > most[index]:
                # Its last bits change within its millimetre, so that it stays in its cell.
                best, tried = new_bits[point], new_bits[point].copy()
                tried[:] += np.uint32(TRIES)
                here, there = best.view(np.float32), tried.view(np.float32)
                steps = np.where(np.floor(here * 1e3) == np.floor(there * 1e3), 1, -1)
                tried[:] = best
                for turn in range(TRIES):
                    tried[turn % 3] += np.uint32(steps[turn % 3] & 0xFFFFFFFF)
                    found = _hash(tried)
                    if found < least:
                        least = found
                        best[:] = tried
                    if least <= most[index]:
                        break
            entering[count], hashes[count] = point, least
            count += int(known < capacity or hashes[count] < greatest)
        # Most frames add nothing to a full sample.
        if count == 0:
            continue
        # In the order of their hashes (Shell sort).
        gap = count // 2
        while gap > 0:
            for later in range(gap, count):
                one, point, place = hashes[later], entering[later], later
                while place >= gap and hashes[place - gap] > one:
                    hashes[place], entering[place] = hashes[place - gap], entering[place - gap]
                    place -= gap
                hashes[place], entering[place] = one, point
            gap //= 2
        sample = bits[row], keyframes[row]
        fresh = _enter(*sample, known, new_bits, new_keyframes, entering[:count], hashes)
        changed[index] = fresh > 0
        counts[row] = min(capacity, known + fresh)
    return changed


@kernel
def _enter(
    bits: UInt32,
    keyframes: UInt16,
    known: int,
    new_bits: UInt32,
    new_keyframes: UInt16,
    points: Int64,
    hashes: UInt64,
) -> int:
    """Insert points in the order of their hashes; the last ones fall out. Returns their number."""
    places = np.empty(len(points), np.int64)  # of the known points that they come before
    place = fresh = 0
    for new in range(len(points)):
        # First known point, from the last place on, whose hash is not less. Few are hashed.
        high, step = place, 1
        while high < known and _hash(bits[high]) < hashes[new]:
            place, high, step = high + 1, high + step, 2 * step
        high = min(high, known)
        while place < high:
            middle = (place + high) // 2
            if _hash(bits[middle]) < hashes[new]:
                place = middle + 1
            else:
                high = middle
        # Equal hashes mean equal points: with 64 bits, collisions within a node are negligible.
        if place < known and _hash(bits[place]) == hashes[new]:
            continue
        if new and hashes[new - 1] == hashes[new]:
            continue
        points[fresh], places[fresh] = points[new], place
        fresh += 1
    old, write = known - 1, known + fresh - 1
    for new in range(fresh - 1, -1, -1):
        while old >= places[new]:
            if write < len(bits):
                for axis in range(3):
                    bits[write, axis] = bits[old, axis]
                keyframes[write] = keyframes[old]
            old, write = old - 1, write - 1
        if write < len(bits):
            for axis in range(3):
                bits[write, axis] = new_bits[points[new], axis]
            keyframes[write] = new_keyframes[points[new]]
        write -= 1
    return fresh


@kernel
def drop_points(
    points_world: Float32, keyframes: UInt16, counts: Int64, rows: Int64, dropped: Bool
) -> None:
    """Remove points of n different samples, `dropped` (n, K), but never all points of a sample.

    The other arguments are those of `add_points`.
    """
    for index in range(len(rows)):
        row, kept = rows[index], 0
        for place in range(counts[row]):
            kept += int(not dropped[index, place])
        if kept == 0:
            continue
        kept = 0
        for place in range(counts[row]):
            for axis in range(3):
                points_world[row, kept, axis] = points_world[row, place, axis]
            keyframes[row, kept] = keyframes[row, place]
            kept += int(not dropped[index, place])
        counts[row] = kept
