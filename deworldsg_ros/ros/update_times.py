"""When changes of the graph are published: at once, and at most at a rate."""

from __future__ import annotations

# The clocks of cameras and computers differ by less. A camera at the maximum rate is thus not
# slowed; without this, each of its frames would wait for the next slot after a while.
RATE_SLACK = 1.1


class UpdateTimes:
    """Limits the mean rate of updates; single ones may come early, because frames jitter.

    A change that can wait goes with the next one that cannot, if that comes within two periods: the
    evidence of a frame follows its local graph after milliseconds, and would take the place of the
    next frame.

    Args:
        rate_hz: maximum mean rate.
    """

    def __init__(self, rate_hz: float) -> None:
        self.limit(rate_hz)
        # Generic cell rate algorithm, with a tolerance of one period: updates on schedule would be
        # published up to this time.
        self._booked_s = 0.0
        self._due_s: float | None = None
        self._since_s = 0.0

    def limit(self, rate_hz: float) -> None:
        """Use another maximum rate from now on."""
        self._period_s = 1.0 / (RATE_SLACK * rate_hz)

    def changed(self, since_s: float, now_s: float, *, can_wait: bool = False) -> None:
        """Note a change whose cause arrived at `since_s`."""
        due_s = max(now_s, self._booked_s - self._period_s)
        if can_wait:
            due_s += 2 * self._period_s
        if self._due_s is None:
            self._due_s, self._since_s = due_s, since_s
        self._due_s = min(self._due_s, due_s)

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until the changes are due, 0 = now; None if nothing has changed."""
        return None if self._due_s is None else max(0.0, self._due_s - now_s)

    def taken(self) -> float:
        """Note that all changes are taken; returns when the cause of the first arrived."""
        self._due_s = None
        return self._since_s

    def book(self, now_s: float) -> None:
        """Note that an update is published."""
        self._booked_s = max(self._booked_s, now_s) + self._period_s
