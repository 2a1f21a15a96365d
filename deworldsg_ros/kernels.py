"""Numba settings of the kernels, and arrays in the one form that they are compiled for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import DTypeLike, NDArray

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile with numba: strict IEEE arithmetic, without the GIL, cached on disk if possible.

    A kernel may call kernels of its own module only: numba invalidates a cached kernel when its
    own file changes, and does not look at the files of those it calls.
    """
    try:
        compiled: Any = numba.njit(cache=True, nogil=True)(function)
    except RuntimeError:  # no writable place for the cache: compile in every process
        compiled = numba.njit(nogil=True)(function)
    return cast(F, compiled)


def borrowed(array: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    """Read-only, aligned, C-contiguous view of an array; a copy only where it is none already.

    To numba, an array that is read-only (a message's buffer) has another type than one that is
    not, and would be compiled for again in mid-run.
    """
    view = np.require(array, dtype, ["C_CONTIGUOUS", "ALIGNED"]).view()
    view.flags.writeable = False
    return view
