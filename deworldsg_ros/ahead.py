"""Work ahead of its use, in threads: bounded, in order, and ended with its consumer."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

# A reader that waits for its consumer looks this often whether there still is one, seconds.
POLL_S = 0.1


def read_ahead(items: Iterable[Item], count: int) -> Iterator[Item]:
    """The items, read by a thread, at most `count` before they are taken.

    An error of `items` is raised after the items before it. If the iteration is closed, the thread
    ends after the item that it reads.
    """
    found: queue.Queue[tuple[Item] | BaseException | None] = queue.Queue(count)
    ended = threading.Event()

    def hand_over(entry: tuple[Item] | BaseException | None) -> bool:
        while not ended.is_set():
            try:
                found.put(entry, timeout=POLL_S)
            except queue.Full:
                continue
            return True
        return False

    def read() -> None:
        try:
            for item in items:
                if not hand_over((item,)):
                    return
        except BaseException as error:  # raised where the items are used
            hand_over(error)
        else:
            hand_over(None)

    reader = threading.Thread(target=read, name="read_ahead", daemon=True)
    reader.start()
    try:
        while (entry := found.get()) is not None:
            if isinstance(entry, BaseException):
                raise entry
            yield entry[0]
    finally:
        ended.set()
        reader.join()


def apply_ahead(
    function: Callable[[Item], Result], items: Iterable[Item], threads: int
) -> Iterator[tuple[Item, Future[Result]]]:
    """Each item with the future result of a function of it, in order.

    The function runs in `threads` threads, for as many items besides the one that is in use, and
    one more. If the iteration is closed, items that wait are not started.
    """
    with ThreadPoolExecutor(threads, thread_name_prefix="apply_ahead") as pool:
        running: deque[tuple[Item, Future[Result]]] = deque()
        try:
            for item in items:
                running.append((item, pool.submit(function, item)))
                if len(running) > threads + 1:
                    yield running.popleft()
            while running:
                yield running.popleft()
        finally:
            for _, future in running:
                future.cancel()
