"""Races that are forced: threads change places every microsecond."""

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def beside(*functions: Callable[[], Any]) -> Iterator[None]:
    """Call functions again and again, each in its own thread, while the block runs.

    The block is left with the first exception of a function.
    """
    stop = threading.Event()
    errors: list[BaseException] = []

    def run(function: Callable[[], Any]) -> None:
        while not stop.is_set():
            try:
                function()
            except BaseException as error:  # it belongs to the test
                errors.append(error)
                return

    threads = [threading.Thread(target=run, args=[function]) for function in functions]
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        sys.setswitchinterval(interval_s)
    if errors:
        raise errors[0]


def filling(table: dict[str, Any], value: Any) -> Callable[[], None]:
    """A function that adds eight names to a table and clears it."""

    def change() -> None:
        for name in "abcdefgh":
            table[name] = value
        table.clear()

    return change
