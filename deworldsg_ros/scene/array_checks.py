"""Checks of saved arrays: each raises ValueError with the name, the value and what was expected.

They run once, where a file is read. Kernels get only arrays that have passed them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.checks import SUM_TOLERANCE

# Means and products of the distributions of frames have their errors, and those of rounding.
MAX_SUM_ERROR = 1.01 * SUM_TOLERANCE


def checked(
    arrays: Mapping[str, NDArray[Any]], name: str, dtype: DTypeLike, *shape: int | None
) -> NDArray[Any]:
    """The array of a name, C-contiguous; ValueError unless it has this dtype and shape.

    Args:
        arrays: by name.
        name: of the array.
        dtype: expected.
        shape: expected; None = any length.
    """
    if name not in arrays:
        raise ValueError(f"there is no '{name}' in it")
    array = arrays[name]
    fits = array.ndim == len(shape) and all(
        side is None or side == found for side, found in zip(shape, array.shape)
    )
    if array.dtype != np.dtype(dtype) or not fits:
        expected = ", ".join("n" if side is None else str(side) for side in shape)
        raise ValueError(
            f"{name} is {array.dtype} of shape {array.shape}: expected {np.dtype(dtype)} of shape "
            f"({expected})"
        )
    return np.ascontiguousarray(array)


def within(name: str, values: NDArray[Any], low: float, high: float) -> None:
    """ValueError unless all values are finite numbers from low to high."""
    # The negated comparisons also catch NaN, which is the minimum of an array that has one.
    if values.size and not low <= values.min() <= values.max() <= high:
        wrong = ~((values >= low) & (values <= high))
        refuse(name, values[wrong][0], f"{low:g} to {high:g}")


def holds(name: str, condition: bool | np.bool_, expected: str) -> None:
    """ValueError with the name and the expectation if a condition does not hold."""
    if not condition:
        raise ValueError(f"{name}: expected {expected}")


def refuse(name: str, seen: Any, expected: str) -> None:
    """Raise ValueError with the value seen and the value expected."""
    raise ValueError(f"{name} contains {seen}: expected {expected}")


def distinct(name: str, rows: NDArray[Any]) -> None:
    """ValueError if two rows, (n,) or (n, k), are equal."""
    columns = np.atleast_2d(rows.T)
    # `np.unique` of rows compares them as bytes, which takes ten times as long.
    ordered = columns[:, np.lexsort(columns)]
    if (ordered[:, 1:] == ordered[:, :-1]).all(axis=0).any():
        raise ValueError(f"{name} contains a value twice: expected each once")


def distributions(name: str, rows: NDArray[Any]) -> None:
    """ValueError unless each row has numbers from 0 to 1 that sum to one, as those of frames."""
    within(name, rows, 0.0, 1.0 + MAX_SUM_ERROR)
    sums = rows.sum(axis=1)
    if rows.size and np.abs(sums - 1.0).max() > MAX_SUM_ERROR:
        refuse(name, f"a row with the sum {sums[np.abs(sums - 1.0).argmax()]:g}", "1")


def lengths(name: str, counts: Int64, total: int) -> None:
    """ValueError unless the lengths are not negative and sum to the number of rows they divide."""
    within(name, counts, 0, total)  # first: the sum of int64 could overflow
    if len(counts) and sum(counts.tolist()) != total or not len(counts) and total:
        refuse(name, f"lengths with the sum {sum(counts.tolist())}", str(total))


def contained(name: str, ids: Int64, known: Int64) -> None:
    """ValueError unless each id is one of the known ones."""
    missing = ~np.isin(ids, known)
    if missing.any():
        refuse(name, f"the id {ids[missing].flat[0]}", "the id of a node")


def acyclic(name: str, links: Int64) -> None:
    """ValueError if following the links (n, 2) from an id to another one ever returns to an id.

    The first column is distinct. A path of n links has at most n steps, and each round doubles
    the number of steps that are followed: log2(n) rounds end all paths, or there is a circle.
    """
    order = np.argsort(links[:, 0])
    sources, targets = links[order, 0], links[order, 1]
    # Row of the next link of a path; -1 = its end.
    at = np.searchsorted(sources, targets)
    at = np.where((at < len(sources)) & (np.append(sources, -1)[at] == targets), at, -1)
    for _ in range(len(links).bit_length() + 1):
        at = np.where(at >= 0, at[at], -1)
    if (at >= 0).any():
        refuse(name, f"the id {sources[at >= 0][0]}, which succeeds itself", "no circle")
