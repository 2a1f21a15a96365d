"""Depth refinement in the depth-distribution domain (Eq. 2), exact and in linear time.

The equation is defined on sorted depths. Sorting is expensive, and almost never necessary:

1. Depths are counted in buckets that are narrower than half of the smallest possible threshold. A
   larger step leaves an empty bucket.
2. Runs of non-empty buckets are the *blocks*. Clusters are cut between blocks only. The lowest and
   highest depth of each block give the exact step. Depths with very many blocks are sorted.
3. d_ref is found in the bucket that contains it.
4. median(Δz) needs the sorted depths, but only if it can matter. At least half of the N - 1 steps
   are as large as their median, and all steps sum to the range: median(Δz) <= 2 range / (N - 1).

All arithmetic is float64 on float32 depths, as in the definition. Means come from integer sums, so
they do not depend on the order of the pixels. The loops over all pixels have no branches and no
dependent steps where possible, so that the compiler makes vector instructions of them.
"""

from __future__ import annotations

import math

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float32, Float64, Int64, UInt16

# With more buckets, sorting is faster; and the index of a bucket is 16 bits long.
MAX_BUCKETS = (1 << 16) - 2
MIN_BUCKETS = 64
# Each gap between blocks is a pass over all depths; from about this number on, sorting is faster.
MAX_GAPS = 32
# Neighbouring pixels often fall into one bucket. So that their counts do not wait for one another,
# they are counted in turn in this number of tables.
COUNT_TABLES = 4
# More than the rounding of a mean, relative to the highest depth.
MEAN_ROUNDING = 1e-9
# Above the bits of all depths.
MOST_BITS = np.int32(np.iinfo(np.int32).max)


def dominant_layer(
    depths_m: Float32, gamma_base_m: float, alpha: float, beta: float
) -> tuple[float, float]:
    """Lowest and highest depth of the kept cluster, metres (Eq. 2).

    d_ref = median(Z), Δ_thr = max(γ_base, α median(Δz), β d_ref). The sorted depths are cut where a
    step exceeds Δ_thr. The cluster whose mean is nearest to d_ref is kept; of two clusters with the
    same distance, the one nearer to the camera. All depths between the two results belong to it.

    Args:
        depths_m: (N,) float32, contiguous, valid depths of one object in any order, N >= 1.
        gamma_base_m: minimum separation of clusters, metres.
        alpha: factor of the median step of the sorted depths.
        beta: factor of the reference depth.
    """
    lowest, highest = _dominant_layer(depths_m, gamma_base_m, alpha, beta)
    if lowest > highest:
        return _by_sorting(depths_m, gamma_base_m, alpha, beta)
    return lowest, highest


def _by_sorting(
    depths_m: Float32, gamma_base_m: float, alpha: float, beta: float
) -> tuple[float, float]:
    """`dominant_layer` as it is defined."""
    ordered = np.sort(depths_m.astype(np.float64))
    steps = ordered[1:] - ordered[:-1]
    reference = _middle(ordered)
    cuts = steps > max(gamma_base_m, alpha * _middle(np.sort(steps)), beta * reference)
    lows, highs = ordered[np.append(True, cuts)], ordered[np.append(cuts, True)]
    lowest, highest = _nearest_cluster(depths_m, lows, highs, reference)
    return lowest, highest


