"""The pairs of each object, as lists that are linked through arrays.

`first_links` (n,) and `links` (m, 2) hold places: 2 · row + end + 1 of a pair's end, 0 = none.
`ends` (m, 2) are the rows of the two objects of each pair.
"""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Int64


def joined(first: Int64, second: Int64 | list[int]) -> Int64:
    """The values of both, ascending, each once. For few values, this is faster than NumPy."""
    values = second if isinstance(second, list) else second.ravel().tolist()
    return np.array(sorted({*first.ravel().tolist(), *values}), np.int64)


@kernel
def link(first_links: Int64, links: Int64, ends: Int64, row: int) -> None:
    """Enter a pair in the lists of both its objects."""
    for end in range(2):
        links[row, end] = first_links[ends[row, end]]
        first_links[ends[row, end]] = 2 * row + end + 1


@kernel
def unlink(first_links: Int64, links: Int64, ends: Int64, row: int) -> None:
    """Take a pair out of the lists of both its objects."""
    for end in range(2):
        _replace(first_links, links, ends[row, end], 2 * row + end + 1, links[row, end])


@kernel
def move_pair(first_links: Int64, links: Int64, ends: Int64, row: int, to: int) -> None:
    """Let the lists name another row for a pair. The arrays themselves stay."""
    for end in range(2):
        _replace(first_links, links, ends[row, end], 2 * row + end + 1, 2 * to + end + 1)


@kernel
def _replace(first_links: Int64, links: Int64, item: int, old: int, new: int) -> None:
    place = first_links[item]
    if place == old:
        first_links[item] = new
        return
    while links[(place - 1) >> 1, (place - 1) & 1] != old:
        place = links[(place - 1) >> 1, (place - 1) & 1]
    links[(place - 1) >> 1, (place - 1) & 1] = new


@kernel
def move_object(first_links: Int64, links: Int64, ends: Int64, row: int, to: int) -> None:
    """Let the pairs of an object name another row for it."""
    place = first_links[row]
    while place:
        ends[(place - 1) >> 1, (place - 1) & 1] = to
        place = links[(place - 1) >> 1, (place - 1) & 1]


@kernel
def pairs_of(first_links: Int64, links: Int64, items: Int64) -> Int64:
    """Rows of the pairs of objects (k,), ascending, each once."""
    count = 0
    for item in items:
        place = first_links[item]
        while place:
            count += 1
            place = links[(place - 1) >> 1, (place - 1) & 1]
    rows = np.empty(count, np.int64)
    count = 0
    for item in items:
        place = first_links[item]
        while place:
            rows[count] = (place - 1) >> 1
            count += 1
            place = links[(place - 1) >> 1, (place - 1) & 1]
    rows.sort()
    kept = 0
    for index in range(count):
        if kept == 0 or rows[index] != rows[kept - 1]:
            rows[kept] = rows[index]
            kept += 1
    return rows[:kept]
