"""A grid over the ground that finds the objects in reach of an object.

Objects are rows of the arrays of `NodeShapes`. The cells that the bounds of an object touch are
lists of entries, linked through arrays. Cells share a list if their hashes are equal.
"""

from __future__ import annotations

import numpy as np

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


class ReachGrid:
    """The objects by the cells that they touch."""

    def __init__(self) -> None:
        self._heads = np.zeros(LISTS + 1, np.int64)
        # By entry (0 is none): the object, and the next entry of the list. Free entries are linked
        # from entry 0.
        self._items = np.zeros(64, np.int64)
        self._next = np.append(np.arange(1, 64), 0)
        # By object: its cells, from left back to right front.
        self._spans = np.full((64, 4), _NOWHERE)
        # By object: number of the last search that met it.
        self._seen = np.zeros(64, np.int64)
        self._searches = 0

    def put(self, item: int, low: Float64, high: Float64) -> None:
        """Set the bounds of an object; (3,) metres, axes 0 and 1 are horizontal."""
        self._make_room(item)
        while not _put(self._heads, self._items, self._next, self._spans, item, low, high):
            count = len(self._items)
            self._items = np.concatenate([self._items, np.zeros_like(self._items)])
            # The new entries are free; the old ones that are free come first.
            more = np.append(np.arange(count + 1, 2 * count), self._next[0])
            self._next = np.concatenate([self._next, more])
            self._next[0] = count

    def remove(self, item: int) -> None:
        """Forget an object, if it is known."""
        if item < len(self._spans):
            _remove(self._heads, self._items, self._next, self._spans, item)

    def move(self, item: int, to: int) -> None:
        """An object is another row from now on."""
        self._make_room(max(item, to))
        _move(self._heads, self._items, self._next, self._spans, item, to)

    def _make_room(self, item: int) -> None:
        while item >= len(self._spans):
            more = np.full(self._spans.shape, _NOWHERE)
            self._spans = np.concatenate([self._spans, more])
            self._seen = np.concatenate([self._seen, np.zeros_like(self._seen)])

    def pairs(self, changed: Int64, low: Float64, high: Float64, counts: Int64) -> Int64:
        """Pairs (m, 2) of objects in reach, the first one of the changed ones; some twice.

        Args:
            changed: (k,) different rows.
            low: (n, 3) bounds, and
            high: (n, 3) of all rows.
            counts: (n,) numbers of points.
        """
        grid = (self._heads, self._items, self._next, self._spans, self._seen)
        self._searches += len(changed)
        return _pairs(*grid, self._searches - len(changed), changed, low, high, counts)


def pairs_in_reach(low: Float64, high: Float64, counts: Int64) -> Int64:
    """All pairs (m, 2) of rows in reach, the smaller row first; see `ReachGrid.pairs`."""
    grid = ReachGrid()
    solid = np.flatnonzero(counts >= MIN_SHAPE_POINTS)
    for row in solid.tolist():
        grid.put(row, low[row], high[row])
    return np.unique(np.sort(grid.pairs(solid, low, high, counts), axis=1), axis=0)


@kernel
def _list_of(x: int, y: int) -> int:
    return int((x * 73856093 ^ y * 19349663) & (LISTS - 1))


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
            lists[count] = _list_of(x, y)
            count += 1
    return lists


@kernel
def _put(
    heads: Int64,
    items: Int64,
    next_: Int64,
    spans: Int64,
    item: int,
    low: Float64,
    high: Float64,
) -> bool:
    """False, and nothing is done, if there are too few free entries."""
    left, back, right, front = _span(low, high, 0.0)
    known = spans[item]
    if known[0] == left and known[1] == back and known[2] == right and known[3] == front:
        return True
    lists = _cells(left, back, right, front)
    free = 0
    entry = next_[0]
    while entry and free < len(lists):
        free += 1
        entry = next_[entry]
    if free < len(lists):
        return False
    _remove(heads, items, next_, spans, item)
    for cell in lists:
        entry = next_[0]
        next_[0] = next_[entry]
        items[entry] = item
        next_[entry] = heads[cell]
        heads[cell] = entry
    spans[item, 0], spans[item, 1], spans[item, 2], spans[item, 3] = left, back, right, front
    return True


