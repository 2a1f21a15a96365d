"""When the next message of a replay is due: its pace, and how far ahead of its readers it may run.

Nothing here sleeps or reads a clock; times are arguments.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection

from deworldsg_ros.recordings.messages import Role

NANOSECONDS = 10**9
# Frames that may go out before what they wait for: half of what the nodes keep.
MOST_UNDECIDED = 32


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
    refused on its way never has an answer of its own: `excuse` takes the number of those, which is
    told at any time, before or after the answer to a later frame.

    Nobody can answer a frame before the recording has passed its stamp on every stream that it
    needs: it may lack a pose, or have one that was recorded later. Until then it is not in flight.

    Args:
        size: most frames in flight; 0 = no limit.
        needs: the streams that a frame needs.
    """

    def __init__(self, size: int, needs: Collection[Role] = ()) -> None:
        self._size = size
        self._newest_ns = dict.fromkeys(needs, -1)
        self._undecided: deque[int] = deque()
        self._in_flight: deque[int] = deque()
        # Refused frames that are told of and not yet behind an answer; below 0 the other way round.
        self._excused = 0
        self.answered = 0
        self.given_up = 0

    @property
    def in_flight(self) -> int:
        """Frames that may still be answered."""
        return max(0, len(self._in_flight) - max(0, self._excused))

    @property
    def is_full(self) -> bool:
        """Whether the next frame has to wait."""
        return self._size > 0 and self.in_flight >= self._size

    def publish(self, stamp_ns: int) -> None:
        """A frame goes out."""
        self._undecided.append(stamp_ns)
        self._decide()

    def passed(self, role: Role, stamp_ns: int) -> None:
        """A message of another stream goes out."""
        if role in self._newest_ns:
            self._newest_ns[role] = stamp_ns
            self._decide()

    def close(self) -> None:
        """Nothing more goes out: all that is undecided is now decided as it stands."""
        self._in_flight += self._undecided
        self._undecided.clear()

    def answer(self, stamp_ns: int) -> None:
        """A frame came back, and with it those before."""
        self.answered += 1
        behind = 0
        for frames in (self._in_flight, self._undecided):
            while frames and frames[0] <= stamp_ns:
                frames.popleft()
                behind += 1
        self._excused -= max(0, behind - 1)
        self._settle()

    def excuse(self, number: int) -> None:
        """So many frames were refused, and will not be answered."""
        self._excused += number
        self._settle()

    def give_up(self) -> None:
        """Nobody answers: stop waiting for what is in flight."""
        self.given_up += self.in_flight
        self._in_flight.clear()
        self._settle()

    def _settle(self) -> None:
        # Messages that were refused and are no frames, and frames that were lost without a word,
        # are not carried on.
        if not self._in_flight and not self._undecided:
            self._excused = 0

    def _decide(self) -> None:
        passed_ns = min(self._newest_ns.values(), default=None)
        while self._undecided and (
            passed_ns is None
            or self._undecided[0] <= passed_ns
            or len(self._undecided) > MOST_UNDECIDED
        ):
            self._in_flight.append(self._undecided.popleft())
