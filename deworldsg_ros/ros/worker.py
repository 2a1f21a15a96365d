"""A worker thread with a bounded queue, so that slow work does not block the executor."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

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
            for item in items:
                self._work(item)
            wait_s = self._after()
            if wait_s is not None:
                wait_s = min(wait_s, MAX_WAIT_S)

    def _take(self) -> tuple[list[T], list[T]]:
        """The waiting items that are dropped, and the next one."""
        late = []
        if time.monotonic() - self._rested_s > self._max_busy_s:
            while len(self._items) > 1:
                late.append(self._items.popleft()[0])
        return late, [self._items.popleft()[0]] if self._items else []
