"""Pixels that represent the surface of each object, without those at the border of its mask."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float32, Int64, UInt16

# Depth within this distance of the border of a mask is often that of the surface behind, or a mean
# of both ("flying pixels").
BORDER_PX = 2
# A pixel is on one surface with its neighbours if it is off their mean by less than a + b z². The
# noise of depth cameras grows with the square of the depth.
SURFACE_STEP_M = 0.02
SURFACE_STEP_PER_M = 0.008
# An object is sampled from its inner pixels, unless fewer than this fraction of its pixels are
# inner ones: it is thin.
MIN_INNER_FRACTION = 0.1
# Number of pixels that are examined for one point.
CANDIDATES_PER_POINT = 3


@kernel
def _is_inner(
    depth_m: Float32, instances: UInt16, y: int, x: int, margin: int, step_m: float
) -> bool:
    """Whether a pixel lies inside its mask and on one surface with the pixels around it.

    All pixels within `margin` have its label. Along the row and along the column, its depth is
    within `step_m` of the mean of the two pixels at that distance: on a plane, however slanted, it
    equals their mean. A neighbour without depth, or outside the image, does not count.
    """
    height, width = instances.shape
    label = instances[y, x]
    for row in range(max(y - margin, 0), min(y + margin + 1, height)):
        for column in range(max(x - margin, 0), min(x + margin + 1, width)):
            if instances[row, column] != label:
                return False
    depth = depth_m[y, x]
    if margin <= y < height - margin:
        a, b = depth_m[y - margin, x], depth_m[y + margin, x]
        if a > 0 and b > 0 and abs(0.5 * (a + b) - depth) > step_m:
            return False
    if margin <= x < width - margin:
        a, b = depth_m[y, x - margin], depth_m[y, x + margin]
        if a > 0 and b > 0 and abs(0.5 * (a + b) - depth) > step_m:
            return False
    return True


@kernel
def sample_pixels(
    depth_m: Float32, instances: UInt16, count: int, most: int
) -> tuple[Int64, Int64]:
    """Pixels (k, 2) as row and column, and their object (k,) from 0, in the order of the objects.

    At most `most` pixels of an object, evenly spread in scan order. They are inner pixels
    (`_is_inner`), except for thin objects, which have hardly any.
    """
    height, width = instances.shape
    sizes = np.zeros(count, np.int64)
    for y in range(height):
        for x in range(width):
            label = instances[y, x]
            if 0 < label <= count and 0 < depth_m[y, x] < np.inf:
                sizes[label - 1] += 1
    # Only some pixels are examined, because examining all takes too long.
    quotas, ends, total = np.empty(count, np.int64), np.empty(count, np.int64), 0
    for row in range(count):
        quotas[row] = min(sizes[row], CANDIDATES_PER_POINT * most)
        total += int(quotas[row])
        ends[row] = total
    candidates, inner = np.empty((total, 2), np.int64), np.empty(total, np.bool_)
    seen, taken = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for y in range(height):
        for x in range(width):
            label = instances[y, x]
            if not (0 < label <= count and 0 < depth_m[y, x] < np.inf):
                continue
            row = label - 1
            # The n-th of `quota` samples is the first pixel past the fraction n / quota.
            if seen[row] * quotas[row] >= taken[row] * sizes[row]:
                slot = ends[row] - quotas[row] + taken[row]
                candidates[slot, 0], candidates[slot, 1] = y, x
                step_m = SURFACE_STEP_M + SURFACE_STEP_PER_M * depth_m[y, x] ** 2
                inner[slot] = _is_inner(depth_m, instances, y, x, BORDER_PX, step_m)
                taken[row] += 1
            seen[row] += 1
    pixels = np.empty((count * most, 2), np.int64)
    owners = np.empty(count * most, np.int64)
    end = 0
    for row in range(count):
        first = ends[row] - quotas[row]
        left = 0
        for slot in range(first, ends[row]):
            left += int(inner[slot])
        if left < MIN_INNER_FRACTION * quotas[row]:
            left = quotas[row]
            for slot in range(first, ends[row]):
                inner[slot] = True
        quota = min(left, most)
        passed = kept = 0
        for slot in range(first, ends[row]):
            if inner[slot]:
                if passed * quota >= kept * left:
                    pixels[end, 0], pixels[end, 1] = candidates[slot, 0], candidates[slot, 1]
                    owners[end] = row
                    end += 1
                    kept += 1
                passed += 1
    return pixels[:end], owners[:end]
