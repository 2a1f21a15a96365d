"""Gravity-aligned boxes of objects: gaps between them, and what stands in a way.

Coordinates here are those of `horizontal_axes`: two horizontal ones and the height.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.wire import messages as wire

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Footprint:
    """A box seen from above.

    Attributes:
        corners: (4, 2) metres, in order around the rectangle.
        low, high: heights of bottom and top, metres.
    """

    corners: Float64
    low: float
    high: float

    @property
    def center(self) -> Float64:
        """Centre (2,) of the rectangle."""
        return np.asarray(self.corners.mean(axis=0))


def footprint(
    center_m: Sequence[float],
    size_m: Sequence[float],
    orientation_xyzw: Sequence[float],
    up: Sequence[float],
) -> Footprint:
    """The footprint of a box whose third axis is up; all arguments in the world frame."""
    axes = horizontal_axes(up)
    quat = np.array(orientation_xyzw, np.float64)
    rotation = pose_from_quaternion(np.zeros(3), quat / np.linalg.norm(quat))[:3, :3]
    half = np.array(size_m) / 2
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    offsets = signs * half[:2] @ rotation[:, :2].T
    corners = (np.array(center_m) + offsets) @ axes.T
    height = float(np.dot(axes[2], center_m))
    return Footprint(corners[:, :2], height - float(half[2]), height + float(half[2]))


def box_of(node: wire.NodeState) -> tuple[Triple, Triple]:
    """Centre and size of an object's box, metres, in microseconds.

    Without a box: the mean of its surface, and 0.
    """
    if isinstance(node.box, wire.GravityBox):
        (x, y, z), (a, b, c) = node.box.center_m, node.box.size_m
        return (x, y, z), (a, b, c)
    x, y, z = node.mean_m
    return (x, y, z), (0.0, 0.0, 0.0)


def radius_of(node: wire.NodeState) -> float:
    """A radius around the centre of `box_of`, metres; infinite if the message has no box."""
    if not isinstance(node.box, wire.GravityBox):
        return np.inf
    a, b, c = node.box.size_m
    # A little more, for the rounding of the exact distance.
    return 0.5 * (a * a + b * b + c * c) ** 0.5 + 1e-6


def horizontal_gap_m(a: Footprint, b: Footprint) -> float:
    """Horizontal distance of two boxes; 0 if they overlap seen from above."""
    return polygon_gap_m(a.corners, b.corners)


def vertical_gap_m(a: Footprint, b: Footprint) -> float:
    """Bottom of `a` above the top of `b`; negative if it is lower."""
    return a.low - b.high


def gap_m(a: Footprint, b: Footprint) -> float:
    """Distance of two boxes; 0 if they overlap."""
    vertical = max(a.low - b.high, b.low - a.high, 0.0)
    return float(np.hypot(horizontal_gap_m(a, b), vertical))


def polygon_gap_m(a: Float64, b: Float64) -> float:
    """Distance of two convex polygons, (n, 2) and (m, 2); 0 if they overlap."""
    if not _separated(a, b) and not _separated(b, a) and not _apart(a, b):
        return 0.0
    return min(_corner_gap_m(a, b), _corner_gap_m(b, a))


def point_gaps_m(point: Float64, polygons: Float64) -> Float64:
    """Distances (k,) of a point (2,) from convex polygons (k, n, 2), corners anticlockwise.

    Of a point for each polygon, (k, 1, 2), the distances from its own.
    """
    sides = np.roll(polygons, -1, axis=1) - polygons
    offsets = point - polygons
    # For each side, twice the area of the triangle with the point. Nothing is inside of a line.
    areas = sides[..., 0] * offsets[..., 1] - sides[..., 1] * offsets[..., 0]
    inside = (areas >= 0).all(axis=1) & (areas > 0).any(axis=1)
    lengths = np.maximum((sides**2).sum(axis=2), 1e-18)
    along = np.clip((offsets * sides).sum(axis=2) / lengths, 0.0, 1.0)
    rest = offsets - along[..., None] * sides
    gaps = np.sqrt((rest**2).sum(axis=2).min(axis=1))
    return np.where(inside, 0.0, gaps)


def _separated(a: Float64, b: Float64) -> bool:
    """Whether a side of `a` separates the polygons."""
    sides = np.roll(a, -1, axis=0) - a
    normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
    own, other = a @ normals.T, b @ normals.T
    return bool(((own.max(0) < other.min(0)) | (other.max(0) < own.min(0))).any())


def _apart(a: Float64, b: Float64) -> bool:
    """Whether boxes without width that no side separates are apart, one behind the other."""
    if not (_is_flat(a) and _is_flat(b)):
        return False
    along = b.mean(axis=0) - a.mean(axis=0)
    return bool((a @ along).max() < (b @ along).min())


def _is_flat(polygon: Float64) -> bool:
    """Whether all corners are on one line."""
    spokes = polygon[1:] - polygon[0]
    areas = spokes[:-1, 0] * spokes[1:, 1] - spokes[:-1, 1] * spokes[1:, 0]
    return not areas.any()


def _corner_gap_m(a: Float64, b: Float64) -> float:
    """Smallest distance of a corner of `a` from a side of `b`."""
    sides = np.roll(b, -1, axis=0) - b
    lengths = np.maximum((sides**2).sum(axis=1), 1e-18)
    offsets = a[:, None] - b[None]
    along = np.clip((offsets * sides).sum(axis=2) / lengths, 0.0, 1.0)
    rest = offsets - along[..., None] * sides
    return float(np.sqrt((rest**2).sum(axis=2).min()))
