"""The loop that joins streams in stamp order, and the buffers that it reads."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import RelationEvidence
from deworldsg_ros.scene.limits import RESTART_NS
from deworldsg_ros.streams.poses import ClockGate, jump_text

# --- Buffer of one stream of stamped messages, read by stamp.

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


# --- Relation evidence that arrives before its local graph.


class PendingEvidence:
    """A bounded buffer of relation evidence; the oldest is dropped first.

    Args:
        capacity: maximum number of messages.
        most_bytes: of the predictions of all messages, when there are two or more.
    """

    def __init__(self, capacity: int = 256, most_bytes: int = 1 << 26) -> None:
        self._capacity, self._most_bytes = capacity, most_bytes
        self._waiting: deque[RelationEvidence] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, evidence: RelationEvidence) -> None:
        """Keep a message until `take`.

        Raises:
            RefusedInput: ``unmatched_evidence`` for the oldest message, if the buffer is full.
        """
        self._waiting.append(evidence)
        size = sum(item.predictions.nbytes for item in self._waiting)
        many = len(self._waiting) > self._capacity
        if many or (size > self._most_bytes and len(self._waiting) > 1):
            oldest = self._waiting.popleft()
            raise RefusedInput(
                "unmatched_evidence",
                f"relation evidence at {oldest.stamp_ns / 1e9:.3f} s: no local graph of this "
                f"stamp arrived during {len(self._waiting)} later messages. Check lifting_node",
            )

    def clear(self) -> int:
        """Drop all messages, after a jump of the clock; returns their number."""
        count = len(self._waiting)
        self._waiting.clear()
        return count

    def take(self, stamp_ns: int) -> list[RelationEvidence]:
        """Remove and return the messages with this stamp, in order of arrival; drop older ones."""
        taken = [evidence for evidence in self._waiting if evidence.stamp_ns == stamp_ns]
        self._waiting = deque(item for item in self._waiting if item.stamp_ns > stamp_ns)
        return taken


# --- The loop that joins streams in stamp order.
#
# Time is an argument. The output depends on the messages of each stream, not on how the streams are
# interleaved, as long as no buffer overflows and no wait times out.

Out = TypeVar("Out")
OnDrop = Callable[[str, str, int], None]

# Diagnostics name a stream that is silent for longer: twenty frames at 10 Hz.
SILENCE_NS = 2 * 10**9


class Assembler(ABC, Generic[T, Out]):
    """Joins each item of a leading stream with the items of other streams, in stamp order.

    Args:
        leader: the stream whose items become outputs.
        others: the further streams that an output needs.
        max_wait_s: maximum time, by the `now_ns` given, that an item waits for the other streams.
        on_drop: called with the reason, a message and the number of items of each drop.

    Attributes:
        drops: number of dropped items by reason.
    """

    def __init__(
        self,
        leader: Stream[T],
        others: Sequence[Stream[Any]],
        *,
        max_wait_s: float,
        on_drop: OnDrop | None,
    ) -> None:
        self._leader = leader
        self._streams: list[Stream[Any]] = [leader, *others]
        self._max_wait_ns = int(max_wait_s * 1e9)
        self._on_drop = on_drop
        self._waiting_since_ns: dict[int, int] = {}
        self._started_ns: int | None = None
        self.drops: Counter[str] = Counter()

    @abstractmethod
    def _settled(self, stamp_ns: int, value: T) -> bool:
        """Whether the output of this item is final: later messages cannot change it."""

    @abstractmethod
    def _build(self, stamp_ns: int, value: T) -> Callable[[], Out]:
        """A function that decodes the output of an item; both raise RefusedInput.

        The messages are chosen now; decoding them is left to the function.
        """

    @abstractmethod
    def _forget(self, stamp_ns: int) -> None:
        """Drop buffered items that only outputs up to this stamp need."""

    def _restart(self, stamp_ns: int) -> None:
        """Clear the streams after a jump back in time to this stamp.

        Streams jump one after the other: messages of the new time that arrived already stay.
        """
        lost = sum(stream.clear() for stream in self._streams if stream.restarts(stamp_ns))
        self._waiting_since_ns.clear()
        self._drop("time_jump", f"stamps went back: {lost} buffered messages are dropped")

    @property
    def waiting(self) -> int:
        """Number of items of the leading stream that wait for the others."""
        return len(self._leader)

    def pop_ready(self, now_ns: int | None) -> list[Out]:
        """Complete outputs in stamp order, decoded; see `pop_joined`."""
        return self._decoded(self.pop_joined(now_ns))

    def pop_joined(self, now_ns: int | None) -> list[Callable[[], Out]]:
        """Complete outputs in stamp order, as functions that decode them; they raise RefusedInput.

        An item that waited too long is decided as it is.

        Args:
            now_ns: time of any monotonic clock; None = wait without a limit.
        """
        if now_ns is not None:
            self._note_time(now_ns)
        ready: list[Callable[[], Out]] = []
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
        """Decide all waiting items as they are: the streams have ended."""
        for stream in reversed(self._streams):  # the leader last
            for stamp_ns, item in stream.gate.release():
                self._take(stream, stamp_ns, item)
        ready: list[Callable[[], Out]] = []
        while len(self._leader):
            self._decide(ready)
        return self._decoded(ready)

    def waiting_for(self, now_ns: int) -> list[str]:
        """Missing input, in words: silent streams, or streams whose stamps lag behind."""
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
        if now_ns - self._waiting_since_ns.get(stamp_ns, now_ns) < self._max_wait_ns // 2:
            return []
        return [
            f"{self._leader.name} at {stamp_ns / 1e9:.3f} s waits for {stream.name}: the newest on "
            f"{stream.topic} is at {stream.newest_ns / 1e9:.3f} s"
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
        return now_ns - self._waiting_since_ns.get(stamp_ns, now_ns) >= self._max_wait_ns

    def _decoded(self, joined: list[Callable[[], Out]]) -> list[Out]:
        outputs: list[Out] = []
        for decode in joined:
            try:
                outputs.append(decode())
            except RefusedInput as refusal:
                self._drop(refusal.reason, str(refusal))
        return outputs

    def _decide(self, ready: list[Callable[[], Out]]) -> None:
        item = self._leader.take()
        self._waiting_since_ns.pop(item.stamp_ns, None)
        try:
            ready.append(self._build(item.stamp_ns, item.value))
        except RefusedInput as refusal:
            self._drop(refusal.reason, str(refusal))
        self._forget(item.stamp_ns)

    def _add(self, stream: Stream[Any], stamp_ns: int, value: Any) -> None:
        """Take an item; it is held back if its stamp jumps."""
        stream.heard()
        admitted, lost = stream.gate.admit(stamp_ns, value)
        for lost_ns in lost:
            self._drop("time_jump", jump_text(stream.name, lost_ns, stream.gate.max_step_ns))
        for at_ns, item in admitted:
            self._take(stream, at_ns, item)

    def _take(self, stream: Stream[Any], stamp_ns: int, value: Any) -> None:
        """Buffer an item; count it if it is refused, and the items that it displaces."""
        if stream.restarts(stamp_ns):
            self._restart(stamp_ns)
        try:
            lost = stream.add(stamp_ns, value)
        except RefusedInput as refusal:
            self._drop(refusal.reason, str(refusal))
            return
        self._drop_unmatched(stream, lost)

    def _drop_unmatched(self, stream: Stream[Any], number: int) -> None:
        self._drop(
            f"unmatched_{stream.name}",
            f"{stream.name} on {stream.topic} matches no {self._leader.name}",
            number,
        )

    def _drop(self, reason: str, message: str, number: int = 1) -> None:
        if number:
            self.drops[reason] += number
            if self._on_drop is not None:
                self._on_drop(reason, message, number)
