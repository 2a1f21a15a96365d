"""A worker thread with a bounded queue, so that slow work does not block the executor."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Worker(Generic[T]):
    """Calls `work` with each item, in order, in its own thread.

    Args:
        name: thread name.
        work: must not raise.
        size: items that may wait.
        on_overrun: called with the oldest item when a new one replaces it.
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
        after: Callable[[], float | None] = lambda: None,
    ) -> None:
        self._work = work
        self._size = size
        self._on_overrun = on_overrun
        self._after = after
        self._items: deque[T] = deque()
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
        lost: list[T] = []
        with self._changed:
            if len(self._items) >= self._size:
                lost.append(self._items.popleft())
            self._items.append(item)
            self._changed.notify_all()
        for oldest in lost:
            self._on_overrun(oldest)

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
                self._changed.wait_for(lambda: self._items or self._stopping, wait_s)
                if self._stopping:
                    return
                items = [self._items.popleft()] if self._items else []
                self._busy = True
            for item in items:
                self._work(item)
            wait_s = self._after()
