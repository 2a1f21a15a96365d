"""Depth refinement (Eq. 1-2): which pixels of a mask are the object's surface."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from deworldsg_ros.base.kernels import kernel, read_only
from deworldsg_ros.scene.arrays import Float32, Float64, Int32, Int64, UInt8, UInt16, UInt64

# --- Pixels of an object with valid depth, as parallel arrays.


@dataclass(frozen=True)
class Pixels:
    """N pixels of one object, in row order of the image.

    Attributes:
        columns: (N,) int32, u.
        rows: (N,) int32, v.
        depths_m: (N,) float32, all valid.
    """

    columns: Int32
    rows: Int32
    depths_m: Float32

    def __len__(self) -> int:
        return len(self.depths_m)


def valid_depth(depth_m: Float32) -> Float32:
    """Depth image (H, W) float32, metres; NaN, infinity and negative values become 0.

    The result is read-only and contiguous. An image without such values is not copied.
    """
    image_m = read_only(depth_m, np.float32)
    # The bits of finite depths that are not negative are below those of infinity.
    bits, infinity = image_m.view(np.uint32), np.uint32(0x7F800000)
    if bits.max(initial=0) < infinity:
        return image_m
    return read_only((bits * (bits < infinity)).view(np.float32))


# --- Depth refinement in the spatial domain (Eq. 1).


class Masks(NamedTuple):
    """The masks of n objects as runs of pixels.

    Attributes:
        runs: (m, 4) int32, row, first column, the column after the last one, and object from 0;
            in the order of the objects, those of an object in row order of the image.
        starts: (n + 1,) int64, runs of object k are runs[starts[k] : starts[k + 1]].
        sizes: (n,) int64, pixels of each mask.
        unknown: number of pixels with an id above n.
    """

    runs: Int32
    starts: Int64
    sizes: Int64
    unknown: int

    def runs_of(self, index: int) -> Int32:
        """The runs of an object, from 0."""
        return self.runs[self.starts[index] : self.starts[index + 1]]


def masks_of(instances: UInt16, count: int) -> Masks:
    """The masks in an instance image (H, W) uint16, 0 = no object, k = k-th object of `count`."""
    # Whether a run begins at a pixel of a row, as bytes and as eight of them.
    begins = np.zeros((instances.shape[1] + 7) // 8 * 8, np.uint8)
    return Masks(*_masks_of(read_only(instances, np.uint16), count, begins, begins.view(np.uint64)))


def spatial_inliers(depth_m: Float32, runs: Int32, tau: float, epsilon_m: float) -> Pixels:
    """Pixels of an object whose depth is near the median of their 3x3 neighbourhood (Eq. 1).

    M_spatial = {p in M : |D(p) - D~(p)| < τ D~(p) + ε}. Invalid pixels count as 0 in the median
    and are never inliers. The image border is replicated. Depths are float32, the comparison is in
    float64.

    Args:
        depth_m: (H, W) float32 metres, 0 = invalid; from `valid_depth`.
        runs: (m, 4) of the object, see `Masks`.
        tau: relative tolerance.
        epsilon_m: absolute tolerance, metres.
    """
    return Pixels(*_spatial_inliers(depth_m, runs, tau, epsilon_m))


@kernel
def _masks_of(
    instances: UInt16, count: int, begins: UInt8, eights: UInt64
) -> tuple[Int32, Int64, Int64, int]:
    height, width = instances.shape
    sizes, starts, unknown = np.zeros(count, np.int64), np.zeros(count + 1, np.int64), 0
    found, total = np.empty((1024, 4), np.int32), 0
    begins[0] = 1
    columns = np.empty(width + 1, np.int32)
    for row in range(height):
        labels = instances[row]
        here, before, differs = labels[1:], labels[:-1], begins[1:]
        for index in range(here.size):
            differs[index] = np.uint8(here[index] != before[index])
        # Runs are long: eight pixels are skipped at once.
        runs = 0
        for eight in range(eights.size):
            if eights[eight] != 0:
                for column in range(8 * eight, 8 * eight + 8):
                    columns[runs] = column
                    runs += int(begins[column])
        columns[runs] = width
        if total + runs > len(found):
            fewer, found = found, np.empty((2 * len(found) + runs, 4), np.int32)
            for run in range(total):
                for item in range(4):
                    found[run, item] = fewer[run, item]
        for run in range(runs):
            start, stop = columns[run], columns[run + 1]
            label = int(labels[start])
            if label > count:
                unknown += int(stop - start)
            elif label > 0:
                sizes[label - 1] += stop - start
                starts[label] += 1
                found[total, 0], found[total, 1], found[total, 2] = row, start, stop
                found[total, 3] = label - 1
                total += 1
    ends, ordered = np.empty(count, np.int64), np.empty((total, 4), np.int32)
    for index in range(count):
        ends[index] = starts[index]
        starts[index + 1] += starts[index]
    for run in range(total):
        index = found[run, 3]
        for item in range(4):
            ordered[ends[index], item] = found[run, item]
        ends[index] += 1
    return ordered, starts, sizes, unknown


@kernel
def _spatial_inliers(
    depth_m: Float32, runs: Int32, tau: float, epsilon_m: float
) -> tuple[Int32, Int32, Float32]:
    height, width = depth_m.shape
    # One slot more than pixels: rejected pixels are written, too.
    slots = 1
    for index in range(len(runs)):
        slots += int(runs[index, 2] - runs[index, 1])
    columns, rows = np.empty(slots, np.int32), np.empty(slots, np.int32)
    depths_m = np.empty(slots, np.float32)
    # The lowest, middle and highest of three rows, from the column before a run to the one after
    # it. Positive floats have the order of their bits.
    sorted_columns = np.empty((3, width + 2), np.int32)
    lows, middles, highs = sorted_columns[0], sorted_columns[1], sorted_columns[2]
    medians, found, end = np.empty(width, np.int32), np.empty(width, np.uint8), np.uint64(0)
    for index in range(len(runs)):
        row, start, stop, _ = runs[index]
        first, last = max(start - 1, 0), min(stop + 1, width)
        above = depth_m[max(row - 1, 0), first:last]
        here = depth_m[row, first:last]
        below = depth_m[min(row + 1, height - 1), first:last]
        shift = first - (start - 1)
        low_here, middle_here, high_here = lows[shift:], middles[shift:], highs[shift:]
        for step in range(here.size):
            a = np.float32(above[step]).view(np.int32)
            b = np.float32(here[step]).view(np.int32)
            c = np.float32(below[step]).view(np.int32)
            low, high = min(a, b), max(a, b)
            low_here[step], high_here[step] = min(low, c), max(high, c)
            middle_here[step] = max(low, min(high, c))
        end_here = shift + here.size
        for rank in range(3):
            if shift:
                sorted_columns[rank, 0] = sorted_columns[rank, 1]
            if last < stop + 1:
                sorted_columns[rank, end_here] = sorted_columns[rank, end_here - 1]
        # Of nine sorted in columns, the median is that of the highest low, the middle middle and
        # the lowest high.
        run_m = depth_m[row, start:stop]
        for step in range(run_m.size):
            low = max(lows[step], max(lows[step + 1], lows[step + 2]))
            high = min(highs[step], min(highs[step + 1], highs[step + 2]))
            a, b, c = middles[step], middles[step + 1], middles[step + 2]
            middle = max(min(a, b), min(max(a, b), c))
            medians[step] = max(min(low, middle), min(max(low, middle), high))
        for step in range(run_m.size):
            depth = np.float64(run_m[step])
            median = np.float64(np.int32(medians[step]).view(np.float32))
            is_near = abs(depth - median) < tau * median + epsilon_m
            found[step] = np.uint8((depth > 0.0) & is_near)
        for step in range(run_m.size):
            columns[end] = start + step
            rows[end] = row
            depths_m[end] = run_m[step]
            end += np.uint64(found[step])
    return columns[:end], rows[:end], depths_m[:end]


# --- Depth refinement in the depth-distribution domain (Eq. 2), exact and in linear time.
#
# The equation is defined on sorted depths. Sorting is expensive, and almost never necessary:
#
# 1. Depths are counted in buckets that are narrower than half of the smallest possible threshold. A
#    larger step leaves an empty bucket.
# 2. Runs of non-empty buckets are the *blocks*. Clusters are cut between blocks only. The lowest
#    and highest depth of each block give the exact step. Depths with very many blocks are sorted.
# 3. d_ref is found in the bucket that contains it.
# 4. median(Δz) needs the sorted depths, but only if it can matter. At least half of the N - 1 steps
#    are as large as their median, and all steps sum to the range: median(Δz) <= 2 range / (N - 1).
#
# All arithmetic is float64 on float32 depths, as in the definition. Means come from integer sums,
# so they do not depend on the order of the pixels. The loops over all pixels have no branches and
# no dependent steps where possible, so that the compiler makes vector instructions of them.

# With more buckets, sorting is faster; and the index of a bucket is 16 bits long.
MAX_BUCKETS = (1 << 16) - 2
MIN_BUCKETS = 64
# Each gap between blocks is a pass over all depths; from about this number on, sorting is faster.
MAX_GAPS = 32
# Neighbouring pixels often fall into one bucket. So that their counts do not wait for one another,
# they are counted in turn in this number of tables.
COUNT_TABLES = 4
# The depths in the bucket of the median are counted in finer ones, until so few are left that they
# are sorted. (Numba would compile a kernel once more for a literal number.)
MEDIAN_BUCKETS, FEW_DEPTHS = np.int64(256), 64
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
def _counted(
    depths: Float32, lowest: float, scale: float, count: int | np.int64
) -> tuple[UInt16, Int64]:
    """Bucket of each depth, and number of depths in each bucket.

    int((depth - lowest) * scale) is monotone in the depth, even with rounding. So buckets are
    ordered and never overlap.
    """
    buckets = np.empty(depths.size, np.uint16)
    last = np.int32(count - 1)
    for index in range(depths.size):
        place = np.int32((np.float64(depths[index]) - lowest) * scale)
        buckets[index] = min(place, last)
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
    return buckets, tables[0]


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
        # The depths in this bucket; others are written, too.
        members, member = np.empty(counts[bucket] + 1, np.float32), np.uint64(0)
        wanted = np.uint16(bucket)
        for index in range(depths.size):
            members[member] = depths[index]
            member += np.uint64(buckets[index] == wanted)
        members = members[:-1]
        lowest, highest = _extremes(members)
        if next_rank == members.size:  # the upper middle is the lowest of the later buckets
            least = MOST_BITS
            for index in range(depths.size):
                bits = np.float32(depths[index]).view(np.int32)
                least = min(least, bits if buckets[index] > bucket else MOST_BITS)
            return (highest + np.float64(np.int32(least).view(np.float32))) / 2.0
        if lowest == highest:
            return lowest
        depths = members
        if depths.size <= FEW_DEPTHS:
            for index in range(1, depths.size):
                depth, at = depths[index], index
                while at > 0 and depths[at - 1] > depth:
                    depths[at] = depths[at - 1]
                    at -= 1
                depths[at] = depth
            return (np.float64(depths[rank]) + np.float64(depths[next_rank])) / 2.0
        scale = MEDIAN_BUCKETS / (highest - lowest)
        buckets, counts = _counted(depths, lowest, scale, MEDIAN_BUCKETS)


@kernel
def _blocks(
    depths: Float32, buckets: UInt16, counts: Int64, lowest: float, highest: float
) -> tuple[Float64, Float64]:
    """Lowest and highest depth of each block; none if there are more than MAX_GAPS gaps."""
    # A bucket after an empty one begins a block.
    starts, gaps = np.empty(MAX_GAPS, np.int64), 0
    for bucket in range(1, counts.size):
        if counts[bucket] > 0 and counts[bucket - 1] == 0:
            if gaps == MAX_GAPS:
                return np.empty(0, np.float64), np.empty(0, np.float64)
            starts[gaps] = bucket
            gaps += 1
    lows, highs = np.empty(gaps + 1, np.float64), np.empty(gaps + 1, np.float64)
    lows[0], highs[gaps] = lowest, highest
    for gap in range(gaps):
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
    # Depths are summed as multiples of a unit, exactly: of the last binary place of the lowest. The
    # sum must fit into 62 bits, so a very large range of depths takes a coarser unit. With 640 x
    # 480 depths, this begins where the highest is 2^20 times the lowest.
    finest = math.floor(math.log2(lows[0])) - 23
    unit = float(2.0 ** max(finest, math.ceil(math.log2(highs[-1] * depths.size)) - 62))
    per_unit = 1.0 / unit
    best, best_distance = -1, np.inf
    for cluster in range(first, last):
        total, count = np.int64(0), np.int64(0)
        low, high = lows[cluster], highs[cluster]
        for index in range(depths.size):
            depth = np.float64(depths[index])
            inside = (depth >= low) & (depth <= high)
            total += np.int64(depth * per_unit) if inside else np.int64(0)
            count += np.int64(inside)
        distance = abs(np.float64(total) * unit / count - reference)
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
    buckets, counts = _counted(depths, lowest, count / spread, count)
    lows, highs = _blocks(depths, buckets, counts, lowest, highest)
    if lows.size == 0:
        return np.inf, -np.inf
    reference = _median(depths, buckets, counts)

    threshold = max(gamma_base, beta * reference)
    # The bound on median(Δz), and the same bound without the steps between blocks: two distant
    # layers do not loosen the second one.
    within, steps = 0.0, depths.size - 1
    for block in range(lows.size):
        within += highs[block] - lows[block]
    step_bound = 2.0 * spread / steps
    inside = 0.5 * steps - (lows.size - 1)
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
