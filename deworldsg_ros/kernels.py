"""The decorator of all compiled kernels, and arrays in the one layout they are compiled for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import DTypeLike, NDArray

F = TypeVar("F", bound=Callable[..., Any])


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
