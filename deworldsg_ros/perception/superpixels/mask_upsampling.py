"""Labels of cells → labels of pixels, guided by the image."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float32, Int32, UInt8

# The cost of a cell sums squared differences between it and the pixel. Each of these counts 1:
# RGB colour, 8 bit; depth, relative to the depth.
COLOUR_STEP = 12.0
DEPTH_STEP = 0.015
# Cost of the squared distance to the cell's centre, in cell widths.
DISTANCE_WEIGHT = 0.5
# Maximum cost of the depth. A flying pixel is far from the surfaces on both sides.
MAX_DEPTH_COST = 9.0
# Row and column offsets of the candidate cells; the first of several with one cost is chosen.
CANDIDATES = ((-1, 0), (0, -1), (0, 0), (0, 1), (1, 0))


@kernel
def upsample_labels(
    labels: Int32, cell_rgb: UInt8, cell_depth: Float32, rgb: UInt8, depth_m: Float32, stride: int
) -> Int32:
    """Each pixel takes the label of the most similar of its own cell and the four beside it.

    Args:
        labels: (h, w) int32 of cells.
        cell_rgb: (h, w, 3) uint8 mean colour of cells.
        cell_depth: (h, w) float32 metres; 0 = invalid.
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 metres; 0, NaN or infinity = invalid.
        stride: pixels per cell.

    Returns:
        (H, W) int32.
    """
    height, width = depth_m.shape
    rows, columns = labels.shape
    # The last cells also cover the pixels that the stride leaves over.
    row_of = np.minimum(np.arange(height) // stride, rows - 1)
    column_of = np.minimum(np.arange(width) // stride, columns - 1)
    uniform = _uniform_cells(labels)
    result = np.empty((height, width), np.int32)
    for y in range(height):
        for x in range(width):
            v, u = row_of[y], column_of[x]
            best = np.float32(np.inf)
            chosen = labels[v, u]
            if uniform[v, u]:
                result[y, x] = chosen
                continue
            z = depth_m[y, x]
            for dv, du in CANDIDATES:
                b, a = v + dv, u + du
                if b < 0 or a < 0 or b >= rows or a >= columns:
                    continue
                cost = np.float32(0.0)
                for k in range(3):
                    d = np.float32(rgb[y, x, k]) - np.float32(cell_rgb[b, a, k])
                    cost += d * d
                cost /= np.float32(COLOUR_STEP * COLOUR_STEP)
                if z > 0 and z < np.inf and cell_depth[b, a] > 0:
                    d = (z - cell_depth[b, a]) / (np.float32(DEPTH_STEP) * z)
                    cost += min(d * d, np.float32(MAX_DEPTH_COST))
                d = np.float32(y - (b * stride + stride // 2)) / np.float32(stride)
                e = np.float32(x - (a * stride + stride // 2)) / np.float32(stride)
                cost += np.float32(DISTANCE_WEIGHT) * (d * d + e * e)
                if cost < best:
                    best = cost
                    chosen = labels[b, a]
            result[y, x] = chosen
    return result


@kernel
def _uniform_cells(labels: Int32) -> Bool:
    """(h, w) bool: cells whose eight neighbours have the same label."""
    rows, columns = labels.shape
    uniform = np.ones((rows, columns), np.bool_)
    for v in range(rows):
        for u in range(columns):
            for b in range(max(v - 1, 0), min(v + 2, rows)):
                for a in range(max(u - 1, 0), min(u + 2, columns)):
                    uniform[v, u] &= labels[b, a] == labels[v, u]
    return uniform
