"""How long parts take: for the pipeline, which is the only one with a clock."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def timed(times_s: list[float]) -> Iterator[None]:
    """Append the seconds that the block takes, unless it raises."""
    start = time.perf_counter()
    yield
    times_s.append(time.perf_counter() - start)


def watch(owner: object, method: str, times_s: list[float]) -> None:
    """From now on each call of a method of this one object is timed."""
    inner = getattr(owner, method)

    @functools.wraps(inner)
    def outer(*args: Any, **kwargs: Any) -> Any:
        with timed(times_s):
            return inner(*args, **kwargs)

    setattr(owner, method, outer)
