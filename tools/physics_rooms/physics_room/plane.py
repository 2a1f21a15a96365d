"""Rectangles and convex polygons in the floor plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from .shapes import Item, Part


@dataclass(frozen=True)
class Rect:
    """Rectangle with a yaw, and the heights between which it is solid. Metres, radians."""

    centre: NDArray[np.float64]
    half: NDArray[np.float64]
    yaw: float
    low: float = 0.0
    high: float = 3.0

    def axes(self) -> NDArray[np.float64]:
        """Its two directions as rows."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, s], [-s, c]])

    def corners(self) -> NDArray[np.float64]:
        """The four corners (4, 2), counter-clockwise."""
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
        return self.centre + (signs * self.half) @ self.axes()


def rects_clash(a: Rect, b: Rect, margin: float = 0.0) -> bool:
    """Whether two rectangles come closer than a margin, in the plane and in height."""
    if a.low >= b.high or b.low >= a.high:
        return False
    between = b.centre - a.centre
    for axis in np.concatenate([a.axes(), b.axes()]):
        reach = np.abs(a.axes() @ axis) @ a.half + np.abs(b.axes() @ axis) @ b.half
        if abs(between @ axis) >= reach + margin:
            return False
    return True


def yaw_of(rotation: NDArray[np.float64]) -> float:
    """Yaw of a rotation about z, or of the x axis's projection."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def rect_of(item: Item) -> Rect:
    """Footprint of an upright item with its heights."""
    low, high = item.bounds()
    middle = (low + high) / 2
    centre = item.position + item.rotation @ middle
    z = item.position[2]
    return Rect(centre[:2], (high - low)[:2] / 2, yaw_of(item.rotation), z + low[2], z + high[2])


def part_rects(item: Item) -> list[Rect]:
    """One rectangle per part that is solid, of an upright item."""
    return [_part_rect(item, part) for part in item.parts if part.collides]


def _part_rect(item: Item, part: Part) -> Rect:
    local = part.mesh.vertices
    low, high = local.min(0), local.max(0)
    centre = item.position + item.rotation @ ((low + high) / 2)
    z = item.position[2]
    return Rect(centre[:2], (high - low)[:2] / 2, yaw_of(item.rotation), z + low[2], z + high[2])


def hull(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convex hull (k, 2) of points (n, 2), counter-clockwise."""
    spread = points.max(0) - points.min(0)
    if spread.min() < 1e-6:
        points = points + np.array([[0, 0], [1e-5, 2e-5]])[np.arange(len(points)) % 2]
    return points[ConvexHull(points, qhull_options="QJ").vertices]


def clip(subject: NDArray[np.float64], window: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intersection of two convex polygons (k, 2); empty (0, 2) if there is none."""
    result = subject
    for a, b in zip(window, np.roll(window, -1, axis=0)):
        if not len(result):
            break
        edge = b - a
        side = edge[0] * (result[:, 1] - a[1]) - edge[1] * (result[:, 0] - a[0])
        kept = []
        for k in range(len(result)):
            n = (k + 1) % len(result)
            if side[k] >= 0:
                kept.append(result[k])
            if side[k] * side[n] < 0:
                kept.append(result[k] + (result[n] - result[k]) * side[k] / (side[k] - side[n]))
        result = np.array(kept).reshape(-1, 2)
    return result


def area(polygon: NDArray[np.float64]) -> float:
    """Area of a polygon (k, 2)."""
    if len(polygon) < 3:
        return 0.0
    x, y = polygon.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def gap(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[float, NDArray, NDArray]:
    """Distance of two convex polygons and the two nearest points; 0 where they overlap."""
    if len(clip(a, b)) >= 3:
        middle = clip(a, b).mean(0)
        return 0.0, middle, middle
    best = (np.inf, a[0], b[0])
    for first, second, swapped in ((a, b, False), (b, a, True)):
        start, edge = second, np.roll(second, -1, axis=0) - second
        length = np.maximum((edge**2).sum(1), 1e-12)
        offset = first[:, None] - start[None]
        t = np.clip((offset * edge).sum(2) / length, 0, 1)
        foot = start + t[..., None] * edge
        distance = np.linalg.norm(first[:, None] - foot, axis=2)
        i, j = np.unravel_index(distance.argmin(), distance.shape)
        if distance[i, j] < best[0]:
            pair = (first[i], foot[i, j])
            best = (float(distance[i, j]), *(pair[::-1] if swapped else pair))
    return best
