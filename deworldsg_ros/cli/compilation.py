"""`deworldsg compile`: compile the kernels ahead, so that no first frame waits for the compiler."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from rich.console import Console

from deworldsg_ros.cli.progress import working
from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import warm_up
from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.scene.errors import DeWorldSGError

# The longest first, so that all processes end at about the same time.
PARTS: dict[str, Callable[[Config], object]] = {
    "perception": lambda config: build_perception(config.perception),
    "merging": lambda config: warm_up(config, "merging"),
    "lifting": lambda config: Lifting(config.lifting).warm_up(),
    "drift": lambda config: warm_up(config, "drift"),
    "pairs": lambda config: warm_up(config, "pairs"),
}


class CompilationFailed(DeWorldSGError):
    """A process of the compilation ended with an error."""


def compile_kernels(console: Console) -> None:
    """Compile the kernels of the default configuration into the cache, in several processes.

    Numba compiles one kernel at a time in a process. Kernels that are in the cache are only loaded.

    Raises:
        CompilationFailed: with the end of the output of the process.
    """
    start = time.perf_counter()
    with working(console, "compiling the kernels …"), ThreadPoolExecutor(_cores()) as pool:
        for error in pool.map(_in_own_process, PARTS):
            raise_failure(error)
    console.print(f"the kernels are ready ({time.perf_counter() - start:.1f} s)", highlight=False)


def raise_failure(output: str) -> None:
    """Raise `CompilationFailed` if a process of the compilation left an error."""
    if output:
        raise CompilationFailed(f"the kernels could not be compiled:\n{output}")


def _in_own_process(part: str) -> str:
    """Compile a part; returns the output of the process if it failed."""
    command = [sys.executable, "-m", "deworldsg_ros.cli.compilation", part]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr if done.returncode else ""


def _cores() -> int:
    return len(os.sched_getaffinity(0))


if __name__ == "__main__":
    PARTS[sys.argv[1]](Config())
