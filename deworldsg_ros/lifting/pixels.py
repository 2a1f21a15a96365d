"""Pixels of an object with valid depth, as parallel arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.kernels import kernel, read_only
from deworldsg_ros.scene.arrays import Float32, Int32


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

    def sample(self, count: int) -> Pixels:
        """`count` of the pixels, evenly spaced; at most as many as there are."""
        return Pixels(*_sample(self.columns, self.rows, self.depths_m, count))


def valid_depth(depth_m: Float32) -> Float32:
    """Depth image (H, W) float32, metres; NaN, infinity and negative values become 0.

    The result is read-only and contiguous. An image without such values is not copied.
    """
    image_m = read_only(depth_m, np.float32)
    return image_m if _is_valid(image_m) else read_only(_valid_depth(image_m))


@kernel
def _is_valid(depth_m: Float32) -> bool:
    """Whether all depths are finite and not negative: their bits are below those of infinity."""
    bits, greatest = depth_m.reshape(-1).view(np.uint32), np.uint32(0)
    for index in range(bits.size):
        greatest = max(greatest, bits[index])
    return bool(greatest < 0x7F800000)


@kernel
def _valid_depth(depth_m: Float32) -> Float32:
    valid = np.empty_like(depth_m)
    flat_in, flat_out = depth_m.reshape(-1), valid.reshape(-1)
    zero, infinity = np.float32(0), np.float32(np.inf)
    for index in range(flat_in.size):
        depth = flat_in[index]
        flat_out[index] = depth if (depth > zero) & (depth < infinity) else zero
    return valid


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


@kernel
def _sample(
    columns: Int32, rows: Int32, depths_m: Float32, count: int
) -> tuple[Int32, Int32, Float32]:
    some_columns, some_rows = np.empty(count, np.int32), np.empty(count, np.int32)
    some_depths = np.empty(count, np.float32)
    for index in range(count):
        place = index * depths_m.size // count
        some_columns[index], some_rows[index] = columns[place], rows[place]
        some_depths[index] = depths_m[place]
    return some_columns, some_rows, some_depths
