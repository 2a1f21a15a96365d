"""Pixels of an object with valid depth, as parallel arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.kernels import kernel, read_only
from deworldsg_ros.scene.arrays import Float32, Int32, Int64, UInt16


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

    def within(self, lowest_m: float, highest_m: float) -> Pixels:
        """The pixels with depth in [lowest_m, highest_m], metres."""
        return Pixels(*_within(self.columns, self.rows, self.depths_m, lowest_m, highest_m))


def valid_depth(depth_m: Float32) -> Float32:
    """Depth image (H, W) float32, metres; NaN, infinity and negative values become 0."""
    return _valid_depth(read_only(depth_m, np.float32))


def valid_pixel_counts(depth_m: Float32, instances: UInt16, count: int) -> Int64:
    """Number of valid pixels in the mask of each object.

    Args:
        depth_m: (H, W) float32, 0 = invalid.
        instances: (H, W) uint16, 0 = no object, k = k-th object.
        count: number of objects.

    Returns:
        (count + 1,) int64: entry k belongs to object k, entry 0 to all ids above `count`.
    """
    return _valid_pixel_counts(
        read_only(depth_m, np.float32), read_only(instances, np.uint16), count
    )


@kernel
def _valid_depth(depth_m: Float32) -> Float32:
    valid = np.empty_like(depth_m)
    flat_in, flat_out = depth_m.reshape(-1), valid.reshape(-1)
    zero = np.float32(0)
    for index in range(flat_in.size):
        depth = flat_in[index]
        flat_out[index] = depth if (depth > zero) & (depth < np.inf) else zero
    return valid


@kernel
def _valid_pixel_counts(depth_m: Float32, instances: UInt16, count: int) -> Int64:
    counts = np.zeros(count + 1, np.int64)
    depths, labels = depth_m.reshape(-1), instances.reshape(-1)
    index = 0
    while index < labels.size:
        label = labels[index]
        # Ids come in runs: each run is counted at once.
        valid, start = 0, index
        while index < labels.size and labels[index] == label:
            valid += depths[index] > 0
            index += 1
        if label > count:
            counts[0] += index - start
        elif label > 0:
            counts[label] += valid
    return counts


@kernel
def _within(
    columns: Int32, rows: Int32, depths_m: Float32, lowest_m: float, highest_m: float
) -> tuple[Int32, Int32, Float32]:
    kept_columns = np.empty_like(columns)
    kept_rows = np.empty_like(rows)
    kept_depths = np.empty_like(depths_m)
    kept = 0
    for index in range(depths_m.size):
        depth = depths_m[index]
        kept_columns[kept] = columns[index]
        kept_rows[kept] = rows[index]
        kept_depths[kept] = depth
        kept += (depth >= lowest_m) & (depth <= highest_m)
    return kept_columns[:kept], kept_rows[:kept], kept_depths[:kept]
