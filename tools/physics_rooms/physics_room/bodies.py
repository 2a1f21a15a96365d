"""Where the items of a room are: gaps, outlines and heights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .plane import area, clip, gap, hull
from .shapes import Item

# Things on a wall are above what is within this distance in front of them.
WALL_REACH_M = 0.15
# Two things closer than this have nothing between them.
TOUCHING_M = 0.015
# Boxes further apart than this have the gap of their boxes; exact would not matter.
FAR_M = 0.8


class Bodies:
    """Geometry of items at rest, from their visible parts.

    Attributes:
        points: corners (n, 3) of each item by number, frame of the room.
        low, high: lowest and highest corner (3,) by number.
    """

    def __init__(self, items: list[Item]) -> None:
        self.points = {item.number: item.vertices() for item in items}
        self.low = {n: p.min(0) for n, p in self.points.items()}
        self.high = {n: p.max(0) for n, p in self.points.items()}
        self._outlines = {item.number: _outlines(item) for item in items}

    def top(self, item: Item) -> float:
        """Highest z, m."""
        return float(self.high[item.number][2])

    def bottom(self, item: Item) -> float:
        """Lowest z, m."""
        return float(self.low[item.number][2])

    def side_by_side(self, a: Item, b: Item) -> tuple[float, float]:
        """Shared part of the shorter side, and the angle between the two, of boxes side by side."""
        best = (-np.inf, 0.0)
        for item in (a, b):
            axes = item.rotation[:2, :2].T
            for axis, other in ((axes[0], axes[1]), (axes[1], axes[0])):
                apart = self._shared(a, b, axis)
                if -apart[0] > best[0]:
                    along = self._shared(a, b, other)
                    best = (-apart[0], along[0] / max(along[1], 1e-6))
        angle = np.arctan2(*(a.rotation.T @ b.rotation)[[1, 0], [0, 0]])
        skew = abs((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        return best[1], float(skew)

    def _shared(self, a: Item, b: Item, axis: NDArray[np.float64]) -> tuple[float, float]:
        p, q = (self.points[i.number][:, :2] @ axis for i in (a, b))
        shared = min(p.max(), q.max()) - max(p.min(), q.min())
        return float(shared), float(min(np.ptp(p), np.ptp(q)))

    def overlap(self, a: Item, b: Item) -> float:
        """Overlap of the two footprints as a share of the smaller; walls reach 15 cm further."""
        p, q = self._footprint(a), self._footprint(b)
        return area(clip(p, q)) / max(min(area(p), area(q)), 1e-9)

    def _footprint(self, item: Item) -> NDArray[np.float64]:
        local = item.vertices(placed=False)
        if item.kind == "wallm" and item.label != "lamp":
            local = np.concatenate([local, local - [0, WALL_REACH_M, 0]])
        return hull((local @ item.rotation.T + item.position)[:, :2])

    def between(self, a: Item, b: Item, group: list[Item]) -> bool:
        """Whether a third item of the group, or one beside them, crosses the line between two."""
        distance, p, q = self.nearest(a, b)
        if distance < TOUCHING_M:
            return False
        line = np.array([p, q]) + (q - p)[None] / distance * [[0.004], [-0.004]]
        normal = np.array([-(q - p)[1], (q - p)[0]]) / distance * 0.002
        strip = np.array([line[0] - normal, line[1] - normal, line[1] + normal, line[0] + normal])
        top = min(self.top(a), self.top(b))
        low = max(self.bottom(a), self.bottom(b))
        for other in group:
            if other is a or other is b or self.top(other) < low + 0.25 * (top - low):
                continue
            if self.bottom(other) >= top:  # on a board above them
                continue
            if any(len(clip(strip, outline)) >= 3 for outline in self._outlines[other.number]):
                return True
        return False

    def apart(self, a: Item, b: Item) -> float:
        """Horizontal distance of the axis-aligned boxes, a lower bound of the gap."""
        apart = np.maximum(
            self.low[a.number] - self.high[b.number], self.low[b.number] - self.high[a.number]
        )
        return float(np.linalg.norm(np.maximum(apart[:2], 0)))

    def gap(self, a: Item, b: Item) -> float:
        """Horizontal gap between two items, m; 0 where one is over the other."""
        return self.nearest(a, b)[0] if self.apart(a, b) < FAR_M else self.apart(a, b)

    def nearest(self, a: Item, b: Item) -> tuple[float, NDArray, NDArray]:
        """Horizontal gap between the parts of two items, and its two ends."""
        pairs = [gap(p, q) for p in self._outlines[a.number] for q in self._outlines[b.number]]
        return min(pairs, key=lambda pair: pair[0])


def _outlines(item: Item) -> list[NDArray[np.float64]]:
    """Convex outline in the plane of each visible part, without leaves."""
    return [
        hull((part.mesh.vertices @ item.rotation.T + item.position)[:, :2])
        for part in item.parts
        if part.visible and not (item.label == "indoor-plant" and part.shape == "ellipsoid")
    ]
