"""The decorator of all kernels; who waits for the compiler; arrays in the layout of the kernels."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import event
from numpy.typing import DTypeLike, NDArray

F = TypeVar("F", bound=Callable[..., Any])

# For people who wait: a cache on disk keeps the kernels for the next start.
COMPILING = "compiling the kernels, for the first run on this machine …"


def kernel(function: F) -> F:
    """Compile with numba: strict IEEE arithmetic, without the GIL, cached on disk if possible.

    A kernel may call kernels of its own module only. Numba invalidates a cached kernel when the
    kernel's own file changes, but ignores changes in the files of the kernels that it calls.
    """
    try:
        compiled: Any = numba.njit(cache=True, nogil=True)(function)
    except RuntimeError:  # the cache folder is not writable: compile in every process
        compiled = numba.njit(nogil=True)(function)
    return cast(F, compiled)


def on_compilation(notify: Callable[[], None]) -> None:
    """Call a function once, when this process compiles its first kernel from now on.

    A kernel that is loaded from the cache on disk is not compiled.
    """
    event.register("numba:compile", _FirstEvent(notify))


class _FirstEvent(event.Listener):
    def __init__(self, notify: Callable[[], None]) -> None:
        self._notify: Callable[[], None] | None = notify

    def on_start(self, found: Any) -> None:
        notify, self._notify = self._notify, None
        if notify is not None:
            notify()

    def on_end(self, found: Any) -> None:
        pass


class _WithoutCollector(event.Listener):
    """Pauses the garbage collector of Python while a kernel is compiled.

    The compiler makes many objects that live until its end. Looking at them again and again would
    take a fifth of its time.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._was_enabled = False

    def on_start(self, found: Any) -> None:
        if self._depth == 0:
            self._was_enabled = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, found: Any) -> None:
        self._depth -= 1
        if self._depth == 0 and self._was_enabled:
            gc.enable()


event.register("numba:compile", _WithoutCollector())


def read_only(array: NDArray[Any], dtype: DTypeLike | None = None) -> NDArray[Any]:
    """Read-only, aligned, C-contiguous view of an array; copies only if the layout differs.

    Numba compiles a kernel once for each combination of layout and writability of its arguments.
    An image from a message is read-only, an image from a file is writable. With this function, both
    use the same compiled kernel, and no frame waits for the compiler.

    Args:
        array: any shape.
        dtype: of the result; None keeps the array's own.
    """
    view = np.require(array, dtype, ["C_CONTIGUOUS", "ALIGNED"]).view()
    view.flags.writeable = False
    return view
