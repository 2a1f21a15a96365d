"""Depth refinement in the spatial domain (Eq. 1)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deworldsg_ros.kernels import kernel, read_only
from deworldsg_ros.lifting.pixels import Pixels
from deworldsg_ros.scene.arrays import Float32, Int32, Int64, UInt8, UInt16, UInt64


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


def valid_pixel_count(depth_m: Float32, runs: Int32) -> int:
    """Number of valid pixels in runs (m, 4) of a depth image (H, W), from `valid_depth`."""
    return int(_valid_pixel_count(depth_m, runs))


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
def _valid_pixel_count(depth_m: Float32, runs: Int32) -> int:
    count, zero = 0, np.float32(0)
    for index in range(len(runs)):
        row, start, stop, _ = runs[index]
        run_m, valid = depth_m[row, start:stop], np.int32(0)
        for step in range(run_m.size):
            valid += np.int32(run_m[step] > zero)
        count += int(valid)
    return count


@kernel
def _ordered(a: np.int32, b: np.int32, c: np.int32) -> tuple[np.int32, np.int32, np.int32]:
    """Three numbers in ascending order."""
    low, high = min(a, b), max(a, b)
    return min(low, c), max(low, min(high, c)), max(high, c)


@kernel
def _sort_columns(depth_m: Float32, row: int, start: int, stop: int, columns: Int32) -> None:
    """Sort the depths of rows row - 1 to row + 1 in each column from start - 1 to stop.

    Args:
        depth_m: (H, W); positive floats have the order of their bits.
        row: of a run of pixels.
        start: its first column.
        stop: the column after its last one.
        columns: (3, W + 2), filled from 0 on with the lowest, middle and highest of each column.
    """
    height, width = depth_m.shape
    first, last = max(start - 1, 0), min(stop + 1, width)
    above = depth_m[max(row - 1, 0), first:last]
    here = depth_m[row, first:last]
    below = depth_m[min(row + 1, height - 1), first:last]
    shift = first - (start - 1)
    count = last - first
    lows, middles, highs = columns[0, shift:], columns[1, shift:], columns[2, shift:]
    for index in range(count):
        lows[index], middles[index], highs[index] = _ordered(
            np.float32(above[index]).view(np.int32),
            np.float32(here[index]).view(np.int32),
            np.float32(below[index]).view(np.int32),
        )
    end = shift + count
    for rank in range(3):
        if shift:
            columns[rank, 0] = columns[rank, 1]
        if last < stop + 1:
            columns[rank, end] = columns[rank, end - 1]


@kernel
def _find_inliers(
    depths_m: Float32, columns: Int32, medians: Int32, tau: float, epsilon_m: float, found: UInt8
) -> None:
    """Mark the inliers of a run of pixels (Eq. 1).

    Of nine sorted in columns, the median is that of the highest low, the middle middle and the
    lowest high.

    Args:
        depths_m: (n,) depths of the run.
        columns: see `_sort_columns`.
        medians: (W,) space for the bits of the medians.
        tau: relative tolerance.
        epsilon_m: absolute tolerance, metres.
        found: (W,) filled with 1 for inliers and 0 for other pixels.
    """
    lows, middles, highs = columns[0], columns[1], columns[2]
    for index in range(depths_m.size):
        low = max(lows[index], max(lows[index + 1], lows[index + 2]))
        _, middle, _ = _ordered(middles[index], middles[index + 1], middles[index + 2])
        high = min(highs[index], min(highs[index + 1], highs[index + 2]))
        medians[index] = _ordered(low, middle, high)[1]
    for index in range(depths_m.size):
        depth, median = (
            np.float64(depths_m[index]),
            np.float64(np.int32(medians[index]).view(np.float32)),
        )
        is_near = abs(depth - median) < tau * median + epsilon_m
        found[index] = np.uint8((depth > 0.0) & is_near)


@kernel
def _spatial_inliers(
    depth_m: Float32, runs: Int32, tau: float, epsilon_m: float
) -> tuple[Int32, Int32, Float32]:
    # One slot more than pixels: rejected pixels are written, too.
    slots, width = 1, depth_m.shape[1]
    for index in range(len(runs)):
        slots += int(runs[index, 2] - runs[index, 1])
    columns, rows = np.empty(slots, np.int32), np.empty(slots, np.int32)
    depths_m = np.empty(slots, np.float32)
    sorted_columns = np.empty((3, width + 2), np.int32)
    medians, found, end = np.empty(width, np.int32), np.empty(width, np.uint8), np.uint64(0)
    for index in range(len(runs)):
        row, start, stop, _ = runs[index]
        run_m = depth_m[row, start:stop]
        _sort_columns(depth_m, row, start, stop, sorted_columns)
        _find_inliers(run_m, sorted_columns, medians, tau, epsilon_m, found)
        for step in range(run_m.size):
            columns[end] = start + step
            rows[end] = row
            depths_m[end] = run_m[step]
            end += np.uint64(found[step])
    return columns[:end], rows[:end], depths_m[:end]
