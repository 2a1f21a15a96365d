"""Labels of cells → labels of pixels, guided by the image."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float32, Int16, Int32, Int64, UInt8

# The cost of a cell sums squared differences between it and the pixel. Each of these counts 1:
# RGB colour, 8 bit; depth, relative to the depth.
COLOUR_STEP = 12.0
DEPTH_STEP = 0.015
# Cost of the squared distance to the cell's centre, in cell widths.
DISTANCE_WEIGHT = 0.5
# Maximum cost of the depth. A flying pixel is far from the surfaces on both sides.
MAX_DEPTH_COST = 9.0
# Row and column offsets of the candidate cells. Of several with one cost, the first in scan order
# is chosen: those above and on the left come before the pixel's own cell.
CANDIDATES = ((0, 0), (-1, 0), (0, -1), (0, 1), (1, 0))

_Candidates = tuple[Float32, Int64, Int16, int, int]


@kernel
def upsample_labels(
    labels: Int32, cell_rgb: UInt8, cell_depth: Float32, rgb: UInt8, depth_m: Float32, stride: int
) -> Int16:
    """Each pixel takes the label of the most similar of its own cell and the four beside it.

    Args:
        labels: (h, w) int32 of cells, below 2^15.
        cell_rgb: (h, w, 3) uint8 mean colour of cells.
        cell_depth: (h, w) float32 metres; 0 = invalid.
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 metres; 0, NaN or infinity = invalid.
        stride: pixels per cell.

    Returns:
        (H, W) int16.
    """
    height, width = depth_m.shape
    rows, columns = labels.shape
    result = np.empty((height, width), np.int16)
    near = np.empty((len(CANDIDATES), 4), np.float32)
    centres = np.empty((len(CANDIDATES), 2), np.int64)
    near_labels = np.empty(len(CANDIDATES), np.int16)
    # The cost of each distance along an axis, from `reach` pixels before a centre on.
    reach = 2 * stride
    along = np.empty(6 * stride, np.float32)
    for i in range(len(along)):
        d = np.float32(i - reach) / np.float32(stride)
        along[i] = d * d
    for v in range(rows):
        # The last cells also cover the pixels that the stride leaves over.
        top, bottom = v * stride, height if v == rows - 1 else (v + 1) * stride
        for u in range(columns):
            right = width if u == columns - 1 else (u + 1) * stride
            for x in range(u * stride, right):
                result[top, x] = labels[v, u]
        for y in range(top + 1, bottom):
            for x in range(width):
                result[y, x] = result[top, x]
        for u in range(columns):
            if _is_uniform(labels, v, u):
                continue
            before = (v > 0) + (u > 0)
            count = 1 + before + (u < columns - 1) + (v < rows - 1)
            i = 0
            for dv, du in CANDIDATES:
                b, a = v + dv, u + du
                if b < 0 or a < 0 or b >= rows or a >= columns:
                    continue
                for k in range(3):
                    near[i, k] = cell_rgb[b, a, k]
                near[i, 3] = cell_depth[b, a]
                centres[i, 0] = b * stride + stride // 2 - reach
                centres[i, 1] = a * stride + stride // 2 - reach
                near_labels[i] = labels[b, a]
                i += 1
            right = width if u == columns - 1 else (u + 1) * stride
            pixels = (top, bottom, u * stride, right)
            candidates = (near, centres, near_labels, count, before)
            _choose(candidates, along, rgb, depth_m, pixels, result)
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
def _choose(
    candidates: _Candidates,
    along: Float32,
    rgb: UInt8,
    depth_m: Float32,
    pixels: tuple[int, int, int, int],
    result: Int16,
) -> None:
    """Write the label of the candidate with the least cost to each pixel of a cell.

    Args:
        candidates: their colour and depth (k, 4), the own cell first; row and column (k, 2) from
            which `along` counts; labels; their number; those from 1 to this one win against the
            own cell at the same cost.
        along: cost of the distance along an axis.
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 metres.
        pixels: first and last row, first and last column, without the last.
        result: (H, W) int16, written.
    """
    near, centres, labels, count, before = candidates
    colour_weight = np.float32(COLOUR_STEP * COLOUR_STEP)
    for y in range(pixels[0], pixels[1]):
        for x in range(pixels[2], pixels[3]):
            red, green, blue = (
                np.float32(rgb[y, x, 0]),
                np.float32(rgb[y, x, 1]),
                np.float32(rgb[y, x, 2]),
            )
            z = depth_m[y, x]
            depth_step = np.float32(DEPTH_STEP) * z
            has_depth = z > 0 and z < np.inf
            # Above this, colour and distance alone cost more than the best; divisions take long.
            most = best = np.float32(np.inf)
            chosen = 0
            for i in range(count):
                d, e, f = red - near[i, 0], green - near[i, 1], blue - near[i, 2]
                cost = d * d + e * e + f * f
                distance = along[y - centres[i, 0]] + along[x - centres[i, 1]]
                distance = np.float32(DISTANCE_WEIGHT) * distance
                if cost + colour_weight * distance > most:
                    continue
                cost /= colour_weight
                if has_depth and near[i, 3] > 0:
                    d = (z - near[i, 3]) / depth_step
                    cost += min(d * d, np.float32(MAX_DEPTH_COST))
                cost += distance
                if cost < best or (cost == best and chosen == 0 and i <= before):
                    best, chosen = cost, i
                    most = best * np.float32(COLOUR_STEP * COLOUR_STEP * (1.0 + 1e-5))
            result[y, x] = labels[chosen]
