"""What carries and what contains each item, from contacts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .bodies import Bodies
from .shapes import Item
from .simulate import WALL, Outcome

# Smallest share of a thing's weight that counts as a support.
MIN_SHARE = 0.12
# The normal of a support points upwards by at least this much.
MIN_UPWARD = 0.5
# The bottom of a thing in a container is this far below the rim.
MIN_DEPTH_M = 0.01


@dataclass
class Support:
    """One support of an item: share of the weight, mean normal, kind of contact."""

    number: int
    share: float
    normal: NDArray[np.float64]


class Holding:
    """Supports and containers of the items of a room at rest.

    Attributes:
        supports: of each item by number, heaviest first.
        container: the container of each item by number, or None.
    """

    def __init__(self, items: list[Item], outcome: Outcome, bodies: Bodies) -> None:
        self.items = items
        self.by_number = {item.number: item for item in items}
        self.outcome = outcome
        self.bodies = bodies
        self.supports = {item.number: self._supports(item) for item in items}
        self.container = {item.number: self._container(item) for item in items}

    def _supports(self, item: Item) -> list[Support]:
        if item.anchor != "free":
            return []
        found = []
        for (upper, lower), touch in self.outcome.touches.items():
            if upper == item.number and touch.lift > 0:
                normal = np.mean(touch.normals, axis=0)
                steep = max(n[2] for n in touch.normals)
                found.append((lower, touch.lift, normal, steep))
        total = sum(f[1] for f in found)
        shares = [
            Support(lower, lift / total, normal)
            for lower, lift, normal, steep in found
            if lift / total >= MIN_SHARE and steep >= MIN_UPWARD and lower != WALL
        ]
        return sorted(shares, key=lambda s: -s.share)

    def _container(self, item: Item) -> Item | None:
        """The container whose hollow holds the bottom of an item, if it also holds the item."""
        points = self.bodies.points[item.number]
        bottom = points[points[:, 2] < points[:, 2].min() + 0.01].mean(0)
        inside = [
            other for other in self.items
            if other is not item and self._holds(other, item) and _in_cavity(other, bottom)
        ]  # fmt: skip
        return min(
            inside,
            key=lambda o: float(np.prod(self.bodies.high[o.number] - self.bodies.low[o.number])),
            default=None,
        )

    def _holds(self, container: Item, item: Item) -> bool:
        """Whether contacts lead from an item down to a container, or it is welded into it."""
        if item.holder is container:
            return bool(container.cavities)
        seen, edge = set(), [item.number]
        while edge:
            number = edge.pop()
            for (upper, lower), touch in self.outcome.touches.items():
                if upper != number or lower in seen or touch.lift <= 0.005:
                    continue
                if lower == container.number:
                    return bool(container.cavities)
                if lower > 0 and self.by_number[lower].anchor == "free":
                    seen.add(lower)
                    edge.append(lower)
        return False


def _in_cavity(container: Item, point: NDArray[np.float64]) -> bool:
    local = container.rotation.T @ (point - container.position)
    for cavity in container.cavities:
        offset = local[:2] - cavity.centre
        if cavity.round:
            inside = np.linalg.norm(offset / cavity.half) <= 1.0
        else:
            inside = bool((np.abs(offset) <= cavity.half).all())
        if inside and cavity.low - 0.01 <= local[2] <= cavity.rim - MIN_DEPTH_M:
            return True
    return False
