"""Buffer of one stream of stamped messages, read by stamp."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.limits import RESTART_NS
from deworldsg_ros.streams.clock_gate import ClockGate

T = TypeVar("T")


@dataclass
class _Item(Generic[T]):
    stamp_ns: int
    value: T
    used: bool = False


class Stream(Generic[T]):
    """The newest items of one topic, in stamp order.

    Args:
        name: content of the stream, for the diagnostics.
        topic: topic of the stream, for the diagnostics.
        capacity: maximum number of items.

    Attributes:
        newest_ns: stamp of the newest item so far; None before the first.
        gate: holds back an item whose stamp jumps; for the owner of the stream to ask.
    """

    def __init__(self, name: str, topic: str, capacity: int) -> None:
        self.name = name
        self.topic = topic
        self._capacity = capacity
        self._items: deque[_Item[T]] = deque()
        self.newest_ns: int | None = None
        self.gate: ClockGate[T] = ClockGate()
        self._fresh = False
        self._heard_ns: int | None = None

    def __len__(self) -> int:
        return len(self._items)

    def add(self, stamp_ns: int, value: T) -> int:
        """Keep an item; returns the number of unused items that it displaces.

        Raises:
            RefusedInput: ``stale`` for a stamp that is not after the last one.
        """
        self.heard()
        if self.newest_ns is not None and stamp_ns <= self.newest_ns:
            raise RefusedInput(
                "stale",
                f"{self.name} at {stamp_ns / 1e9:.3f} s arrived after that at "
                f"{self.newest_ns / 1e9:.3f} s: expected increasing stamps",
            )
        self.newest_ns = stamp_ns
        self._items.append(_Item(stamp_ns, value))
        lost = 0
        while len(self._items) > self._capacity:
            lost += not self._items.popleft().used
        return lost

    def heard(self) -> None:
        """Note that a message arrived, valid or not."""
        self._fresh = True

    def first(self) -> _Item[T]:
        """The oldest item."""
        return self._items[0]

    def take(self) -> _Item[T]:
        """Remove and return the oldest item."""
        return self._items.popleft()

    def stamps_ns(self) -> Iterator[int]:
        """Stamps of the items, oldest first."""
        return (item.stamp_ns for item in self._items)

    def exact(self, stamp_ns: int) -> T:
        """The item with this stamp; raises RefusedInput ``no_<name>``."""
        return self.nearest(stamp_ns, 0)

    @property
    def full(self) -> bool:
        """Whether the next item displaces the oldest."""
        return len(self._items) >= self._capacity

    def settled(self, stamp_ns: int) -> bool:
        """Whether later items cannot be nearer to this stamp."""
        return self.newest_ns is not None and self.newest_ns >= stamp_ns

    def nearest(self, stamp_ns: int, slop_ns: int) -> T:
        """The item nearest to a stamp; of two equally near, the earlier.

        Raises:
            RefusedInput: ``no_<name>`` if none is within the slop.
        """
        best = min(self._items, key=lambda item: abs(item.stamp_ns - stamp_ns), default=None)
        if best is None or abs(best.stamp_ns - stamp_ns) > slop_ns:
            gap = "there is none" if best is None else _gap(best.stamp_ns, stamp_ns)
            raise RefusedInput(
                f"no_{self.name}",
                f"frame at {stamp_ns / 1e9:.3f} s has no {self.name}: {gap}, expected one within "
                f"{slop_ns / 1e9:g} s",
            )
        best.used = True
        return best.value

    def forget_before(self, stamp_ns: int) -> int:
        """Drop items before this stamp; returns the number of unused ones."""
        lost = 0
        while self._items and self._items[0].stamp_ns < stamp_ns:
            lost += not self._items.popleft().used
        return lost

    def clear(self) -> int:
        """Drop all items and accept any stamp; returns the number of unused items."""
        lost = sum(not item.used for item in self._items)
        self._items.clear()
        self.newest_ns = None
        return lost

    def restarts(self, stamp_ns: int) -> bool:
        """Whether this stamp is so far back that the stream has restarted."""
        return self.newest_ns is not None and stamp_ns < self.newest_ns - RESTART_NS

    def silence_ns(self, now_ns: int, since_ns: int) -> int:
        """Nanoseconds since the last message; before the first message, since `since_ns`."""
        if self._fresh:
            self._fresh = False
            self._heard_ns = now_ns
        return now_ns - (since_ns if self._heard_ns is None else self._heard_ns)


def _gap(a_ns: int, b_ns: int) -> str:
    return f"the nearest is {abs(a_ns - b_ns) / 1e9:.3f} s away"
