"""Where each object was, and what it was called: a row for each time in which neither changed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from deworldsg_ros.client.boxes import box_of
from deworldsg_ros.client.changes import MOVED_M, MOVED_PART
from deworldsg_ros.client.objects import Point
from deworldsg_ros.scene import wire

# End of a time that has not ended.
STILL_NS = 2**63 - 1


@dataclass(slots=True)
class Stay:
    """An object at one place, under one label.

    Attributes:
        key: number of this stay in the store.
        node: id of the object.
        label: most probable class.
        position_m: centre of the box; the mean of the surface if there is no box. World frame.
        size_m: of the box along its axes, the third one is up; 0 without a box.
        since_ns, until_ns: from when until when; `STILL_NS` = it is still there.
    """

    key: int
    node: int
    label: str
    position_m: Point
    size_m: Point
    since_ns: int
    until_ns: int = STILL_NS

    @property
    def is_current(self) -> bool:
        """Whether it has not ended."""
        return self.until_ns == STILL_NS

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; times in seconds, None = not ended."""
        return {
            "id": self.node,
            "label": self.label,
            "position_m": [round(value, 3) for value in self.position_m],
            "size_m": [round(value, 3) for value in self.size_m],
            "since_s": self.since_ns / 1e9,
            "until_s": None if self.is_current else self.until_ns / 1e9,
        }

    def is_left(self, node: wire.NodeState) -> bool:
        """Whether an object has moved or changed its label, as `deworldsg diff` decides."""
        if node.label != self.label:
            return True
        center, size = box_of(node)
        least = max(MOVED_M, MOVED_PART * max(*size, *self.size_m))
        x, y, z = (a - b for a, b in zip(center, self.position_m))
        return x * x + y * y + z * z > least * least


class History:
    """The stays of all objects, and what changed since `take`.

    Args:
        current: the stays that have not ended.
        next_key: number of the next stay.
    """

    def __init__(self, current: Iterable[Stay] = (), next_key: int = 1) -> None:
        self.current = {stay.node: stay for stay in current}
        self._next_key = next_key
        self._begun: dict[int, Stay] = {}
        self._ended: dict[int, int] = {}

    def see(self, node: wire.NodeState, stamp_ns: int) -> None:
        """Note an object at a time; times never go back."""
        stay = self.current.get(node.id)
        if stay is not None:
            if not stay.is_left(node):
                return
            self.end(node.id, stamp_ns)
        stay = Stay(self._next_key, node.id, node.label, *box_of(node), stamp_ns)
        self._next_key += 1
        self.current[node.id] = self._begun[stay.key] = stay

    def end(self, node_id: int, stamp_ns: int) -> None:
        """Note that an object is gone."""
        stay = self.current.pop(node_id, None)
        if stay is None:
            return
        if stay.key not in self._begun:
            self._ended[stay.key] = stamp_ns
        elif stay.since_ns == stamp_ns:
            del self._begun[stay.key]
        else:
            stay.until_ns = stamp_ns

    def take(self) -> tuple[list[Stay], dict[int, int]]:
        """The stays that began since the last call, and the ends of older ones by key."""
        taken = list(self._begun.values()), self._ended
        self._begun, self._ended = {}, {}
        return taken
