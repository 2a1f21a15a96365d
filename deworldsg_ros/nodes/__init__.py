"""The ROS 2 nodes: each is a thin shell around one stage. Here is how the process of one starts."""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import sys
from typing import NoReturn

# --- Memory of a process that receives images.

# Parameters of glibc's mallopt.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
# The largest value that glibc accepts. Images and their copies are smaller.
MMAP_THRESHOLD_BYTES = 1 << 25
# Freed memory that a process keeps: some images of 1 MB in each stream.
TRIM_THRESHOLD_BYTES = 1 << 27


def keep_freed_memory() -> None:
    """Use freed memory again, rather than return it to the operating system and ask for it again.

    By default the memory of each image is new: the kernel fills its pages with zeros when they are
    first written. On a virtual machine this made taking a 0.9 MB image from DDS four times as slow
    (2.7 ms, 0.6 ms with this).

    By default each thread also has a heap of its own, whose free memory no other thread uses: the
    heap of one thread grew in steps of 0.3 to 0.5 MB while others had room. All threads use one.

    It changes nothing without glibc. Call it before the first thread starts, so before numpy is
    imported: a heap that exists is used.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, MMAP_THRESHOLD_BYTES)
        mallopt(M_TRIM_THRESHOLD, TRIM_THRESHOLD_BYTES)
        mallopt(M_ARENA_MAX, 1)


# --- Start of a node's process: a signal during the imports ends it with exit code 0.


def start(name: str) -> NoReturn:
    """Run the node of a module of this package; end the process with its exit code."""
    for number in (signal.SIGINT, signal.SIGTERM):
        # Nothing is open yet. The node installs its own handlers.
        signal.signal(number, lambda *_: os._exit(0))
    sys.exit(importlib.import_module(f"{__name__}.{name}").main())


# Before the modules of a node: the threads that numpy and numba start take heaps of their own.
keep_freed_memory()
# Products of matrices are small here. A second thread of OpenBLAS waits busily for the next one,
# which takes the processor from the network. A value of the user stays.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
