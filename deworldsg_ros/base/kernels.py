"""The decorator of all kernels; who waits for the compiler; arrays in the layout of the kernels."""

from __future__ import annotations

import dis
import functools
import hashlib
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from types import CodeType, ModuleType
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray

F = TypeVar("F", bound=Callable[..., Any])

# For people who wait: a cache on disk keeps the kernels for the next start.
COMPILING = "compiling the kernels, for the first run on this machine …"


def kernel(function: F) -> F:
    """Compile with numba: strict IEEE arithmetic, without the GIL, cached on disk if possible.

    Numba is imported at the first call of a kernel: a program that calls none starts earlier. A
    kernel may call kernels of any module. Take many arrays as one named tuple, or as one structured
    array.
    """
    return cast(F, _Kernel(function))


class _Kernel:
    """Stands for a kernel until any kernel is called; then numba's dispatchers do.

    Modules that imported it before get the dispatcher, too: a call of this object takes longer.
    """

    _waiting: ClassVar[list[_Kernel]] = []
    _lock = threading.Lock()

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self._function = function
        self._dispatcher: Any = None
        self._waiting.append(self)

    def __call__(self, *args: Any) -> Any:
        # Some keep this object: under another name, or in a container.
        return (self._dispatcher or self.dispatcher)(*args)

    @property
    def dispatcher(self) -> Any:
        """Numba's."""
        if self._dispatcher is None:
            with self._lock:
                # Empty if another thread has made them meanwhile.
                items = self._waiting.copy()
                self._waiting.clear()
                made = {item: _jit(item) for item in items}
                # Kernels are compiled when all of them are in place: they call one another.
                _replace(made)
                for item, dispatcher in made.items():
                    item._dispatcher = dispatcher
        return self._dispatcher

    @property
    def signatures(self) -> Any:
        """The types of arguments for which it is compiled."""
        return self.dispatcher.signatures

    @functools.cached_property
    def content(self) -> bytes:
        """Hash of all that its machine code is made from: its own code, constants, and kernels.

        Numba freezes the values of global names. By itself it looks at the kernel's own file only.
        """
        known = _code_parts(self._function.__code__, self._function.__doc__)
        for name in _global_names(self._function.__code__):
            known.append(_global_part(self._function.__globals__.get(name)))
        return hashlib.sha256(b"\0".join(known)).digest()


def _code_parts(code: CodeType, documentation: str | None = None) -> list[bytes]:
    parts = [code.co_code, " ".join(code.co_names).encode()]
    for value in code.co_consts:
        if isinstance(value, CodeType):  # a comprehension
            parts += _code_parts(value)
        elif value != documentation:
            parts.append(repr(value).encode())
    return parts


def _global_names(code: CodeType) -> list[str]:
    """The global names that code uses, in order; `co_names` also has those of attributes."""
    names = [i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL"]
    for value in code.co_consts:
        names += _global_names(value) if isinstance(value, CodeType) else []
    return list(dict.fromkeys(names))


def _global_part(value: Any) -> bytes:
    value = _kernels.get(id(value), value)
    if isinstance(value, _Kernel):
        return value.content
    if isinstance(value, np.ndarray):
        return b"%r %r " % (value.dtype.str.encode(), value.shape) + value.tobytes()
    if isinstance(value, ModuleType):
        return value.__name__.encode()
    return repr((value, getattr(value, "_fields", ()))).encode()


# The kernel of each dispatcher, by its identity.
_kernels: dict[int, _Kernel] = {}


def _replace(made: dict[_Kernel, Any]) -> None:
    """Put numba's dispatchers in place of kernels, in their own modules and in the package."""
    package = __name__.partition(".")[0]
    own = {item._function.__module__ for item in made}
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] == package or name in own:
            content = vars(module)
            for known, value in list(content.items()):
                if isinstance(value, _Kernel) and value in made:
                    content[known] = made[value]


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


def _jit(item: _Kernel) -> Any:
    # No C code calls a kernel.
    dispatcher: Any = _numba().njit(nogil=True, no_cfunc_wrapper=True)(item._function)
    # It compiles in every process if no folder is writable.
    with suppress(RuntimeError):
        dispatcher._cache = _cache_class()(item)
    _kernels[id(dispatcher)] = item
    return dispatcher


@functools.cache
def _cache_class() -> Any:
    """Numba's cache on disk, which asks for a kernel's `content` in place of its file."""
    from numba.core import caching

    class Files(caching.CompileResultCacheImpl):
        """Finds the files of a kernel."""

        def __init__(self, item: _Kernel) -> None:
            self._content = item.content
            begin: Any = super().__init__
            begin(item._function)

        @property
        def locator(self) -> Any:
            return self

        def get_source_stamp(self) -> bytes:
            return self._content

        def get_disambiguator(self) -> str:
            # Part of the names of the files: numba unpickles a file before it looks whether it is
            # of this kernel, and another release may have types that are no more.
            return self._content.hex()[:16]

        def __getattr__(self, name: str) -> Any:  # the place of the files
            return getattr(self._locator, name)

    class Cache(caching.FunctionCache):
        _impl_class = Files

        def __init__(self, item: _Kernel) -> None:
            begin: Any = super().__init__
            begin(item)
            self._py_func = item._function

    return Cache


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
