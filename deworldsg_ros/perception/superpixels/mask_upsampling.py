"""Labels of cells → labels of pixels, with the image as the guide."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float32, Int32, UInt8

# Differences that count 1: of colour (RGB, 8 bit), of depth relative to depth, of a cell's width.
COLOUR_STEP = 12.0
DEPTH_STEP = 0.015
PLACE_WEIGHT = 0.5
# Depth says no more than this; a flying pixel is far from both sides.
DEPTH_LIMIT = 9.0


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
        stride: pixels a cell.

    Returns:
        (H, W) int32.
    """
    height, width = depth_m.shape
    rows, columns = labels.shape
    result = np.empty((height, width), np.int32)
    for v in range(rows):
        bottom = height if v == rows - 1 else (v + 1) * stride
        v0, v1 = max(v - 1, 0), min(v + 1, rows - 1)
        for u in range(columns):
            right = width if u == columns - 1 else (u + 1) * stride
            u0, u1 = max(u - 1, 0), min(u + 1, columns - 1)
            own = labels[v, u]
            uniform = True
            for b in range(v0, v1 + 1):
                for a in range(u0, u1 + 1):
                    if labels[b, a] != own:
                        uniform = False
            for y in range(v * stride, bottom):
                for x in range(u * stride, right):
                    if uniform:
                        result[y, x] = own
                        continue
                    best = np.float32(np.inf)
                    chosen = own
                    z = depth_m[y, x]
                    known = z > 0 and z < np.inf
                    for b in range(v0, v1 + 1):
                        for a in range(u0, u1 + 1):
                            if b != v and a != u:
                                continue
                            cost = np.float32(0.0)
                            for k in range(3):
                                d = np.float32(rgb[y, x, k]) - np.float32(cell_rgb[b, a, k])
                                cost += d * d
                            cost /= np.float32(COLOUR_STEP * COLOUR_STEP)
                            if known and cell_depth[b, a] > 0:
                                d = (z - cell_depth[b, a]) / (np.float32(DEPTH_STEP) * z)
                                cost += min(d * d, np.float32(DEPTH_LIMIT))
                            d = np.float32(y - (b * stride + stride // 2)) / np.float32(stride)
                            e = np.float32(x - (a * stride + stride // 2)) / np.float32(stride)
                            cost += np.float32(PLACE_WEIGHT) * (d * d + e * e)
                            if cost < best:
                                best = cost
                                chosen = labels[b, a]
                    result[y, x] = chosen
    return result
