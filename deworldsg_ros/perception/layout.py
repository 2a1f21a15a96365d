"""Where the objects of a frame are, relative to each other and to gravity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import Float64

POINTS_PER_OBJECT = 256
# An object of fewer points with depth has no place.
MIN_POINTS = 10
# Bounds are these percentiles: a few flying pixels must not stretch an object.
LOW_PERCENT, HIGH_PERCENT = 4.0, 96.0
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

    valid: NDArray[np.bool_]
    low: Float64
    high: Float64
    contact_m: Float64
    above_share: Float64
    deep_share: Float64
    gap_m: Float64
    clearance_m: Float64
    covered: Float64


def measure_layout(
    depth_m: NDArray[np.float32],
    intrinsics: Intrinsics,
    instances: NDArray[np.uint16],
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
    points, owners = _sample(depth_m, intrinsics, instances, count, upright_axes(up_camera))
    low, high = np.zeros((count, 3)), np.zeros((count, 3))
    starts = np.searchsorted(owners, np.arange(count + 1))
    valid = np.diff(starts) >= MIN_POINTS
    for row in np.flatnonzero(valid):
        own = points[starts[row] : starts[row + 1]]
        low[row], high[row] = np.percentile(own, [LOW_PERCENT, HIGH_PERCENT], axis=0)
        # What the percentiles cut off an evenly covered surface, given back. Not in height: most
        # of what one sees of a plate or a table is at one height.
        trimmed = (high[row, :2] - low[row, :2]) * LOW_PERCENT / (HIGH_PERCENT - LOW_PERCENT)
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


def _sample(
    depth_m: NDArray[np.float32],
    intrinsics: Intrinsics,
    instances: NDArray[np.uint16],
    count: int,
    axes: Float64,
) -> tuple[Float64, NDArray[np.int64]]:
    """Points (k, 3) in upright axes and the row of their object, in the order of the rows."""
    rows, columns = np.nonzero(instances)
    labels = instances[rows, columns].astype(np.int64) - 1
    z = depth_m[rows, columns]
    usable = (z > 0) & (labels < count)
    rows, columns, labels, z = rows[usable], columns[usable], labels[usable], z[usable]
    order = np.argsort(labels, kind="stable")
    sizes = np.bincount(labels, minlength=count)
    ends = np.cumsum(sizes)
    chosen = np.concatenate(
        [np.zeros(0, np.int64)]
        + [
            np.linspace(end - size, end - 1, min(size, POINTS_PER_OBJECT)).astype(np.int64)
            for size, end in zip(sizes, ends, strict=True)
            if size
        ]
    )
    picked = order[chosen]
    u, v, z = columns[picked], rows[picked], z[picked].astype(np.float64)
    camera = np.stack(
        [(u - intrinsics.cx) / intrinsics.fx * z, (v - intrinsics.cy) / intrinsics.fy * z, z],
        axis=1,
    )
    return camera @ axes.T, labels[picked]


def _contacts(
    points: Float64,
    owners: NDArray[np.int64],
    low: Float64,
    high: Float64,
    valid: NDArray[np.bool_],
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
