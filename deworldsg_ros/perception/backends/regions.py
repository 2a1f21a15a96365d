"""Regions of an RGB-D image: small, of one surface and one colour.

Felzenszwalb and Huttenlocher's graph-based segmentation (2004) of a reduced image, with edge
weights of colour, depth and surface direction; and the adjacency of its regions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.scene.arrays import Float32, Float64, Int32, UInt8
from deworldsg_ros.scene.camera import Intrinsics

# An edge weight is the root of summed squares. Each of these differences between neighbouring cells
# counts 1: CIE Lab colour, 8-bit scale; depth, relative to the depth; 1 - cos of the angle between
# normals. Chosen with the others below on every 16th frame of two rendered rooms
# (bench/segmenter_iou.py).
COLOUR_STEP = 8.0
DEPTH_STEP = 0.015
NORMAL_STEP = 1.0
# Weight of an edge between a cell with depth and one without. Holes in the depth also occur within
# a surface, so it is below 1.
HOLE_STEP = 0.55
# Felzenszwalb's k, cells: larger regions for a larger value.
COARSENESS = 4.0
# Smaller regions join their most similar neighbour.
MIN_CELLS = 3
# Larger depths, and NaN, are invalid; the limit keeps the arithmetic of points finite.
MAX_DEPTH_M = 1000.0
# The slope of the depth is measured this far to either side, against the noise of the sensor.
SLOPE_REACH_CELLS = 2
# Counting sort of the edge weights: 64 bins per unit; differences below 1/64 do not matter. (Numba
# would compile a kernel once more for a literal number.)
BINS_PER_UNIT = 64.0
WEIGHT_BINS = np.int64(512)


@dataclass(frozen=True)
class Cells:
    """The reduced image (h, w): each cell stands for `stride` x `stride` pixels.

    Attributes:
        stride: pixels per cell; cell (y, x) covers pixels from (y stride, x stride).
        rgb: (h, w, 3) uint8, mean colour.
        lab: (h, w, 3) float32, mean colour in CIE Lab, 8-bit scale.
        points: (h, w, 3) float32, metres, camera frame; 0 if the depth is invalid.
        normals: (h, w, 3) float32, unit, towards the camera; 0 if the depth is invalid.
    """

    stride: int
    rgb: UInt8
    lab: Float32
    points: Float32
    normals: Float32


class Regions(NamedTuple):
    """Regions of a reduced image (c regions, m adjacent pairs); a tuple, as kernels take it.

    Attributes:
        labels: (h, w) int32, region of each cell, from 0.
        area: (c,) float64, cells.
        lab: (c, 3) float64, mean colour in CIE Lab.
        valid: (c,) float64, cells with depth.
        point: (c, 3) float64, mean point, metres, camera frame.
        normal: (c, 3) float64, mean normal, unit.
        flatness: (c,) float64, length of the mean of the unit normals; 1 = flat.
        pairs: (m, 2) int32, adjacent regions.
        strength: (m,) float64, mean edge weight along the border.
        length: (m,) float64, edges along the border.
    """

    labels: Int32
    area: Float64
    lab: Float64
    valid: Float64
    point: Float64
    normal: Float64
    flatness: Float64
    pairs: Int32
    strength: Float64
    length: Float64


def reduce_frame(rgb: UInt8, depth_m: Float32, intrinsics: Intrinsics, stride: int) -> Cells:
    """The cells of a frame: mean colour, median depth, normals from the slope of the depth.

    Args:
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32, metres; 0, NaN or infinity = invalid.
        intrinsics: of both images.
        stride: pixels per cell.
    """
    height, width = depth_m.shape[0] // stride, depth_m.shape[1] // stride
    middle = slice(stride // 2, None, stride)
    smooth = np.asarray(cv2.blur(rgb, (stride, stride)), dtype=np.uint8)
    mean = np.ascontiguousarray(smooth[middle, middle][:height, :width])
    lab = cv2.cvtColor(mean, cv2.COLOR_RGB2Lab).astype(np.float32)
    sampled = depth_m[middle, middle][:height, :width]
    valid = (sampled > 0) & (sampled < MAX_DEPTH_M)
    z = np.asarray(cv2.medianBlur(np.where(valid, sampled, np.float32(0)), 3), np.float32)
    columns = (np.arange(width) * stride + stride // 2 - intrinsics.cx) / intrinsics.fx
    rows = (np.arange(height) * stride + stride // 2 - intrinsics.cy) / intrinsics.fy
    blurred = np.asarray(cv2.blur(z, (5, 5)), np.float32)
    points, normals = _geometry(z, blurred, columns.astype(np.float32), rows.astype(np.float32))
    return Cells(stride, mean, lab, points, normals)


def find_regions(cells: Cells) -> Regions:
    """The regions of a reduced image and their adjacency."""
    weights = _edge_weights(cells.lab, cells.points, cells.normals)
    labels, count = _merge(weights)
    sums = _region_sums(labels, count, cells.lab, cells.points, cells.normals)
    # Contiguous also for one region: kernels are compiled for one layout.
    area, valid = np.ascontiguousarray(sums[:, 0]), np.ascontiguousarray(sums[:, 4])
    normal_length = np.linalg.norm(sums[:, 8:11], axis=1)
    pairs, strength, length = adjacency(labels, count, weights)
    return Regions(
        labels=labels,
        area=area,
        lab=sums[:, 1:4] / area[:, None],
        valid=valid,
        point=sums[:, 5:8] / np.maximum(valid, 1.0)[:, None],
        normal=sums[:, 8:11] / np.maximum(normal_length, 1e-9)[:, None],
        flatness=normal_length / np.maximum(valid, 1.0),
        pairs=pairs,
        strength=strength,
        length=length,
    )


@kernel
def _geometry(
    z: Float32, smooth: Float32, columns: Float32, rows: Float32
) -> tuple[Float32, Float32]:
    """Points and normals (h, w, 3) of the cells.

    Args:
        z: (h, w) float32, metres; 0 = invalid.
        smooth: (h, w) float32, the same, smoothed for the slope.
        columns: (w,) float32, x of the cells on the image plane at 1 m.
        rows: (h,) float32, y of the cells on the image plane at 1 m.
    """
    height, width = z.shape
    points = np.zeros((height, width, 3), np.float32)
    normals = np.zeros((height, width, 3), np.float32)
    step_x = columns[1] - columns[0]
    step_y = rows[1] - rows[0]
    for y in range(height):
        for x in range(width):
            depth = z[y, x]
            if not depth > 0:
                continue
            points[y, x, 0] = columns[x] * depth
            points[y, x, 1] = rows[y] * depth
            points[y, x, 2] = depth
            left, right = max(x - SLOPE_REACH_CELLS, 0), min(x + SLOPE_REACH_CELLS, width - 1)
            top, bottom = max(y - SLOPE_REACH_CELLS, 0), min(y + SLOPE_REACH_CELLS, height - 1)
            slope_x = (smooth[y, right] - smooth[y, left]) / ((right - left) * step_x)
            slope_y = (smooth[bottom, x] - smooth[top, x]) / ((bottom - top) * step_y)
            # Normal of the plane with this gradient of the depth over the image plane at 1 m.
            a, b = slope_x, slope_y
            c = -(depth + columns[x] * slope_x + rows[y] * slope_y)
            length = np.sqrt(a * a + b * b + c * c) + 1e-12
            normals[y, x, 0] = a / length
            normals[y, x, 1] = b / length
            normals[y, x, 2] = c / length
    return points, normals


@kernel
def _edge_weights(lab: Float32, points: Float32, normals: Float32) -> Float32:
    """(2, h, w): weights of the edges to the cells on the right and below; inf at the border."""
    height, width = lab.shape[:2]
    weights = np.empty((2, height, width), np.float32)
    for y in range(height):
        for x in range(width):
            for direction in range(2):
                v, u = y + direction, x + 1 - direction
                if v == height or u == width:
                    weights[direction, y, x] = np.inf
                    continue
                square = np.float32(0.0)
                for k in range(3):
                    d = (lab[y, x, k] - lab[v, u, k]) / np.float32(COLOUR_STEP)
                    square += d * d
                here, there = points[y, x, 2], points[v, u, 2]
                if here > 0 and there > 0:
                    d = (here - there) / (np.float32(DEPTH_STEP) * min(here, there))
                    square += d * d
                    cosine = np.float32(0.0)
                    for k in range(3):
                        cosine += normals[y, x, k] * normals[v, u, k]
                    square += (np.float32(1.0) - cosine) / np.float32(NORMAL_STEP)
                elif here > 0 or there > 0:
                    square += np.float32(HOLE_STEP * HOLE_STEP)
                # Rounding of unit normals may give a cosine above 1.
                weights[direction, y, x] = np.sqrt(max(square, np.float32(0.0)))
    return weights


@kernel
def _root(parent: Int32, node: int) -> int:
    """Root of a cell in the union-find forest; halves the path on the way."""
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node


@kernel
def _merge(weights: Float32) -> tuple[Int32, int]:
    """Labels (h, w) int32 of the regions, from 0, and their number.

    Edge `i` of the flat weights joins cell `i` and the one on its right, or, in the second half,
    cell `i - cells` and the one below.
    """
    _, height, width = weights.shape
    cells = height * width
    flat = weights.reshape(2 * cells)
    # The edges in the order of their weights, up to the width of a bin.
    bins, order, total = np.empty(2 * cells, np.int32), np.empty(2 * cells, np.int32), 0
    for edge in range(2 * cells):
        if flat[edge] != np.inf:
            bins[edge] = min(int(flat[edge] * BINS_PER_UNIT), WEIGHT_BINS - 1)
            order[total] = edge
            total += 1
    order = _sorted(bins, order[:total], WEIGHT_BINS)
    parent, size = np.empty(cells, np.int32), np.empty(cells, np.int32)
    for cell in range(cells):
        parent[cell], size[cell] = cell, 1
    internal = np.zeros(cells, np.float32)
    # The first sweep joins similar cells. The second joins each region that is still too small
    # with its most similar neighbour.
    for sweep in range(2):
        left = 0
        for i in range(total):
            edge = order[i]
            a = edge if edge < cells else edge - cells
            b = a + (1 if edge < cells else width)
            if parent[a] == parent[b]:  # most edges are inside a region, whose cells have one root
                continue
            a, b = _root(parent, a), _root(parent, b)
            if a == b:
                continue
            weight = flat[edge]
            if sweep == 0:
                join = weight <= min(
                    internal[a] + COARSENESS / size[a], internal[b] + COARSENESS / size[b]
                )
            else:
                join = size[a] < MIN_CELLS or size[b] < MIN_CELLS
            if not join:
                order[left] = edge
                left += 1
                continue
            if size[a] < size[b]:
                a, b = b, a
            parent[b] = a
            size[a] += size[b]
            internal[a] = weight
        total = left
    # The regions are numbered in scan order.
    labels, numbers, count = np.empty(cells, np.int32), np.zeros(cells, np.int32), 0
    for cell in range(cells):
        root = _root(parent, cell)
        if numbers[root] == 0:
            count += 1
            numbers[root] = count
        labels[cell] = numbers[root] - 1
    return labels.reshape(height, width), count


@kernel
def _sorted(keys: Int32, order: Int32, count: int | np.int64) -> Int32:
    """The indices in `order`, in ascending order of their keys in [0, count); stable."""
    start = np.zeros(count + 1, np.int32)
    for i in range(len(order)):
        start[keys[order[i]] + 1] += 1
    for key in range(count):
        start[key + 1] += start[key]
    result = np.empty(len(order), np.int32)
    for i in range(len(order)):
        key = keys[order[i]]
        result[start[key]] = order[i]
        start[key] += 1
    return result


@kernel
def _region_sums(
    labels: Int32, count: int, lab: Float32, points: Float32, normals: Float32
) -> Float64:
    """(count, 11) sums per region: cells; Lab (3); cells with depth; points (3); normals (3)."""
    sums = np.zeros((count, 11), np.float64)
    height, width = labels.shape
    for y in range(height):
        for x in range(width):
            row = sums[labels[y, x]]
            row[0] += 1
            for k in range(3):
                row[1 + k] += lab[y, x, k]
            if points[y, x, 2] > 0:
                row[4] += 1
                for k in range(3):
                    row[5 + k] += points[y, x, k]
                    row[8 + k] += normals[y, x, k]
    return sums


@kernel
def adjacency(labels: Int32, count: int, weights: Float32) -> tuple[Int32, Float64, Float64]:
    """Adjacent regions (m, 2) int32, in order; the mean weight and the number of border edges."""
    height, width = labels.shape
    # The edges between regions: the two regions, the lower one first, and the weight.
    first = np.empty(2 * height * width, np.int32)
    second, order = np.empty(len(first), np.int32), np.empty(len(first), np.int32)
    values, found = np.empty(2 * height * width, np.float32), 0
    for y in range(height):
        for x in range(width):
            a = labels[y, x]
            for direction in range(2):
                v = y + direction
                u = x + 1 - direction
                if v < height and u < width and labels[v, u] != a:
                    b = labels[v, u]
                    first[found], second[found] = min(a, b), max(a, b)
                    values[found], order[found] = weights[direction, y, x], found
                    found += 1
    # In the order of both regions, and in scan order along one border.
    order = _sorted(first, _sorted(second, order[:found], count), count)
    pairs, means = np.empty((found, 2), np.int32), np.empty(found, np.float64)
    lengths = np.zeros(found, np.float64)
    last, total = -1, 0.0
    for i in range(found):
        edge = order[i]
        a, b = first[edge], second[edge]
        if last < 0 or pairs[last, 0] != a or pairs[last, 1] != b:
            last += 1
            pairs[last, 0], pairs[last, 1] = a, b
            total = 0.0
        total += values[edge]
        lengths[last] += 1.0
        means[last] = total / lengths[last]
    return pairs[: last + 1], means[: last + 1], lengths[: last + 1]
