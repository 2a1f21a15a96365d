"""Processes that are killed at a random moment, and disks that are full."""

import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np


def killed(work: Callable[[], object], after_s: float) -> None:
    """Repeat a function in a process of its own, and kill that after a time."""
    pid = os.fork()
    if pid == 0:  # pragma: no cover
        try:
            while True:
                work()
        finally:
            os._exit(1)
    time.sleep(after_s)
    os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    assert os.WIFSIGNALED(status), "it ended by itself"


def moments_s(count: int, longest_s: float, seed: int = 0) -> Iterator[float]:
    yield from np.random.default_rng(seed).uniform(0.0, longest_s, count).tolist()


@contextmanager
def full_disk(after_bytes: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (after_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def names(folder: Path) -> list[str]:
    """Names of all files in a folder, hidden ones too."""
    return sorted(path.name for path in folder.iterdir())
