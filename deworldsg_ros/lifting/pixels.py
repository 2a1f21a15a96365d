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


def valid_depth(depth_m: Float32) -> Float32:
    """Depth image (H, W) float32, metres; NaN, infinity and negative values become 0.

    The result is read-only and contiguous. An image without such values is not copied.
    """
    image_m = read_only(depth_m, np.float32)
    return image_m if _is_valid(image_m) else read_only(_valid_depth(image_m))


@kernel
def _is_valid(depth_m: Float32) -> bool:
    """Whether all depths are finite and not negative: their bits are below those of infinity."""
    greatest = np.uint32(0)
    for row in range(depth_m.shape[0]):
        for column in range(depth_m.shape[1]):
            greatest = max(greatest, np.float32(depth_m[row, column]).view(np.uint32))
    return bool(greatest < 0x7F800000)


@kernel
def _valid_depth(depth_m: Float32) -> Float32:
    height, width = depth_m.shape
    valid = np.empty((height, width), np.float32)
    zero, infinity = np.float32(0), np.float32(np.inf)
    for row in range(height):
        for column in range(width):
            depth = depth_m[row, column]
            valid[row, column] = depth if (depth > zero) & (depth < infinity) else zero
    return valid
