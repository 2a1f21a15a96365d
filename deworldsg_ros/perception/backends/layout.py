"""Metric layout of the objects of one frame: bounds in an upright frame, and pairwise distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.base.kernels import kernel, read_only
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt16
from deworldsg_ros.scene.camera import Intrinsics

# --- The surface beneath the bottom edge of each object, as the image shows it.

# Depth at the border of a mask is unreliable: it is read this far from it, on either side.
BORDER_PX = 2
# The surface beneath is looked for within this distance of the edge.
REACH_PX = 6
# The border of a mask is its bottom edge where it is at most this far above the object's lowest
# points. The surface beneath is at most this far from them in height: depth noise and the slope of
# a few pixels.
HEIGHT_M = 0.06
# A surface that is nearer by more than this hides the bottom; one that is farther is behind it.
DEPTH_STEP_M = 0.15
# A shorter visible edge may not be representative.
MIN_EDGE_PX = 5


def surfaces_beneath(
    depth_m: Float32,
    intrinsics: Intrinsics,
    instances: UInt16,
    up_camera: Float64,
    low_m: Float64,
) -> Float64:
    """Fraction (n, n) of the bottom edge of i below which, in the image, a surface of j continues.

    A support is in contact with the bottom of an object. Below the object's bottom edge the image
    therefore shows the support, at the same height and depth.

    Args:
        depth_m: (H, W) float32, metres; 0 = invalid.
        intrinsics: of the depth.
        instances: (H, W) uint16, k = k-th object.
        up_camera: (3,) unit vector against gravity, camera frame.
        low_m: (n,) height of the lowest points of the objects 1..n, metres above the camera.

    Returns:
        Row i is NaN if hardly any of the bottom edge of i is visible.
    """
    # A pixel (u, v) at depth z is z (a u + b v + c) above the camera.
    a, b = up_camera[0] / intrinsics.fx, up_camera[1] / intrinsics.fy
    height = np.array([a, b, up_camera[2] - a * intrinsics.cx - b * intrinsics.cy])
    return _surfaces_beneath(
        read_only(depth_m),
        read_only(instances),
        height,
        _down_in_image(up_camera),
        np.ascontiguousarray(low_m),
    )


def _down_in_image(up_camera: Float64) -> tuple[int, int]:
    """The step in rows and columns, of one pixel, that is nearest to the downward direction."""
    if abs(up_camera[1]) >= abs(up_camera[0]):
        return (-1, 0) if up_camera[1] > 0 else (1, 0)
    return (0, -1) if up_camera[0] > 0 else (0, 1)


@kernel
def _surfaces_beneath(
    depth_m: Float32,
    instances: UInt16,
    height: Float64,
    down: tuple[int, int],
    low_m: Float64,
) -> Float64:
    """`surfaces_beneath`, for the height coefficients and the downward step of the image."""
    rows, columns = instances.shape
    count = len(low_m)
    edge = np.zeros(count, np.float64)
    beneath = np.zeros((count, count), np.float64)
    # Both ends of a step from inside the mask to the surface beneath are inside the image.
    margin_v, margin_u = REACH_PX * abs(down[0]), REACH_PX * abs(down[1])
    for v in range(margin_v, rows - margin_v):
        for u in range(margin_u, columns - margin_u):
            label = instances[v, u]
            if not 0 < label <= count or instances[v + down[0], u + down[1]] == label:
                continue
            y, x = v - BORDER_PX * down[0], u - BORDER_PX * down[1]
            z, low = depth_m[y, x], low_m[label - 1]
            inside = instances[y, x] == label and z > 0
            if not inside or z * (height[0] * x + height[1] * y + height[2]) > low + HEIGHT_M:
                continue
            # The first pixel below the edge with depth that is not of the same object.
            other, other_z = label, z
            for step in range(1 + BORDER_PX, 1 + REACH_PX):
                y, x = v + step * down[0], u + step * down[1]
                if instances[y, x] != label and depth_m[y, x] > 0:
                    other, other_z = instances[y, x], depth_m[y, x]
                    break
            if other == label or other_z < z - DEPTH_STEP_M:
                continue  # something in front hides the bottom
            edge[label - 1] += 1.0
            rise = other_z * (height[0] * x + height[1] * y + height[2])
            level = abs(rise - low) < HEIGHT_M
            if level and other_z < z + DEPTH_STEP_M and 0 < other <= count:
                beneath[label - 1, other - 1] += 1.0
    for row in range(count):
        for other in range(count):
            beneath[row, other] /= edge[row] if edge[row] >= MIN_EDGE_PX else np.nan
    return beneath


# --- Pixels that represent the surface of each object, without those at the border of its mask.

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
def _is_inner(depth_m: Float32, instances: UInt16, y: int, x: int, step_m: float) -> bool:
    """Whether a pixel lies inside its mask and on one surface with the pixels around it.

    All pixels within `BORDER_PX` have its label. Along the row and along the column, its depth is
    within `step_m` of the mean of the two pixels at that distance: on a plane, however slanted, it
    equals their mean. A neighbour without depth, or outside the image, does not count.
    """
    height, width = instances.shape
    label = instances[y, x]
    for row in range(max(y - BORDER_PX, 0), min(y + BORDER_PX + 1, height)):
        for column in range(max(x - BORDER_PX, 0), min(x + BORDER_PX + 1, width)):
            if instances[row, column] != label:
                return False
    depth = depth_m[y, x]
    if BORDER_PX <= y < height - BORDER_PX:
        a, b = depth_m[y - BORDER_PX, x], depth_m[y + BORDER_PX, x]
        if a > 0 and b > 0 and abs(0.5 * (a + b) - depth) > step_m:
            return False
    if BORDER_PX <= x < width - BORDER_PX:
        a, b = depth_m[y, x - BORDER_PX], depth_m[y, x + BORDER_PX]
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
                inner[slot] = _is_inner(depth_m, instances, y, x, step_m)
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


# --- Metric layout of the objects of one frame: bounds in an upright frame, and pairwise
# distances.

# The bounds are quantiles, which more points hardly change; the time grows with the points.
POINTS_PER_OBJECT = 256
# The bounds of an object with fewer points are not reliable.
MIN_POINTS = 10
# Bounds leave out this fraction of the points at either end, because of flying pixels.
OUTLIER_FRACTION = 0.04
# An object rests on a surface within this horizontal distance of its own bounds.
SUPPORT_MARGIN_M = 0.08
# The camera sees only the front of furniture; its footprint extends this far behind it.
HIDDEN_DEPTH_M = 0.15


# Extents are measured in horizontal directions every 22.5 degrees, and in height. The first and
# the fifth direction are axes 0 and 1.
_ANGLES = np.arange(8) * np.pi / 8.0
_DIRECTIONS = np.array([[*np.cos(_ANGLES), 0.0], [*np.sin(_ANGLES), 0.0], [*np.zeros(8), 1.0]])
_AXES = [0, 4, 8]


@dataclass(frozen=True)
class Layout:
    """Metric layout of n objects; axes 0 and 1 are horizontal, 2 is up.

    In (n, n) arrays the row is object i and the column is object j.

    Attributes:
        valid: (n,) bool, has enough points.
        low, high: (n, 3) metres, robust bounds.
        contact_m: (n, n) vertical distance from the bottom of i to the nearest surface of j below
            or around i; inf if j has none there.
        beneath: (n, n) fraction of the bottom edge of i with a surface of j beneath it, in the
            image; NaN if the edge is not visible (`surfaces_beneath`).
        shared: (n, n) overlap of the footprints, as a fraction of the smaller one: of all
            horizontal directions, the least overlap of the two extents.
        shared_deep: (n, n) the same for footprints that are extended by the hidden depth.
        covered: (n, n) fraction of the footprint of i inside that of j, by the same measure.
        covered_deep: (n, n) the same for a footprint of j that is extended by the hidden depth.
        gap_m: (n, n) horizontal distance: of all directions, the greatest gap between the two
            extents; 0 if they overlap.
        clearance_m: (n, n) height of the bottom of i over the top of j; negative if it is lower.
    """

    valid: Bool
    low: Float64
    high: Float64
    contact_m: Float64
    beneath: Float64
    shared: Float64
    shared_deep: Float64
    covered: Float64
    covered_deep: Float64
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
    axes = upright_axes(up_camera)
    pixels, owners = sample_pixels(
        read_only(depth_m), read_only(instances), count, POINTS_PER_OBJECT
    )
    v, u = pixels[:, 0], pixels[:, 1]
    z = depth_m[v, u].astype(np.float64)
    points = intrinsics.back_project(u, v, z) @ axes.T
    low, high, valid = _bounds(points @ _DIRECTIONS, owners, count)
    # The border that the sampling leaves out, at the mean depth of the object.
    border_m = BORDER_PX / intrinsics.fx * _means(z, owners, count)[:, None]
    low, high = low - border_m, high + border_m
    seen = low[:, :-1], high[:, :-1]
    deep = seen[0] - HIDDEN_DEPTH_M, seen[1] + HIDDEN_DEPTH_M
    overlap_m, deep_overlap_m = _overlaps(seen, seen), _overlaps(deep, deep)
    length_m, deep_length_m = _lengths(seen), _lengths(deep)
    low, high = low[:, _AXES], high[:, _AXES]
    return Layout(
        valid=valid,
        low=low,
        high=high,
        # Contiguous: a kernel is compiled for one layout.
        contact_m=_contacts(
            points, owners, np.ascontiguousarray(low), np.ascontiguousarray(high), valid
        ),
        beneath=surfaces_beneath(depth_m, intrinsics, instances, axes[2], low[:, 2]),
        shared=_fraction(overlap_m, np.minimum(length_m[:, None], length_m[None])),
        shared_deep=_fraction(
            deep_overlap_m, np.minimum(deep_length_m[:, None], deep_length_m[None])
        ),
        covered=_fraction(overlap_m, length_m[:, None]),
        covered_deep=_fraction(_overlaps(seen, deep), length_m[:, None]),
        gap_m=np.clip(-overlap_m.min(axis=2), 0.0, None),
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


def _bounds(points: Float64, owners: Int64, count: int) -> tuple[Float64, Float64, Bool]:
    """Robust bounds (count, d) of each object's points, 0 if it has too few; (count,) has enough.

    Args:
        points: (k, d) positions in d directions, the vertical one last, metres.
        owners: (k,) ascending object of each point.
        count: number of objects.
    """
    low, high = np.zeros((2, count, points.shape[1]))
    starts = np.searchsorted(owners, np.arange(count + 1))
    valid = np.diff(starts) >= MIN_POINTS
    for row in np.flatnonzero(valid):
        own = np.sort(points[starts[row] : starts[row + 1]], axis=0)
        low[row] = own[round(OUTLIER_FRACTION * (len(own) - 1))]
        high[row] = own[round((1.0 - OUTLIER_FRACTION) * (len(own) - 1))]
        # Give back the part of an evenly covered surface that the quantiles cut off. Not in
        # height: most visible points of a plate or a table are at one height.
        width = high[row, :-1] - low[row, :-1]
        trimmed = width * OUTLIER_FRACTION / (1.0 - 2.0 * OUTLIER_FRACTION)
        low[row, :-1] -= trimmed
        high[row, :-1] += trimmed
    return low, high, valid


def _means(values: Float64, owners: Int64, count: int) -> Float64:
    """Mean (count,) of the values of each object; 0 without any."""
    sums = np.bincount(owners, values, minlength=count)
    return np.asarray(sums / np.maximum(np.bincount(owners, minlength=count), 1))


_Extents = tuple[Float64, Float64]


def _lengths(extents: _Extents) -> Float64:
    """Lengths (n, d) of extents, low and high (n, d); not 0, which keeps fractions finite."""
    return np.asarray(np.maximum(extents[1] - extents[0], 1e-3))


def _overlaps(a: _Extents, b: _Extents) -> Float64:
    """Overlap (n, n, d) of the extents of each pair; negative = the gap between them."""
    return np.asarray(np.minimum(a[1][:, None], b[1][None]) - np.maximum(a[0][:, None], b[0][None]))


def _fraction(overlap_m: Float64, length_m: Float64) -> Float64:
    """The least (n, n) of the fractions (n, n, d), at least 0."""
    return np.asarray(np.clip((overlap_m / length_m).min(axis=2), 0.0, None))


@kernel
def _contacts(points: Float64, owners: Int64, low: Float64, high: Float64, valid: Bool) -> Float64:
    """`Layout.contact_m`."""
    count = len(low)
    contact = np.empty((count, count), np.float64)
    for row in range(count):
        for other in range(count):
            contact[row, other] = np.inf
        if not valid[row]:
            continue
        left, right = low[row, 0] - SUPPORT_MARGIN_M, high[row, 0] + SUPPORT_MARGIN_M
        front, back = low[row, 1] - SUPPORT_MARGIN_M, high[row, 1] + SUPPORT_MARGIN_M
        for index in range(len(points)):
            x, y, z = points[index, 0], points[index, 1], points[index, 2]
            if owners[index] != row and left < x < right and front < y < back:
                distance = abs(z - low[row, 2])
                contact[row, owners[index]] = min(contact[row, owners[index]], distance)
    return contact
