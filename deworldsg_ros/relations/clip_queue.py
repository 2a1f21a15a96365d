"""The clips that wait for the world model: bounded, best first."""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.relations.clips import CropBox
from deworldsg_ros.scene.frame_graph import Vocabulary

Float64 = NDArray[np.float64]
Order = tuple[float, ...]


@dataclass(frozen=True)
class QueuedClip:
    """A neighbour pair of one frame whose clip may be encoded; it holds no pixels.

    Attributes:
        stamp_ns: frame in which both objects were last seen.
        frame_stamps_ns: the clip's frames, oldest first, ending with that one.
        crop_xyxy: union box of that frame.
        vocabulary: of the frame's local graph.
        rows: rows of the two objects in that local graph, the smaller first.
        classes: their classes.
        boxes_xyxy: their boxes, each (4,) float64 pixels of the image.
        geo_cost: the cost of Eq. 8.
    """

    stamp_ns: int
    frame_stamps_ns: tuple[int, ...]
    crop_xyxy: CropBox
    vocabulary: Vocabulary
    rows: tuple[int, int]
    classes: tuple[int, int]
    boxes_xyxy: tuple[Float64, Float64]
    geo_cost: float


def newest_first(item: QueuedClip) -> Order:
    """The greatest is encoded first, the least is dropped first: newest frame, nearest pair."""
    return (item.stamp_ns, -item.geo_cost, -item.rows[0], -item.rows[1])


class ClipQueue:
    """At most `size` clips in the order of a function; nothing else decides."""

    def __init__(self, size: int, order: Callable[[QueuedClip], Order] = newest_first) -> None:
        if size < 1:
            raise ValueError(f"queue of {size} clips: wanted at least 1")
        self.size = size
        self._order = order
        self._items: list[QueuedClip] = []

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: QueuedClip) -> QueuedClip | None:
        """Add a clip; where the queue is full, returns the one that was dropped for it."""
        insort(self._items, item, key=self._order)
        return self._items.pop(0) if len(self._items) > self.size else None

    def pop(self) -> QueuedClip | None:
        """Take the first clip; None where the queue is empty."""
        return self._items.pop() if self._items else None

    def clear(self) -> int:
        """Drop everything; returns how many there were."""
        count = len(self._items)
        self._items.clear()
        return count
