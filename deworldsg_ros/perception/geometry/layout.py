"""Where the objects of a frame are, relative to each other and to gravity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.kernels import kernel, read_only
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt16
from deworldsg_ros.scene.camera import Intrinsics

POINTS_PER_OBJECT = 256
# An object of fewer points with depth has no place.
MIN_POINTS = 10
# Bounds leave out this share of the points at either end: a few flying pixels must not stretch an
# object.
LOW_SHARE = 0.04
# The surface an object rests on is looked for within this distance of its own outline.
SUPPORT_MARGIN_M = 0.08
# Of a cabinet one sees the front: its footprint goes on behind it.
HIDDEN_DEPTH_M = 0.15


@dataclass(frozen=True)
class Layout:
    """Metric layout of n objects; axes 0 and 1 are horizontal, 2 is up.

    Attributes:
        valid: (n,) bool, has enough points.
        low, high: (n, 3) metres, robust bounds.
        contact_m: (n, n) distance in height from the bottom of i to the nearest surface of j
            below or around i; inf where j has nothing there.
        above_share: (n, n) share of the smaller footprint that the footprints of i and j share.
        deep_share: the same, with every footprint grown by the depth that cannot be seen.
        gap_m: (n, n) horizontal distance between the bounds; 0 where they overlap.
        clearance_m: (n, n) height of the bottom of i over the top of j; negative = overlap.
        covered: (n, n) share of the footprint of i that lies inside that of j.
    """

    valid: Bool
    low: Float64
    high: Float64
    contact_m: Float64
    above_share: Float64
    deep_share: Float64
    gap_m: Float64
    clearance_m: Float64
    covered: Float64


def measure_layout(
    depth_m: Float32,
    intrinsics: Intrinsics,
    instances: UInt16,
    count: int,
    up_camera: Float64,
) -> Layout:
    """The layout of the objects 1..count of a label image.

    Args:
        depth_m: (H, W) metres; 0 = invalid.
        intrinsics: of the depth.
        instances: (H, W) uint16 labels.
        count: number of objects.
        up_camera: (3,) unit vector against gravity, camera frame.
    """
    pixels, owners = _sample(read_only(depth_m), read_only(instances), count, POINTS_PER_OBJECT)
    v, u = pixels[:, 0], pixels[:, 1]
    z = depth_m[v, u].astype(np.float64)
    x, y = (u - intrinsics.cx) / intrinsics.fx * z, (v - intrinsics.cy) / intrinsics.fy * z
    points = np.stack([x, y, z], axis=1) @ upright_axes(up_camera).T
    low, high = np.zeros((count, 3)), np.zeros((count, 3))
    starts = np.searchsorted(owners, np.arange(count + 1))
    valid = np.diff(starts) >= MIN_POINTS
    for row in np.flatnonzero(valid):
        own = np.sort(points[starts[row] : starts[row + 1]], axis=0)
        low[row] = own[round(LOW_SHARE * (len(own) - 1))]
        high[row] = own[round((1.0 - LOW_SHARE) * (len(own) - 1))]
        # What this cuts off an evenly covered surface, given back. Not in height: most of what
        # one sees of a plate or a table is at one height.
        trimmed = (high[row, :2] - low[row, :2]) * LOW_SHARE / (1.0 - 2.0 * LOW_SHARE)
        low[row, :2] -= trimmed
        high[row, :2] += trimmed
    overlap = np.clip(
        np.minimum(high[:, None], high[None]) - np.maximum(low[:, None], low[None]), 0.0, None
    )
    separation = np.clip(
        np.maximum(low[:, None], low[None]) - np.minimum(high[:, None], high[None]), 0.0, None
    )
    deep_low, deep_high = low[:, :2] - HIDDEN_DEPTH_M, high[:, :2] + HIDDEN_DEPTH_M
    deep = (deep_high - deep_low).prod(axis=1)
    deep_shared = np.clip(
        np.minimum(deep_high[:, None], deep_high[None])
        - np.maximum(deep_low[:, None], deep_low[None]),
        0.0,
        None,
    ).prod(axis=2)
    footprint = np.maximum((high - low)[:, :2].prod(axis=1), 1e-6)
    shared = overlap[..., :2].prod(axis=2)
    return Layout(
        valid=valid,
        low=low,
        high=high,
        contact_m=_contacts(points, owners, low, high, valid, count),
        above_share=shared / np.minimum(footprint[:, None], footprint[None]),
        deep_share=deep_shared / np.minimum(deep[:, None], deep[None]),
        gap_m=np.hypot(separation[..., 0], separation[..., 1]),
        clearance_m=low[:, None, 2] - high[None, :, 2],
        covered=shared / footprint[:, None],
    )


def upright_axes(up_camera: Float64) -> Float64:
    """Rotation (3, 3) from the camera frame into one whose third axis is up."""
    up = np.asarray(up_camera, dtype=np.float64) / np.linalg.norm(up_camera)
    # The viewing direction, levelled; the image's downward axis where the camera looks along up.
    forward = np.array([0.0, 0.0, 1.0])
    if abs(up[2]) > 0.95:
        forward = np.array([0.0, 1.0, 0.0])
    forward = forward - (forward @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(forward, up), forward, up])


@kernel
def _sample(depth_m: Float32, instances: UInt16, count: int, most: int) -> tuple[Int64, Int64]:
    """Pixels (k, 2) as row, column, and the row of their object, in the order of the objects.

    Of an object with many pixels, `most` that are evenly spread in scan order.
    """
    height, width = instances.shape
    sizes = np.zeros(count, np.int64)
    for y in range(height):
        for x in range(width):
            label = instances[y, x]
            if 0 < label <= count and 0 < depth_m[y, x] < np.inf:
                sizes[label - 1] += 1
    ends = np.cumsum(np.minimum(sizes, most))
    pixels = np.empty((ends[-1], 2), np.int64)
    owners = np.empty(ends[-1], np.int64)
    seen = np.zeros(count, np.int64)
    taken = np.zeros(count, np.int64)
    for y in range(height):
        for x in range(width):
            label = instances[y, x]
            if not (0 < label <= count and 0 < depth_m[y, x] < np.inf):
                continue
            row = label - 1
            share = min(sizes[row], most)
            # The n-th of `share` is the first pixel beyond n / share of the object.
            if seen[row] * share >= taken[row] * sizes[row]:
                place = ends[row] - share + taken[row]
                pixels[place, 0], pixels[place, 1] = y, x
                owners[place] = row
                taken[row] += 1
            seen[row] += 1
    return pixels, owners


def _contacts(
    points: Float64,
    owners: Int64,
    low: Float64,
    high: Float64,
    valid: Bool,
    count: int,
) -> Float64:
    contact = np.full((count, count), np.inf)
    for row in np.flatnonzero(valid):
        around = (
            (points[:, :2] > low[row, :2] - SUPPORT_MARGIN_M)
            & (points[:, :2] < high[row, :2] + SUPPORT_MARGIN_M)
        ).all(axis=1)
        distance = np.abs(points[around, 2] - low[row, 2])
        np.minimum.at(contact[row], owners[around], distance)
        contact[row, row] = np.inf
    return contact