def _middle(ordered: Float64) -> float:
    """Median of sorted numbers."""
    return float((ordered[(ordered.size - 1) // 2] + ordered[ordered.size // 2]) / 2.0)


@kernel
def _extremes(depths: Float32) -> tuple[float, float]:
    """Lowest and highest depth; positive floats have the order of their bits."""
    least = greatest = np.float32(depths[0]).view(np.int32)
    for index in range(depths.size):
        bits = np.float32(depths[index]).view(np.int32)
        least = min(least, bits)
        greatest = max(greatest, bits)
    lowest, highest = np.int32(least).view(np.float32), np.int32(greatest).view(np.float32)
    return np.float64(lowest), np.float64(highest)


@kernel
def _buckets(depths: Float32, lowest: float, scale: float, count: int) -> UInt16:
    """Bucket of each depth.

    int((depth - lowest) * scale) is monotone in the depth, even with rounding. So buckets are
    ordered and never overlap.
    """
    buckets = np.empty(depths.size, np.uint16)
    last = np.int32(count - 1)
    for index in range(depths.size):
        bucket = np.int32((np.float64(depths[index]) - lowest) * scale)
        buckets[index] = min(bucket, last)
    return buckets


@kernel
def _bucket_counts(buckets: UInt16, count: int) -> Int64:
    """Number of depths in each bucket."""
    tables = np.zeros((COUNT_TABLES, count), np.int64)
    whole = buckets.size // COUNT_TABLES * COUNT_TABLES
    for index in range(0, whole, COUNT_TABLES):
        for table in range(COUNT_TABLES):
            tables[table, buckets[index + table]] += 1
    for index in range(whole, buckets.size):
        tables[0, buckets[index]] += 1
    for table in range(1, COUNT_TABLES):
        for bucket in range(count):
            tables[0, bucket] += tables[table, bucket]
    counts: Int64 = tables[0]
    return counts


@kernel
def _members(depths: Float32, buckets: UInt16, bucket: int, count: int) -> Float32:
    """The depths in a bucket, by their number."""
    members = np.empty(count + 1, np.float32)
    member, wanted = np.uint64(0), np.uint16(bucket)
    for index in range(depths.size):
        members[member] = depths[index]
        member += np.uint64(buckets[index] == wanted)
    return members[:-1]


@kernel
def _least_above(depths: Float32, buckets: UInt16, bucket: int) -> float:
    """The lowest depth in a later bucket."""
    least = MOST_BITS
    for index in range(depths.size):
        bits = np.float32(depths[index]).view(np.int32)
        least = min(least, bits if buckets[index] > bucket else MOST_BITS)
    return np.float64(np.int32(least).view(np.float32))


@kernel
def _sort(depths: Float32) -> None:
    """Sort a few depths in place."""
    for index in range(1, depths.size):
        depth, at = depths[index], index
        while at > 0 and depths[at - 1] > depth:
            depths[at] = depths[at - 1]
            at -= 1
        depths[at] = depth


@kernel
def _median(depths: Float32, buckets: UInt16, counts: Int64) -> float:
    """Median of depths, from their buckets and the counts of these."""
    rank, next_rank = (depths.size - 1) // 2, depths.size // 2
    while True:
        bucket = 0
        while rank >= counts[bucket]:
            rank -= counts[bucket]
            next_rank -= counts[bucket]
            bucket += 1
        members = _members(depths, buckets, bucket, counts[bucket])
        lowest, highest = _extremes(members)
        if next_rank == members.size:  # the upper middle is the first of a later bucket
            return (highest + _least_above(depths, buckets, bucket)) / 2.0
        if lowest == highest:
            return lowest
        depths = members
        if depths.size <= 64:
            _sort(depths)
            return (np.float64(depths[rank]) + np.float64(depths[next_rank])) / 2.0
        count = int(np.int64(256))  # the kernels would be compiled once more for a literal
        buckets = _buckets(depths, lowest, count / (highest - lowest), count)
        counts = _bucket_counts(buckets, count)


@kernel
def _gaps(counts: Int64) -> Int64:
    """Buckets that follow each run of empty buckets: each begins a block."""
    starts = np.empty(counts.size, np.int64)
    gaps = 0
    for bucket in range(1, counts.size):
        starts[gaps] = bucket
        gaps += int(counts[bucket] > 0 and counts[bucket - 1] == 0)
    return starts[:gaps]


@kernel
def _blocks(
    depths: Float32, buckets: UInt16, starts: Int64, lowest: float, highest: float
) -> tuple[Float64, Float64]:
    """Lowest and highest depth of each block; the blocks but the first begin at `starts`."""
    lows, highs = np.empty(starts.size + 1, np.float64), np.empty(starts.size + 1, np.float64)
    lows[0], highs[starts.size] = lowest, highest
    for gap in range(starts.size):
        start = np.uint16(starts[gap])
        below, above = np.int32(0), MOST_BITS
        for index in range(depths.size):
            bits, is_above = np.float32(depths[index]).view(np.int32), buckets[index] >= start
            above = min(above, bits if is_above else MOST_BITS)
            below = max(below, np.int32(0) if is_above else bits)
        lows[gap + 1] = np.float64(np.int32(above).view(np.float32))
        highs[gap] = np.float64(np.int32(below).view(np.float32))
    return lows, highs


@kernel
def _mean_between(depths: Float32, low: float, high: float, unit: float) -> float:
    """Mean of the depths in [low, high], summed as multiples of a unit of length.

    Depths that are multiples of the unit have an exact sum.
    """
    total, count, per_unit = np.int64(0), np.int64(0), 1.0 / unit
    for index in range(depths.size):
        depth = np.float64(depths[index])
        inside = (depth >= low) & (depth <= high)
        total += np.int64(depth * per_unit) if inside else np.int64(0)
        count += np.int64(inside)
    return np.float64(total) * unit / count


@kernel
def _unit(count: int, lowest: float, highest: float) -> float:
    """The last binary place of the lowest depth, a unit of all depths.

    The sum of `count` depths must fit into 62 bits, so a very large range of depths takes a coarser
    unit. With 640 x 480 depths, this begins where the highest is 2^20 times the lowest.
    """
    finest = math.floor(math.log2(lowest)) - 23
    return float(2.0 ** max(finest, math.ceil(math.log2(highest * count)) - 62))


@kernel
def _nearest_cluster(
    depths: Float32, lows: Float64, highs: Float64, reference: float
) -> tuple[float, float]:
    """The cluster whose mean is nearest to the reference; the first one of a tie.

    The reference lies in a cluster or between two, and the means are ordered. So only this cluster
    and its neighbours are candidates.
    """
    at = 0
    while at < lows.size - 1 and highs[at] < reference:
        at += 1
    first, last = max(at - 1, 0), min(at + 2, lows.size)
    # A mean lies between the lowest and the highest depth. That alone often decides.
    least_m = np.inf
    for cluster in range(first, last):
        least_m = min(least_m, max(reference - lows[cluster], highs[cluster] - reference))
    least_m += MEAN_ROUNDING * highs[-1]
    while max(lows[first] - reference, reference - highs[first]) > least_m:
        first += 1
    while max(lows[last - 1] - reference, reference - highs[last - 1]) > least_m:
        last -= 1
    if last - first == 1:
        return lows[first], highs[first]
    unit = _unit(depths.size, lows[0], highs[-1])
    best, best_distance = -1, np.inf
    for cluster in range(first, last):
        mean = _mean_between(depths, lows[cluster], highs[cluster], unit)
        distance = abs(mean - reference)
        if distance < best_distance:
            best, best_distance = cluster, distance
    return lows[best], highs[best]


@kernel
def _dominant_layer(
    depths: Float32, gamma_base: float, alpha: float, beta: float
) -> tuple[float, float]:
    """`dominant_layer`; (inf, -inf) if the depths have to be sorted."""
    lowest, highest = _extremes(depths)
    if lowest == highest:
        return lowest, highest
    spread = highest - lowest
    if 2.0 * spread / gamma_base >= MAX_BUCKETS:
        return np.inf, -np.inf
    count = max(int(2.0 * spread / gamma_base) + 2, MIN_BUCKETS)
    buckets = _buckets(depths, lowest, count / spread, count)
    counts = _bucket_counts(buckets, count)
    starts = _gaps(counts)
    if starts.size > MAX_GAPS:
        return np.inf, -np.inf
    reference = _median(depths, buckets, counts)
    lows, highs = _blocks(depths, buckets, starts, lowest, highest)

    threshold = max(gamma_base, beta * reference)
    # The bound on median(Δz), and the same bound without the steps between blocks: two distant
    # layers do not loosen the second one.
    within, steps = 0.0, depths.size - 1
    for block in range(lows.size):
        within += highs[block] - lows[block]
    step_bound = 2.0 * spread / steps
    inside = 0.5 * steps - starts.size
    if inside > 0:
        step_bound = min(step_bound, within / inside)
    if alpha * step_bound * (1.0 + 1e-9) > threshold:
        return np.inf, -np.inf

    last = 0
    for block in range(1, lows.size):
        if lows[block] - highs[block - 1] > threshold:
            last += 1
            lows[last] = lows[block]
        highs[last] = highs[block]
    if last == 0:
        return lowest, highest
    return _nearest_cluster(depths, lows[: last + 1], highs[: last + 1], reference)