@kernel
def _remove(heads: Int64, items: Int64, next_: Int64, spans: Int64, item: int) -> None:
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
def _move(heads: Int64, items: Int64, next_: Int64, spans: Int64, item: int, to: int) -> None:
    if spans[item, 0] == _NOWHERE:
        return
    for cell in _cells(spans[item, 0], spans[item, 1], spans[item, 2], spans[item, 3]):
        entry = heads[cell]
        while items[entry] != item:
            entry = next_[entry]
        items[entry] = to
    spans[to] = spans[item]
    spans[item] = _NOWHERE


@kernel
def _pairs(
    heads: Int64,
    items: Int64,
    next_: Int64,
    spans: Int64,
    seen: Int64,
    searches: int,
    changed: Int64,
    low: Float64,
    high: Float64,
    counts: Int64,
) -> Int64:
    found = [(0, 0)][:0]
    for a in changed:
        searches += 1
        if counts[a] < MIN_SHAPE_POINTS:
            continue
        seen[a] = searches
        left, back, right, front = _span(low[a], high[a], REACH_M)
        for b in _around(heads, items, next_, spans, _cells(left, back, right, front)):
            if seen[b] != searches and _in_reach(a, b, low, high):
                found.append((int(a), int(b)))
            seen[b] = searches
    pairs = np.empty((len(found), 2), np.int64)
    for index in range(len(found)):
        pairs[index, 0], pairs[index, 1] = found[index]
    return pairs


@kernel
def _around(heads: Int64, items: Int64, next_: Int64, spans: Int64, lists: Int64) -> Int64:
    """The objects in lists, and those over many cells; some twice."""
    if len(lists) == 1 and lists[0] == LISTS:  # over as many cells: all objects
        return np.flatnonzero(spans[:, 0] != _NOWHERE)
    found = [0][:0]
    for index in range(len(lists) + 1):
        entry = heads[lists[index] if index < len(lists) else LISTS]
        while entry:
            found.append(int(items[entry]))
            entry = next_[entry]
    return np.array(found)


@kernel
def in_reach(pairs: Int64, low: Float64, high: Float64, counts: Int64) -> Bool:
    """Whether pairs of rows (m, 2) are in reach, (m,) bool."""
    result = np.zeros(len(pairs), np.bool_)
    for index in range(len(pairs)):
        a, b = pairs[index]
        solid = counts[a] >= MIN_SHAPE_POINTS and counts[b] >= MIN_SHAPE_POINTS
        result[index] = solid and _in_reach(a, b, low, high)
    return result


@kernel
def known_reach(rows: Int64, ends: Int64, judged: Bool, gaps_m: Float64, counts: Int64) -> Bool:
    """Which of some rows of `PairRows` were in reach, or have new or lost bounds; (k,) bool."""
    found = np.empty(len(rows), np.bool_)
    for index in range(len(rows)):
        row = rows[index]
        a, b = ends[row]
        solid = counts[a] >= MIN_SHAPE_POINTS and counts[b] >= MIN_SHAPE_POINTS
        found[index] = judged[row] != solid or np.isfinite(gaps_m[row])
    return found


@kernel
def _in_reach(a: int, b: int, low: Float64, high: Float64) -> bool:
    x = max(low[a, 0], low[b, 0]) - min(high[a, 0], high[b, 0])
    y = max(low[a, 1], low[b, 1]) - min(high[a, 1], high[b, 1])
    z = max(low[a, 2], low[b, 2]) - min(high[a, 2], high[b, 2])
    if x > REACH_M or y > REACH_M or z > OVER_REACH_M:
        return False
    return not (z > BESIDE_REACH_M and (x > BESIDE_REACH_M or y > BESIDE_REACH_M))
