"""Times of the pipeline's parts. Only the pipeline reads a clock, no stage does."""

from __future__ import annotations

import functools
import platform
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

# In processing order. `reading` decodes the images. The next three are parts of perception.
# `relations` is the world model.
STAGES = ("reading", "detection", "masks", "relation_inference", "lifting", "merging", "relations")


@contextmanager
def timed(times_s: list[float]) -> Iterator[None]:
    """Append the duration of the block in seconds, unless it raises."""
    start = time.perf_counter()
    yield
    times_s.append(time.perf_counter() - start)


def watch(owner: object, method: str, times_s: list[float]) -> None:
    """Time each call of a method of this one object from now on."""
    inner = getattr(owner, method)

    @functools.wraps(inner)
    def outer(*args: Any, **kwargs: Any) -> Any:
        with timed(times_s):
            return inner(*args, **kwargs)

    setattr(owner, method, outer)


def total_ms(times_s: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Total milliseconds of each part that ran."""
    return {name: 1e3 * sum(times) for name, times in times_s.items() if times}


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
