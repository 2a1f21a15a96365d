"""One layout for the arrays that compiled kernels see."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Scalar = TypeVar("Scalar", bound=np.generic)


def read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """The array as a contiguous view that cannot be written; a copy only where it has gaps.

    A kernel is compiled once for each combination of layout and writability of its arguments.
    Images that come from a message cannot be written and those of a file can: without this, the
    first image of the other kind would wait for the compiler.
    """
    view: NDArray[Any] = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view
