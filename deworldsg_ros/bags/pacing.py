"""When the next message of a replay is due: its pace, and how far ahead of its readers it may run.

Nothing here sleeps or reads a clock; times are arguments.
"""

from __future__ import annotations

from collections import deque

NANOSECONDS = 10**9


class Pace:
    """Recorded times to due times.

    Args:
        rate: 1 = as recorded, 2 = twice as fast, 0 = no waiting.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._log_zero_ns: int | None = None
        self._zero_s = 0.0

    def due_s(self, log_time_ns: int, now_s: float) -> float:
        """When a message is due; the first is due now."""
        if self._rate <= 0:
            return now_s
        if self._log_zero_ns is None:
            self._log_zero_ns, self._zero_s = log_time_ns, now_s
        return self._zero_s + (log_time_ns - self._log_zero_ns) / NANOSECONDS / self._rate

    def late(self, by_s: float) -> None:
        """Shift what is still to come: after a pause it goes on at its pace, not in a rush."""
        self._zero_s += by_s


class Window:
    """Frames that are published and not yet answered; at most `size` of them.

    An answer to a frame answers all before it, for frames are worked on in order. A frame that is
    refused on its way never has an answer of its own: `excused` takes the number of those.

    Args:
        size: most frames in flight; 0 = no limit.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._in_flight: deque[int] = deque()
        self._excused = 0
        self.answered = 0
        self.given_up = 0

    @property
    def in_flight(self) -> int:
        """Frames that may still be answered."""
        return max(0, len(self._in_flight) - self._excused)

    @property
    def is_full(self) -> bool:
        """Whether the next frame has to wait."""
        return self._size > 0 and self.in_flight >= self._size

    def publish(self, stamp_ns: int) -> None:
        """A frame goes out."""
        self._in_flight.append(stamp_ns)

    def answer(self, stamp_ns: int) -> None:
        """A frame came back, and with it those before."""
        self.answered += 1
        while self._in_flight and self._in_flight[0] <= stamp_ns:
            self._in_flight.popleft()
        self._excused = 0

    def excuse(self, number: int) -> None:
        """So many frames were refused, and will not be answered."""
        self._excused = min(self._excused + number, len(self._in_flight))

    def give_up(self) -> None:
        """Nobody answers: stop waiting for what is in flight."""
        self.given_up += self.in_flight
        self._in_flight.clear()
        self._excused = 0
