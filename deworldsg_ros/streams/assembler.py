"""The loop that joins streams in stamp order.

Time is an argument. The output depends on the messages of each stream, not on how the streams are
interleaved, as long as no buffer overflows and no wait times out.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.clock_gate import jump_text
from deworldsg_ros.streams.stamped import Stream

T = TypeVar("T")
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
        admitted, lost_ns = stream.gate.admit(stamp_ns, value)
        if lost_ns is not None:
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
