"""`deworldsg compile`: compile the kernels ahead, so that no first frame waits for the compiler."""

from __future__ import annotations

import gc
import multiprocessing
import os
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

from rich.console import Console

from deworldsg_ros.cli.progress import working
from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import warm_up
from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.scene.errors import DeWorldSGError

# The longest first, so that all processes end at about the same time.
PARTS: dict[str, Callable[[Config], object]] = {
    "merging": lambda config: warm_up(config, "merging"),
    "pairs": lambda config: warm_up(config, "pairs"),
    "lifting": lambda config: Lifting(config.lifting).warm_up(),
    "drift": lambda config: warm_up(config, "drift"),
    "perception": lambda config: build_perception(config.perception),
}


class CompilationFailed(DeWorldSGError):
    """A part could not be compiled."""


def compile_kernels(console: Console) -> None:
    """Compile the kernels of the default configuration into the cache, in a process for each core.

    Numba compiles one kernel at a time in a process. A process that compiles several parts
    compiles numba's own functions, which most kernels use, only once. Kernels that are in the cache
    are only loaded.

    Raises:
        CompilationFailed: with the error of the process.
    """
    start = time.perf_counter()
    # A forked process would have the threads' locks of this one, but not its threads.
    context = multiprocessing.get_context("spawn")
    processes = min(len(PARTS), len(os.sched_getaffinity(0)))
    with (
        working(console, "compiling the kernels …"),
        ProcessPoolExecutor(processes, mp_context=context) as pool,
    ):
        try:
            list(pool.map(_compile, PARTS))
        except Exception as error:  # numba can fail in more ways than can be listed
            text = "".join(traceback.format_exception(error))
            raise CompilationFailed(f"the kernels could not be compiled:\n{text}") from error
    console.print(f"the kernels are ready ({time.perf_counter() - start:.1f} s)", highlight=False)


def _compile(part: str) -> None:
    # The compiler's objects live to its end. To look at them again and again takes 8 % of the time.
    gc.disable()
    PARTS[part](Config())
    gc.collect()  # 0.4 GB
