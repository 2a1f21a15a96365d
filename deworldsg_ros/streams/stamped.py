"""Bounded streams of stamped messages, read by stamp."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from deworldsg_ros.scene.errors import RefusedInput

T = TypeVar("T")

# A stream that goes back by more than this has started again (a looped recording).
RESTART_NS = 10**9


@dataclass
class _Item(Generic[T]):
    stamp_ns: int
    value: T
    used: bool = False


class Stream(Generic[T]):
    """The newest items of one topic, in stamp order.

    Args:
        name: what it carries, as the diagnostics call it.
        topic: where it comes from.
        capacity: items kept.
    """

    def __init__(self, name: str, topic: str, capacity: int) -> None:
        self.name = name
        self.topic = topic
        self._capacity = capacity
        self._items: deque[_Item[T]] = deque()
        self.newest_ns: int | None = None
        self._fresh = False
        self._heard_ns: int | None = None

    def __len__(self) -> int:
        return len(self._items)

    def add(self, stamp_ns: int, value: T) -> int:
        """Keep an item; returns how many unused ones had to go for it.

        Raises:
            RefusedInput: ``stale`` for a stamp that is not after the one before.
        """
        self.heard()
        if self.newest_ns is not None and stamp_ns <= self.newest_ns:
            raise RefusedInput(
                "stale",
                f"{self.name} of {stamp_ns / 1e9:.3f} s came after that of "
                f"{self.newest_ns / 1e9:.3f} s: wanted increasing stamps",
            )
        self.newest_ns = stamp_ns
        self._items.append(_Item(stamp_ns, value))
        lost = 0
        while len(self._items) > self._capacity:
            lost += not self._items.popleft().used
        return lost

    def heard(self) -> None:
        """Note that a message came, good or bad."""
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
        """Whether the next item would push one out."""
        return len(self._items) >= self._capacity

    def settled(self, stamp_ns: int) -> bool:
        """Whether an item that is yet to come cannot be nearer to this stamp."""
        return self.newest_ns is not None and self.newest_ns >= stamp_ns

    def nearest(self, stamp_ns: int, slop_ns: int) -> T:
        """The item nearest to a stamp; of two equally near, the earlier.

        Raises:
            RefusedInput: ``no_<name>`` where none is within the slop.
        """
        best = min(self._items, key=lambda item: abs(item.stamp_ns - stamp_ns), default=None)
        if best is None or abs(best.stamp_ns - stamp_ns) > slop_ns:
            gap = "there is none" if best is None else _gap(best.stamp_ns, stamp_ns)
            raise RefusedInput(
                f"no_{self.name}",
                f"frame at {stamp_ns / 1e9:.3f} s has no {self.name}: {gap}, wanted one within "
                f"{slop_ns / 1e9:g} s",
            )
        best.used = True
        return best.value

    def forget_before(self, stamp_ns: int) -> int:
        """Drop older items; returns how many were never used."""
        lost = 0
        while self._items and self._items[0].stamp_ns < stamp_ns:
            lost += not self._items.popleft().used
        return lost

    def clear(self) -> int:
        """Start again; returns how many items were never used."""
        lost = sum(not item.used for item in self._items)
        self._items.clear()
        self.newest_ns = None
        return lost

    def restarts(self, stamp_ns: int) -> bool:
        """Whether this stamp lies so far back that the stream has started again."""
        return self.newest_ns is not None and stamp_ns < self.newest_ns - RESTART_NS

    def silence_ns(self, now_ns: int, since_ns: int) -> int:
        """How long nothing came until now, counted from `since_ns` if nothing ever came."""
        if self._fresh:
            self._fresh = False
            self._heard_ns = now_ns
        return now_ns - (since_ns if self._heard_ns is None else self._heard_ns)


def _gap(a_ns: int, b_ns: int) -> str:
    return f"the nearest is {abs(a_ns - b_ns) / 1e9:.3f} s away"
