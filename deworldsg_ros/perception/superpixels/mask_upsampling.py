"""Labels of cells → labels of pixels, guided by the image."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float32, Int32, UInt8

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
    result = np.empty((height, width), np.int32)
    for v in range(rows):
        # The last cells also cover the pixels that the stride leaves over.
        bottom = height if v == rows - 1 else (v + 1) * stride
        for u in range(columns):
            right = width if u == columns - 1 else (u + 1) * stride
            if _is_uniform(labels, v, u):
                result[v * stride : bottom, u * stride : right] = labels[v, u]
                continue
            for y in range(v * stride, bottom):
                for x in range(u * stride, right):
                    result[y, x] = _label_of_pixel(
                        labels, cell_rgb, cell_depth, rgb[y, x], depth_m[y, x], y, x, v, u, stride
                    )
    return result


@kernel
def _is_uniform(labels: Int32, v: int, u: int) -> bool:
    """Whether all candidates of the pixels of cell (v, u) have one label."""
    rows, columns = labels.shape
    for dv, du in CANDIDATES:
        b, a = v + dv, u + du
        if 0 <= b < rows and 0 <= a < columns and labels[b, a] != labels[v, u]:
            return False
    return True


@kernel
def _label_of_pixel(
    labels: Int32,
    cell_rgb: UInt8,
    cell_depth: Float32,
    colour: UInt8,
    z: float,
    y: int,
    x: int,
    v: int,
    u: int,
    stride: int,
) -> int:
    """The label of pixel (y, x), of colour (3,) and depth z, in cell (v, u)."""
    rows, columns = labels.shape
    depth_step = np.float32(DEPTH_STEP) * z
    has_depth = z > 0 and z < np.inf
    best = np.float32(np.inf)
    chosen = labels[v, u]
    for dv, du in CANDIDATES:
        b, a = v + dv, u + du
        if b < 0 or a < 0 or b >= rows or a >= columns:
            continue
        cost = np.float32(0.0)
        for k in range(3):
            d = np.float32(colour[k]) - np.float32(cell_rgb[b, a, k])
            cost += d * d
        cost /= np.float32(COLOUR_STEP * COLOUR_STEP)
        if cost >= best:  # the other terms only add to it
            continue
        if has_depth and cell_depth[b, a] > 0:
            d = (z - cell_depth[b, a]) / depth_step
            cost += min(d * d, np.float32(MAX_DEPTH_COST))
        d = np.float32(y - (b * stride + stride // 2)) / np.float32(stride)
        e = np.float32(x - (a * stride + stride // 2)) / np.float32(stride)
        cost += np.float32(DISTANCE_WEIGHT) * (d * d + e * e)
        if cost < best:
            best = cost
            chosen = labels[b, a]
    return chosen
