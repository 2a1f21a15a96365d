"""A grid over the ground that finds the objects in reach of an object.

Objects are places in an array of `SHAPE`. The cells that the bounds of an object touch are lists of
entries, linked through arrays. Cells share a list if their hashes are equal.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float64, Int64

# About the size of furniture: most objects touch one cell or two.
CELL_M = 2.0
# An object over more cells lies in all of them by another way: in a list that is always searched.
MAX_CELLS = 1024
# Lists of cells. The last one is of the objects over more cells than `MAX_CELLS`.
LISTS = 1 << 15
# Pairs of objects that are farther apart are not related: horizontally, vertically, and
# vertically for objects that are not over one another.
REACH_M = 0.6
OVER_REACH_M = 1.3
BESIDE_REACH_M = 0.15
# A node with fewer points has no reliable bounds; its relations are not judged.
MIN_SHAPE_POINTS = 8

# A span that no object has.
_NOWHERE = np.iinfo(np.int64).max


class _Lists(NamedTuple):
    """The arrays of a grid.

    Attributes:
        heads: (LISTS + 1,) first entry of each list; 0 = none.
        items: by entry, the object.
        next_: by entry, the next one of its list. Free entries are linked from entry 0.
        spans: by object, its cells, from left back to right front.
        seen: by object, the number of the last search that met it.
    """

    heads: Int64
    items: Int64
    next_: Int64
    spans: Int64
    seen: Int64


class ReachGrid:
    """The objects by the cells that they touch."""

    def __init__(self) -> None:
        self._lists = _Lists(
            np.zeros(LISTS + 1, np.int64),
            np.zeros(64, np.int64),
            np.append(np.arange(1, 64), 0),
            np.full((64, 4), _NOWHERE),
            np.zeros(64, np.int64),
        )
        self._searches = 0

    def put(self, item: int, low: Float64, high: Float64) -> None:
        """Set the bounds of an object; (3,) metres, axes 0 and 1 are horizontal."""
        while item >= len(self._lists.spans):
            spans, seen = self._lists.spans, self._lists.seen
            self._lists = self._lists._replace(
                spans=np.concatenate([spans, np.full_like(spans, _NOWHERE)]),
                seen=np.concatenate([seen, np.zeros_like(seen)]),
            )
        while not _put(self._lists, item, low, high):
            items, next_ = self._lists.items, self._lists.next_
            # The new entries are free; the old ones that are free come last.
            more = np.append(np.arange(len(items) + 1, 2 * len(items)), next_[0])
            self._lists = self._lists._replace(
                items=np.concatenate([items, np.zeros_like(items)]),
                next_=np.concatenate([next_, more]),
            )
            self._lists.next_[0] = len(items)

    def remove(self, item: int) -> None:
        """Forget an object, if it is known."""
        if item < len(self._lists.spans):
            _remove(self._lists, item)

    def pairs(self, changed: Int64, shapes: NDArray[np.void]) -> Int64:
        """Pairs (m, 2) of objects in reach, the first one of the changed ones; some twice.

        Args:
            changed: (k,) different places in
            shapes: (n,) of `SHAPE`, of all objects.
        """
        self._searches += len(changed)
        return _pairs(self._lists, self._searches - len(changed), changed, shapes)


def pairs_in_reach(shapes: NDArray[np.void]) -> Int64:
    """All pairs (m, 2) of places in reach, the smaller first; see `ReachGrid.pairs`."""
    grid = ReachGrid()
    solid = np.flatnonzero(shapes["count"] >= MIN_SHAPE_POINTS)
    for place in solid.tolist():
        grid.put(place, shapes["low"][place], shapes["high"][place])
    return np.unique(np.sort(grid.pairs(solid, shapes), axis=1), axis=0)


@kernel
def _span(low: Float64, high: Float64, more_m: float) -> tuple[int, int, int, int]:
    return (
        int(np.floor((low[0] - more_m) / CELL_M)),
        int(np.floor((low[1] - more_m) / CELL_M)),
        int(np.floor((high[0] + more_m) / CELL_M)),
        int(np.floor((high[1] + more_m) / CELL_M)),
    )


@kernel
def _cells(left: int, back: int, right: int, front: int) -> Int64:
    """The lists of the cells of a span."""
    if float(right - left + 1) * float(front - back + 1) > MAX_CELLS:
        return np.full(1, LISTS)
    lists = np.empty((right - left + 1) * (front - back + 1), np.int64)
    count = 0
    for x in range(left, right + 1):
        for y in range(back, front + 1):
            lists[count] = (x * 73856093 ^ y * 19349663) & (LISTS - 1)
            count += 1
    return lists


@kernel
def _put(lists: _Lists, item: int, low: Float64, high: Float64) -> bool:
    """False, and nothing is done, if there are too few free entries."""
    heads, items, next_, spans, _ = lists
    left, back, right, front = _span(low, high, 0.0)
    known = spans[item]
    if known[0] == left and known[1] == back and known[2] == right and known[3] == front:
        return True
    cells = _cells(left, back, right, front)
    free = 0
    entry = next_[0]
    while entry and free < len(cells):
        free += 1
        entry = next_[entry]
    if free < len(cells):
        return False
    _remove(lists, item)
    for cell in cells:
        entry = next_[0]
        next_[0] = next_[entry]
        items[entry] = item
        next_[entry] = heads[cell]
        heads[cell] = entry
    spans[item, 0], spans[item, 1], spans[item, 2], spans[item, 3] = left, back, right, front
    return True


@kernel
def _remove(lists: _Lists, item: int) -> None:
    heads, items, next_, spans, _ = lists
    if spans[item, 0] == _NOWHERE:
        return
    for cell in _cells(spans[item, 0], spans[item, 1], spans[item, 2], spans[item, 3]):
        before, entry = 0, heads[cell]
        while items[entry] != item:
            before, entry = entry, next_[entry]
        if before:
            next_[before] = next_[entry]
        else:
            heads[cell] = next_[entry]
        next_[entry] = next_[0]
        next_[0] = entry
    spans[item] = _NOWHERE


@kernel
def _pairs(lists: _Lists, searches: int, changed: Int64, shapes: NDArray[Any]) -> Int64:
    heads, items, next_, spans, seen = lists
    found = [(0, 0)][:0]
    for a in changed:
        searches += 1
        if shapes[a].count < MIN_SHAPE_POINTS:
            continue
        seen[a] = searches
        left, back, right, front = _span(shapes[a].low, shapes[a].high, REACH_M)
        cells = _cells(left, back, right, front)
        if len(cells) == 1 and cells[0] == LISTS:  # over as many cells: all objects
            for b in range(len(spans)):
                if spans[b, 0] != _NOWHERE and b != a and _in_reach(shapes[a], shapes[b]):
                    found.append((int(a), int(b)))
            continue
        for index in range(len(cells) + 1):
            entry = heads[cells[index] if index < len(cells) else LISTS]
            while entry:
                b = items[entry]
                if seen[b] != searches and _in_reach(shapes[a], shapes[b]):
                    found.append((int(a), int(b)))
                seen[b] = searches
                entry = next_[entry]
    pairs = np.empty((len(found), 2), np.int64)
    for index in range(len(found)):
        pairs[index, 0], pairs[index, 1] = found[index]
    return pairs


@kernel
def in_reach(pairs: Int64, shapes: NDArray[Any]) -> Bool:
    """Whether pairs of places (m, 2) are in reach, (m,) bool."""
    result = np.zeros(len(pairs), np.bool_)
    for index in range(len(pairs)):
        a, b = shapes[pairs[index, 0]], shapes[pairs[index, 1]]
        solid = a.count >= MIN_SHAPE_POINTS and b.count >= MIN_SHAPE_POINTS
        result[index] = solid and _in_reach(a, b)
    return result


@kernel
def _in_reach(a: Any, b: Any) -> bool:
    x = max(a.low[0], b.low[0]) - min(a.high[0], b.high[0])
    y = max(a.low[1], b.low[1]) - min(a.high[1], b.high[1])
    z = max(a.low[2], b.low[2]) - min(a.high[2], b.high[2])
    if x > REACH_M or y > REACH_M or z > OVER_REACH_M:
        return False
    return not (z > BESIDE_REACH_M and (x > BESIDE_REACH_M or y > BESIDE_REACH_M))
