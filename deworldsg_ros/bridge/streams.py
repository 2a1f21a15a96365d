"""Bounded streams of stamped messages, and the loop that joins them in stamp order.

Time is an argument. What comes out depends on what came in on each stream, not on how the
streams were interleaved, as long as no buffer overflows and nothing times out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from deworldsg_ros.scene.errors import RefusedInput

T = TypeVar("T")
Out = TypeVar("Out")
OnDrop = Callable[[str, str, int], None]

# A stream that goes back by more than this has started again (a looped recording).
RESTART_NS = 10**9
# A stream that is silent for longer is named in the diagnostics.
SILENCE_NS = 2 * 10**9


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
        self.received = 0

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
        self.received += 1

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


class Assembler(ABC, Generic[T, Out]):
    """Joins a leading stream with what belongs to each of its items, in stamp order.

    Args:
        leader: the stream whose items become outputs.
        others: the further streams that an output needs.
        patience_s: how long an item may wait, by the `now_ns` given, for what it lacks.
        on_drop: called with the reason, the message and the number of every drop.

    Attributes:
        drops: number of drops by reason.
    """

    def __init__(
        self,
        leader: Stream[T],
        others: Sequence[Stream[Any]],
        *,
        patience_s: float,
        on_drop: OnDrop | None,
    ) -> None:
        self._leader = leader
        self._streams: list[Stream[Any]] = [leader, *others]
        self._patience_ns = int(patience_s * 1e9)
        self._on_drop = on_drop
        self._waiting_since_ns: dict[int, int] = {}
        self._started_ns: int | None = None
        self.drops: Counter[str] = Counter()

    @abstractmethod
    def _settled(self, stamp_ns: int, value: T) -> bool:
        """Whether nothing that is yet to come can change the output of this item."""

    @abstractmethod
    def _build(self, stamp_ns: int, value: T) -> Out:
        """The output of an item, from what is there; raises RefusedInput."""

    @abstractmethod
    def _forget(self, stamp_ns: int) -> None:
        """Drop what only outputs up to this stamp could need."""

    def _restart(self) -> None:
        """Forget everything after a jump back in time."""
        lost = sum(stream.clear() for stream in self._streams)
        self._waiting_since_ns.clear()
        self._drop("time_jump", f"stamps went back: starting again without {lost} messages")

    def pop_ready(self, now_ns: int | None) -> list[Out]:
        """What is complete, in stamp order; what waited for too long is decided as it stands.

        Args:
            now_ns: any clock that only goes forward; None = never give up waiting.
        """
        if now_ns is not None:
            self._note_time(now_ns)
        ready: list[Out] = []
        while len(self._leader):
            item = self._leader.first()
            if not (
                self._settled(item.stamp_ns, item.value)
                or self._leader.full
                or self._gave_up(item.stamp_ns, now_ns)
            ):
                break
            self._decide(ready)
        return ready

    def flush(self) -> list[Out]:
        """Decide everything that still waits, as it stands: nothing more will come."""
        ready: list[Out] = []
        while len(self._leader):
            self._decide(ready)
        return ready

    def waiting_for(self, now_ns: int) -> list[str]:
        """What is missing, in words: streams that are silent, stamps that never meet."""
        self._note_time(now_ns)
        assert self._started_ns is not None
        missing = [
            f"no {stream.name} on {stream.topic} for {silence_ns / 1e9:.0f} s"
            for stream in self._streams
            if (silence_ns := stream.silence_ns(now_ns, self._started_ns)) > SILENCE_NS
        ]
        return missing or self._stuck(now_ns)

    def _stuck(self, now_ns: int) -> list[str]:
        if not len(self._leader):
            return []
        stamp_ns = self._leader.first().stamp_ns
        if now_ns - self._waiting_since_ns.get(stamp_ns, now_ns) < self._patience_ns // 2:
            return []
        return [
            f"{self._leader.name} of {stamp_ns / 1e9:.3f} s waits for {stream.name}, whose newest "
            f"on {stream.topic} is of {stream.newest_ns / 1e9:.3f} s"
            for stream in self._streams
            if stream.newest_ns is not None and stream.newest_ns < stamp_ns
        ]

    def _note_time(self, now_ns: int) -> None:
        if self._started_ns is None:
            self._started_ns = now_ns
        for stream in self._streams:
            stream.silence_ns(now_ns, self._started_ns)
        for stamp_ns in self._leader.stamps_ns():
            self._waiting_since_ns.setdefault(stamp_ns, now_ns)

    def _gave_up(self, stamp_ns: int, now_ns: int | None) -> bool:
        if now_ns is None:
            return False
        return now_ns - self._waiting_since_ns.get(stamp_ns, now_ns) >= self._patience_ns

    def _decide(self, ready: list[Out]) -> None:
        item = self._leader.take()
        self._waiting_since_ns.pop(item.stamp_ns, None)
        try:
            ready.append(self._build(item.stamp_ns, item.value))
        except RefusedInput as refusal:
            self._drop(refusal.reason, str(refusal))
        self._forget(item.stamp_ns)

    def _add(self, stream: Stream[Any], stamp_ns: int, value: Any) -> None:
        """Keep an item; count it where it is refused, and what it pushes out."""
        if stream.restarts(stamp_ns):
            self._restart()
        try:
            lost = stream.add(stamp_ns, value)
        except RefusedInput as refusal:
            self._drop(refusal.reason, str(refusal))
            return
        self._drop_unmatched(stream, lost)

    def _drop_unmatched(self, stream: Stream[Any], number: int) -> None:
        self._drop(
            f"unmatched_{stream.name}",
            f"{stream.name} on {stream.topic} belongs to no {self._leader.name}",
            number,
        )

    def _drop(self, reason: str, message: str, number: int = 1) -> None:
        if number:
            self.drops[reason] += number
            if self._on_drop is not None:
                self._on_drop(reason, message, number)
