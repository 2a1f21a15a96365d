"""Depth refinement in the depth-distribution domain (Eq. 2), exact and in linear time.

The equation is defined on sorted depths. Sorting is expensive, and almost never necessary:

1. Depths are counted in buckets that are narrower than half of the smallest possible threshold. A
   larger step leaves an empty bucket.
2. Runs of non-empty buckets are the *blocks*. Clusters are cut between blocks only. The lowest and
   highest depth of each block give the exact step.
3. d_ref is found in the bucket that contains it.
4. median(Δz) needs the sorted depths, but only if it can matter. At least half of the N - 1 steps
   are as large as their median, and all steps sum to the range: median(Δz) <= 2 range / (N - 1).

All arithmetic is float64 on float32 depths, as in the definition. Sums are compensated, so the
means do not depend on the order of the pixels.
"""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float32, Float64, Int64

# With more buckets, sorting is faster.
MAX_BUCKETS = 1 << 16
MIN_BUCKETS = 64


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
    return float(lowest), float(highest)


@kernel
def _extremes(depths: Float32) -> tuple[float, float]:
    """Lowest and highest depth; positive floats have the order of their bits."""
    bits = depths.view(np.int32)
    least = greatest = bits[0]
    for index in range(bits.size):
        least = min(least, bits[index])
        greatest = max(greatest, bits[index])
    values = np.array([least, greatest]).view(np.float32)
    return np.float64(values[0]), np.float64(values[1])


@kernel
def _bucket_counts(depths: Float32, lowest: float, scale: float, buckets: int) -> Int64:
    """Number of depths in each bucket.

    int((depth - lowest) * scale) is monotone in the depth, even with rounding. So buckets are
    ordered and never overlap.
    """
    counts = np.zeros(buckets, np.int64)
    last = np.uint64(buckets - 1)
    for index in range(depths.size):
        counts[min(np.uint64((np.float64(depths[index]) - lowest) * scale), last)] += 1
    return counts


@kernel
def _median(depths: Float32, lowest: float, scale: float, counts: Int64) -> float:
    """Median of depths, from their counts in buckets."""
    rank, next_rank = (depths.size - 1) // 2, depths.size // 2
    while True:
        bucket = 0
        while rank >= counts[bucket]:
            rank -= counts[bucket]
            next_rank -= counts[bucket]
            bucket += 1
        median_bucket, last = np.uint64(bucket), np.uint64(counts.size - 1)
        members = np.empty(counts[bucket] + 1, np.float32)
        member = np.uint64(0)
        above = np.float32(np.inf)
        for index in range(depths.size):
            depth = depths[index]
            at = min(np.uint64((np.float64(depth) - lowest) * scale), last)
            members[member] = depth
            member += np.uint64(at == median_bucket)
            if at > median_bucket:
                above = min(above, depth)
        depths = members[:-1]
        lowest, highest = _extremes(depths)
        if next_rank == depths.size:  # the upper middle is the first of a later bucket
            return (highest + np.float64(above)) / 2.0
        if lowest == highest:
            return lowest
        if depths.size <= 64:
            depths.sort()
            return (np.float64(depths[rank]) + np.float64(depths[next_rank])) / 2.0
        scale = 256 / (highest - lowest)
        counts = _bucket_counts(depths, lowest, scale, 256)


@kernel
def _blocks(depths: Float32, lowest: float, scale: float, counts: Int64) -> tuple[Float64, Float64]:
    """Lowest and highest depth of each run of non-empty buckets."""
    block_of = np.empty(counts.size, np.uint64)
    blocks = 0
    for bucket in range(counts.size):
        if counts[bucket] > 0 and (bucket == 0 or counts[bucket - 1] == 0):
            blocks += 1
        block_of[bucket] = blocks - 1
    lows = np.full(blocks, np.inf)
    highs = np.full(blocks, -np.inf)
    last = np.uint64(counts.size - 1)
    for index in range(depths.size):
        depth = np.float64(depths[index])
        block = block_of[min(np.uint64((depth - lowest) * scale), last)]
        if depth < lows[block]:
            lows[block] = depth
        if depth > highs[block]:
            highs[block] = depth
    return lows, highs


@kernel
def _median_step(depths: Float32) -> float:
    """median(Δz) of the sorted depths."""
    ordered = np.sort(depths).astype(np.float64)
    steps = np.sort(ordered[1:] - ordered[:-1])
    middle: float = (steps[(steps.size - 1) // 2] + steps[steps.size // 2]) / 2.0
    return middle


@kernel
def _mean_between(depths: Float32, low: float, high: float) -> float:
    """Mean of the depths in [low, high].

    The sum is compensated (Knuth). It is correctly rounded for depths of 2^-14 to 2^14 m.
    """
    total, lost, count = 0.0, 0.0, 0
    for index in range(depths.size):
        depth = np.float64(depths[index])
        if low <= depth <= high:
            new = total + depth
            part = new - total
            lost += (total - (new - part)) + (depth - part)
            total = new
            count += 1
    return (total + lost) / count


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
    best, best_distance = -1, np.inf
    for cluster in range(max(at - 1, 0), min(at + 2, lows.size)):
        distance = abs(_mean_between(depths, lows[cluster], highs[cluster]) - reference)
        if distance < best_distance:
            best, best_distance = cluster, distance
    return lows[best], highs[best]


@kernel
def _dominant_layer(
    depths: Float32, gamma_base: float, alpha: float, beta: float
) -> tuple[float, float]:
    lowest, highest = _extremes(depths)
    if lowest == highest:
        return lowest, highest
    spread = highest - lowest
    steps = depths.size - 1

    if 2.0 * spread / gamma_base < MAX_BUCKETS:
        buckets = max(int(2.0 * spread / gamma_base) + 2, MIN_BUCKETS)
        scale = buckets / spread
        counts = _bucket_counts(depths, lowest, scale, buckets)
        reference = _median(depths, lowest, scale, counts)
        if counts.min() > 0:
            lows, highs = np.array([lowest]), np.array([highest])
        else:
            lows, highs = _blocks(depths, lowest, scale, counts)
    else:
        lows = np.sort(depths).astype(np.float64)
        highs = lows
        reference = (lows[steps // 2] + lows[(steps + 1) // 2]) / 2.0

    threshold = max(gamma_base, beta * reference)
    # The bound on median(Δz), and the same bound without the steps between blocks: two distant
    # layers do not loosen the second one.
    step_bound = 2.0 * spread / steps
    inside = 0.5 * steps - (lows.size - 1)
    if inside > 0:
        step_bound = min(step_bound, (highs - lows).sum() / inside)
    if alpha * step_bound * (1.0 + 1e-9) > threshold:
        threshold = max(threshold, alpha * _median_step(depths))

    cut = lows[1:] - highs[:-1] > threshold
    if not cut.any():
        return lowest, highest
    first = np.append(True, cut)
    last = np.append(cut, True)
    return _nearest_cluster(depths, lows[first], highs[last], reference)
