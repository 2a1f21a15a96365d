"""Metric layout of the objects of one frame: bounds in an upright frame, and pairwise distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.kernels import kernel, read_only
from deworldsg_ros.perception.geometry.bottom_edge import surfaces_beneath
from deworldsg_ros.perception.geometry.sampling import BORDER_PX, sample_pixels
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt16
from deworldsg_ros.scene.camera import Intrinsics

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
