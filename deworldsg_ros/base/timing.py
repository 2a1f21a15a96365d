"""Times of the pipeline's parts. Only the pipeline reads a clock, no stage does."""

from __future__ import annotations

import functools
import platform
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

# In processing order. `reading` decodes the images. The next three are parts of perception.
# `relations` is the world model.
STAGES = ("reading", "detection", "masks", "relation_inference", "lifting", "merging", "relations")


# Newest durations for median and percentiles: five minutes at 30 Hz, in 80 kB.
KEPT_TIMES = 10_000


class Times:
    """Durations in seconds: the sum of all, and the newest.

    Attributes:
        count: number of all durations.
        total_s: their sum.
        newest_s: at most KEPT_TIMES.
    """

    def __init__(self) -> None:
        self.count = 0
        self.total_s = 0.0
        self.newest_s: deque[float] = deque(maxlen=KEPT_TIMES)
        self._lock = threading.Lock()  # detectors run in several threads

    def append(self, duration_s: float) -> None:
        """Add a duration."""
        with self._lock:
            self.count += 1
            self.total_s += duration_s
            self.newest_s.append(duration_s)


@contextmanager
def timed(times: Times) -> Iterator[None]:
    """Add the duration of the block, unless it raises."""
    start = time.perf_counter()
    yield
    times.append(time.perf_counter() - start)


def watch(owner: object, method: str, times: Times) -> None:
    """Time each call of a method of this one object from now on."""
    inner = getattr(owner, method)

    @functools.wraps(inner)
    def outer(*args: Any, **kwargs: Any) -> Any:
        with timed(times):
            return inner(*args, **kwargs)

    setattr(owner, method, outer)


def total_ms(times: Mapping[str, Times]) -> dict[str, float]:
    """Total milliseconds of each part that ran."""
    return {name: 1e3 * item.total_s for name, item in times.items() if item.count}


def device_name() -> str:
    """The processor, and the accelerator if models use one."""
    names = [_processor_name()]
    # torch is imported only if a model uses it. Importing it here would take seconds.
    torch: Any = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        names.append(torch.cuda.get_device_name())
    return ", ".join(names)


def _processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    if names:
        return f"{names[0]} ({len(names)} cores)"
    return platform.processor() or platform.machine()
