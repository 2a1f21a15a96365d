"""Threads of a node: a bounded queue for slow work, repeated calls, and when updates are due."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from deworldsg_ros.ros.node import StageNode

# --- A thread that calls a function again and again, for work that waits for others.


class Repeating:
    """Calls a function every `period_s`; exceptions are counted by the node.

    Args:
        node: counts.
        function: may block; the next call waits for it.
        period_s: from the end of one call to the start of the next.
    """

    def __init__(self, node: StageNode, function: Callable[[], None], period_s: float) -> None:
        self._node, self._function, self._period_s = node, function, period_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while not self._stop.wait(self._period_s):
            with self._node.refusing():
                self._function()


# --- When changes of the graph are published: at once, and at most at a rate.

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


# --- A worker thread with a bounded queue, so that slow work does not block the executor.

T = TypeVar("T")

# A condition cannot wait for more than 2^63 ns; after this time `after` is asked again.
MAX_WAIT_S = 3600.0


class Worker(Generic[T]):
    """Calls `work` with each item, in order, in its own thread.

    Args:
        name: thread name.
        work: must not raise.
        size: items that may wait.
        on_overrun: called with each item that is dropped: the oldest, when a new one replaces it.
        max_busy_s: a worker without a pause for longer does not keep up: it works on the newest
            item, and drops the others.
        after: called after each item, and again when the seconds that it returned have passed;
            None = only after the next item. It must not raise.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[T], None],
        *,
        size: int,
        on_overrun: Callable[[T], None],
        max_busy_s: float = math.inf,
        after: Callable[[], float | None] = lambda: None,
    ) -> None:
        self._work = work
        self._size = size
        self._on_overrun = on_overrun
        self._after = after
        self._max_busy_s = max_busy_s
        self._rested_s = time.monotonic()  # the end of the last pause
        self._finished_s = math.inf
        self._items: deque[tuple[T, float]] = deque()  # with the time of `submit`
        self._changed = threading.Condition()
        self._stopping = False
        self._busy = False
        # A daemon, so that endless work cannot keep the process alive.
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Number of waiting items."""
        return len(self._items)

    def submit(self, item: T) -> None:
        """Queue an item; does not block."""
        now_s = time.monotonic()
        with self._changed:
            lost = [self._items.popleft()[0]] if len(self._items) >= self._size else []
            self._items.append((item, now_s))
            self._changed.notify_all()
        for oldest in lost:
            self._on_overrun(oldest)

    def finish(self) -> None:
        """Call this inside `work`, just before the result of the item is published.

        Items that are submitted after it do not make waiting items late. A replay sends its next
        frame when it gets a result, perhaps before this thread runs again; no frame is lost then.
        """
        self._finished_s = time.monotonic()

    def youngest_s(self) -> float:
        """When the newest waiting item was submitted, monotonic clock; 0 = none waits."""
        with self._changed:
            return self._items[-1][1] if self._items else 0.0

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until nothing is queued or processed; False on timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._items or self._busy), timeout_s)

    def stop(self, timeout_s: float = 5.0) -> bool:
        """Drop queued items and finish the current one; False on timeout."""
        with self._changed:
            self._stopping = True
            self._items.clear()
            self._changed.notify_all()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        wait_s: float | None = None
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                if not self._items:
                    self._changed.wait_for(lambda: self._items or self._stopping, wait_s)
                    self._rested_s = time.monotonic()
                if self._stopping:
                    return
                late, items = self._take()
                self._busy = True
            for item in late:
                self._on_overrun(item)
            self._finished_s = math.inf
            for item in items:
                self._work(item)
            wait_s = self._after()
            if wait_s is not None:
                wait_s = min(wait_s, MAX_WAIT_S)

    def _take(self) -> tuple[list[T], list[T]]:
        """The waiting items that are dropped, and the next one."""
        late = []
        if time.monotonic() - self._rested_s > self._max_busy_s:
            while len(self._items) > 1 and self._items[1][1] <= self._finished_s:
                late.append(self._items.popleft()[0])
        return late, [self._items.popleft()[0]] if self._items else []
