"""The decorator of all kernels; who waits for the compiler; arrays in the layout of the kernels."""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Callable
from types import ModuleType
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray

F = TypeVar("F", bound=Callable[..., Any])

# For people who wait: a cache on disk keeps the kernels for the next start.
COMPILING = "compiling the kernels, for the first run on this machine …"


def kernel(function: F) -> F:
    """Compile with numba: strict IEEE arithmetic, without the GIL, cached on disk if possible.

    Numba is imported at the first call of a kernel: a program that calls none starts earlier.

    A kernel may call kernels of its own module only. Numba invalidates a cached kernel when the
    kernel's own file changes, but ignores changes in the files of the kernels that it calls.
    """
    return cast(F, _Kernel(function))


class _Kernel:
    """Stands for a kernel until one of its module is called; then numba's dispatchers do.

    Modules that imported it before get the dispatcher, too: a call of this object takes longer.
    """

    _waiting: ClassVar[dict[ModuleType, list[_Kernel]]] = {}
    _lock = threading.Lock()

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self._function = function
        self._dispatcher: Any = None
        self._module = sys.modules[function.__module__]
        self._waiting.setdefault(self._module, []).append(self)

    def __call__(self, *args: Any) -> Any:
        # Some keep this object: under another name, or in a container.
        return (self._dispatcher or self.dispatcher)(*args)

    @property
    def dispatcher(self) -> Any:
        """Numba's."""
        if self._dispatcher is None:
            with self._lock:
                # None if another thread has made them meanwhile.
                items = self._waiting.pop(self._module, [])
                dispatchers = [_jit(item._function) for item in items]
                # Kernels are compiled when all of their module are in place: they call one another.
                _replace(self._module, items, dispatchers)
                for item, dispatcher in zip(items, dispatchers):
                    item._dispatcher = dispatcher
        return self._dispatcher

    @property
    def signatures(self) -> Any:
        """The types of arguments for which it is compiled."""
        return self.dispatcher.signatures


def _replace(own: ModuleType, items: list[_Kernel], dispatchers: list[Any]) -> None:
    """Put numba's dispatchers in place of a module's kernels, in all modules of the package."""
    package = __name__.partition(".")[0]
    for module_name, module in list(sys.modules.items()):
        if module_name.partition(".")[0] == package or module is own:
            content = vars(module)
            for item, dispatcher in zip(items, dispatchers):
                name = item._function.__name__
                if content.get(name) is item:
                    content[name] = dispatcher


# Functions to call when the first kernel is compiled.
_awaiting: list[Callable[[], None]] = []


def on_compilation(notify: Callable[[], None]) -> None:
    """Call a function once, when this process compiles its first kernel from now on.

    A kernel that is loaded from the cache on disk is not compiled.
    """
    _awaiting.append(notify)


@functools.cache
def _numba() -> ModuleType:
    import numba
    from numba.core import event

    class Compilation(event.Listener):
        def on_start(self, found: Any) -> None:
            while _awaiting:
                _awaiting.pop()()

        def on_end(self, found: Any) -> None:
            pass

    register: Any = event.register
    register("numba:compile", Compilation())
    return numba


def _jit(function: Callable[..., Any]) -> Any:
    # No C code calls a kernel.
    options = {"nogil": True, "no_cfunc_wrapper": True}
    try:
        return _numba().njit(cache=True, **options)(function)
    except RuntimeError:  # the cache folder is not writable: compile in every process
        return _numba().njit(**options)(function)


def read_only(array: NDArray[Any], dtype: DTypeLike | None = None) -> NDArray[Any]:
    """Read-only, aligned, C-contiguous view of an array; copies only if the layout differs.

    Numba compiles a kernel once for each combination of layout and writability of its arguments.
    An image from a message is read-only, an image from a file is writable. With this function, both
    use the same compiled kernel, and no frame waits for the compiler.

    Args:
        array: any shape.
        dtype: of the result; None keeps the array's own.
    """
    flags = array.flags
    if not (flags.c_contiguous and flags.aligned and (dtype is None or array.dtype == dtype)):
        array = np.require(array, dtype, ["C_CONTIGUOUS", "ALIGNED"])
    view = array.view()
    view.flags.writeable = False
    return view
