"""Metric layout of the objects of one frame: bounds in an upright frame, and pairwise distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.kernels import kernel, read_only
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt16
from deworldsg_ros.scene.camera import Intrinsics

# The bounds are quantiles, which more points hardly change; the time grows with the points.
POINTS_PER_OBJECT = 256
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
# The bounds of an object with fewer points are not reliable.
MIN_POINTS = 10
# Bounds leave out this fraction of the points at either end, because of flying pixels.
OUTLIER_FRACTION = 0.04
# An object rests on a surface within this horizontal distance of its own bounds.
SUPPORT_MARGIN_M = 0.08
# The camera sees only the front of furniture; its footprint extends this far behind it.
HIDDEN_DEPTH_M = 0.15


@dataclass(frozen=True)
class Layout:
    """Metric layout of n objects; axes 0 and 1 are horizontal, 2 is up.

    In (n, n) arrays the row is object i and the column is object j.

    Attributes:
        valid: (n,) bool, has enough points.
        low, high: (n, 3) metres, robust bounds.
        contact_m: (n, n) vertical distance from the bottom of i to the nearest surface of j below
            or around i; inf if j has none there.
        shared: (n, n) overlap of the footprints, as a fraction of the smaller one.
        shared_deep: (n, n) the same for footprints that are extended by the hidden depth.
        covered: (n, n) fraction of the footprint of i inside that of j.
        gap_m: (n, n) horizontal distance between the bounds; 0 if they overlap.
        clearance_m: (n, n) height of the bottom of i over the top of j; negative if it is lower.
    """

    valid: Bool
    low: Float64
    high: Float64
    contact_m: Float64
    shared: Float64
    shared_deep: Float64
    covered: Float64
    gap_m: Float64
    clearance_m: Float64


def measure_layout(
    depth_m: Float32, intrinsics: Intrinsics, instances: UInt16, count: int, up_camera: Float64
) -> Layout:
    """Layout of the objects 1..count of an instance image.

    Args:
        depth_m: (H, W) float32, metres; 0 = invalid.
        intrinsics: of the depth.
        instances: (H, W) uint16.
        count: number of objects.
        up_camera: (3,) unit vector against gravity, camera frame.
    """
    pixels, owners = _sample(read_only(depth_m), read_only(instances), count, POINTS_PER_OBJECT)
    v, u = pixels[:, 0], pixels[:, 1]
    z = depth_m[v, u].astype(np.float64)
    points = intrinsics.back_project(u, v, z) @ upright_axes(up_camera).T
    low, high, valid = _bounds(points, owners, count)
    # The border that the sampling leaves out, at the mean depth of the object.
    border_m = BORDER_PX / intrinsics.fx * _means(z, owners, count)[:, None]
    low, high = low - border_m, high + border_m
    separation = np.clip(
        np.maximum(low[:, None], low[None]) - np.minimum(high[:, None], high[None]), 0.0, None
    )
    area, shared = _footprints(low[:, :2], high[:, :2])
    area = np.maximum(area, 1e-6)  # keeps fractions of a footprint finite
    deep, deep_shared = _footprints(low[:, :2] - HIDDEN_DEPTH_M, high[:, :2] + HIDDEN_DEPTH_M)
    return Layout(
        valid=valid,
        low=low,
        high=high,
        contact_m=_contacts(points, owners, low, high, valid),
        shared=shared / np.minimum(area[:, None], area[None]),
        shared_deep=deep_shared / np.minimum(deep[:, None], deep[None]),
        covered=shared / area[:, None],
        gap_m=np.hypot(separation[..., 0], separation[..., 1]),
        clearance_m=low[:, None, 2] - high[None, :, 2],
    )


def upright_axes(up_camera: Float64) -> Float64:
    """Rotation (3, 3) from the camera frame to a frame whose axis 2 is up."""
    up = np.asarray(up_camera, dtype=np.float64) / np.linalg.norm(up_camera)
    # Axis 1 is the viewing direction, made horizontal. A camera that looks straight up or down
    # has none; then axis 1 is the image's downward direction.
    forward = np.array([0.0, 0.0, 1.0])
    if abs(up[2]) > 0.95:
        forward = np.array([0.0, 1.0, 0.0])
    forward = forward - (forward @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(forward, up), forward, up])


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
def _sample(depth_m: Float32, instances: UInt16, count: int, most: int) -> tuple[Int64, Int64]:
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
    quotas = np.minimum(sizes, CANDIDATES_PER_POINT * most)
    ends = np.cumsum(quotas)
    candidates = np.empty((ends[-1], 2), np.int64)
    inner = np.empty(ends[-1], np.bool_)
    seen = np.zeros(count, np.int64)
    taken = np.zeros(count, np.int64)
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
        usable = inner[first : ends[row]]
        if usable.sum() < MIN_INNER_FRACTION * quotas[row]:
            usable[:] = True
        left = usable.sum()
        quota = min(left, most)
        passed = kept = 0
        for slot in range(first, ends[row]):
            if inner[slot]:
                if passed * quota >= kept * left:
                    pixels[end], owners[end] = candidates[slot], row
                    end += 1
                    kept += 1
                passed += 1
    return pixels[:end], owners[:end]


def _bounds(points: Float64, owners: Int64, count: int) -> tuple[Float64, Float64, Bool]:
    """Robust bounds (count, 3) of each object's points, 0 if it has too few; (count,) has enough.

    Args:
        points: (k, 3) upright frame, metres.
        owners: (k,) ascending object of each point.
        count: number of objects.
    """
    low, high = np.zeros((count, 3)), np.zeros((count, 3))
    starts = np.searchsorted(owners, np.arange(count + 1))
    valid = np.diff(starts) >= MIN_POINTS
    for row in np.flatnonzero(valid):
        own = np.sort(points[starts[row] : starts[row + 1]], axis=0)
        low[row] = own[round(OUTLIER_FRACTION * (len(own) - 1))]
        high[row] = own[round((1.0 - OUTLIER_FRACTION) * (len(own) - 1))]
        # Give back the part of an evenly covered surface that the quantiles cut off. Not in
        # height: most visible points of a plate or a table are at one height.
        width = high[row, :2] - low[row, :2]
        trimmed = width * OUTLIER_FRACTION / (1.0 - 2.0 * OUTLIER_FRACTION)
        low[row, :2] -= trimmed
        high[row, :2] += trimmed
    return low, high, valid


def _means(values: Float64, owners: Int64, count: int) -> Float64:
    """Mean (count,) of the values of each object; 0 without any."""
    sums = np.bincount(owners, values, minlength=count)
    return np.asarray(sums / np.maximum(np.bincount(owners, minlength=count), 1))


def _footprints(low: Float64, high: Float64) -> tuple[Float64, Float64]:
    """Areas (n,) of rectangles with corners (n, 2), and areas (n, n) that two have in common."""
    sides = np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None])
    return (high - low).prod(axis=1), np.clip(sides, 0.0, None).prod(axis=2)


@kernel
def _contacts(points: Float64, owners: Int64, low: Float64, high: Float64, valid: Bool) -> Float64:
    """`Layout.contact_m`."""
    count = len(low)
    contact = np.full((count, count), np.inf)
    for row in range(count):
        if not valid[row]:
            continue
        left, right = low[row, 0] - SUPPORT_MARGIN_M, high[row, 0] + SUPPORT_MARGIN_M
        front, back = low[row, 1] - SUPPORT_MARGIN_M, high[row, 1] + SUPPORT_MARGIN_M
        for index in range(len(points)):
            x, y, z = points[index]
            if owners[index] != row and left < x < right and front < y < back:
                distance = abs(z - low[row, 2])
                contact[row, owners[index]] = min(contact[row, owners[index]], distance)
    return contact
