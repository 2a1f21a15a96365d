"""Which nodes' surfaces pass through which cells of space: a sparse hash of small cubes.

A cell knows up to four nodes ("owners"). Everything is linear in
the number of points asked about, whatever the size of the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

OWNERS = 4
# An owner of fewer cells than this says too little by lying within a set.
MIN_REVERSE_CELLS = 4
# The number of a query is kept in 32 bits.
_LAST_QUERY = 2**31 - 1
_EMPTY = np.int64(-1)
_FIRST_CAPACITY = 1 << 14
# Cell indices lie in ±2^20: with cells of 3 cm that is 31 km around the origin.
_BIAS = 1 << 20
_MASK = (1 << 21) - 1
# From a cell to itself and to those that share a face with it.
STEPS = np.array([0, 1, -1, 1 << 21, -(1 << 21), 1 << 42, -(1 << 42)], np.int64)


class CellSets(NamedTuple):
    """Distinct cells of several sets of points, one after the other.

    Attributes:
        cells: packed cell indices; those of set k are cells[starts[k] : starts[k + 1]].
        starts: (n + 1,) int64.
    """

    cells: Int64
    starts: Int64

    def of(self, index: int) -> Int64:
        """Cells of one set."""
        return self.cells[self.starts[index] : self.starts[index + 1]]


class VoxelMap:
    """Cells of the surfaces of nodes, which are told apart by small owner indices.

    Args:
        cell_m: edge of a cell, metres.
        cells_per_owner: most cells kept an owner; a surface beyond that is not remembered.
    """

    def __init__(self, cell_m: float, cells_per_owner: int = 8192) -> None:
        self.cell_m = cell_m
        self._cells_per_owner = cells_per_owner
        self._allocate(_FIRST_CAPACITY)
        self._used = 0
        self._query = 0
        self._cells_of: dict[int, list[Int64]] = {}
        self._counts = np.zeros(64, np.int64)

    def __len__(self) -> int:
        """Number of cells that have, or had, an owner."""
        return self._used

    def cell_count(self, owner: int) -> int:
        """Number of cells of an owner."""
        return int(self._counts[owner]) if owner < len(self._counts) else 0

    def cells_of(self, point_sets: Sequence[Float32]) -> CellSets:
        """Distinct cells of each set of points (k, 3), metres."""
        counts = [len(points) for points in point_sets]
        points = np.concatenate([np.zeros((0, 3), np.float32), *point_sets])
        return CellSets(*_cells_of(points, np.array([0, *np.cumsum(counts)]), self.cell_m))

    def cells(self, owner: int) -> Int64:
        """An owner's cells, (n,) packed indices."""
        return np.concatenate([np.zeros(0, np.int64), *self._cells_of.get(owner, [])])

    def centres(self, owner: int) -> Float32:
        """Centres of an owner's cells, (n, 3) float32, metres."""
        keys = self.cells(owner)
        indices = np.stack([keys >> 42, (keys >> 21) & _MASK, keys & _MASK], axis=1) - _BIAS
        return ((indices + 0.5) * self.cell_m).astype(np.float32)

    def add(self, owners: Sequence[int], sets: CellSets) -> None:
        """Note that each owner was seen in the cells of its set."""
        if not len(owners):
            return
        self._make_room(max(owners) + 1)
        if 2 * (self._used + len(sets.cells)) > len(self._keys):
            self._grow(self._used + len(sets.cells))
        new, starts, created = _add(
            self._keys,
            self._owners,
            self._counts,
            self._cells_per_owner,
            np.array(owners, np.int64),
            sets.cells,
            sets.starts,
        )
        self._used += created
        for owner, start, stop in zip(owners, starts[:-1].tolist(), starts[1:].tolist()):
            if stop > start:
                self._cells_of.setdefault(owner, []).append(new[start:stop].copy())

    def shares(self, sets: CellSets) -> tuple[list[int], Float64]:
        """How far the surface of each set coincides with that of each owner.

        The share of the set's cells that the owner was seen in, or that have a face next to such a
        cell; or the share of the owner's cells that were met on the way, where that is more: the
        side that saw less of the object decides.

        Returns:
            The S owners that any set met, ascending, and the shares (n, S) float64 in [0, 1].
        """
        if self._query > _LAST_QUERY - len(sets.starts):
            self._owners[:, OWNERS:] = self._query = 0
        shares: Float64 = _shares(
            self._keys, self._owners, self._query, sets.cells, sets.starts, self._counts
        )
        self._query += len(shares)
        owners = np.flatnonzero(shares.any(axis=0))
        return owners.tolist(), shares[:, owners]

    def contest(
        self, owners: Sequence[int], sets: CellSets, least_share: float
    ) -> dict[int, float]:
        """Take from each owner the cells in which a frame shows another of its owners instead.

        Args:
            owners: of each set; -1 = none yet.
            sets: where the frame shows each of them. What touches an owner's own set stays its own.
            least_share: of an owner's cells; fewer are left to it.

        Returns:
            The share of its cells that each owner lost, of those that lost some.
        """
        self._make_room(max(owners, default=-1) + 1)
        cells, losers = _contest(
            self._keys,
            self._owners,
            len(self._counts),
            np.array(owners, np.int64),
            sets.cells,
            sets.starts,
        )
        if not len(losers):
            return {}
        # Counted once for each of the others that is shown there.
        at_most = np.bincount(losers, minlength=len(self._counts))
        shares = {}
        for owner in np.flatnonzero(at_most > least_share * self._counts).tolist():
            lost = np.unique(cells[losers == owner])
            share = len(lost) / int(self._counts[owner])
            if share > least_share:
                known = np.concatenate(self._cells_of[owner])
                _remove(self._keys, self._owners, owner, lost)
                self._cells_of[owner] = [np.setdiff1d(known, lost, assume_unique=True)]
                self._counts[owner] -= len(lost)
                shares[owner] = share
        return shares

    def remove(self, owner: int) -> Int64:
        """Forget an owner; returns the cells it had."""
        cells = np.concatenate([np.zeros(0, np.int64), *self._cells_of.pop(owner, [])])
        if len(cells):
            self._counts[owner] = 0
        _remove(self._keys, self._owners, owner, cells)
        return cells

    def _make_room(self, owner_count: int) -> None:
        if owner_count > len(self._counts):
            self._counts = np.pad(self._counts, (0, 2 * owner_count - len(self._counts)))

    def _allocate(self, capacity: int) -> None:
        self._keys = np.full(capacity, _EMPTY, np.int64)
        # The owners of each cell, -1 after the last, and the query by which each was met last:
        # side by side, because what costs is to fetch them.
        self._owners: Int32 = np.full((capacity, 2 * OWNERS), -1, np.int32)

    def _grow(self, cells: int) -> None:
        keys, owners = self._keys, self._owners
        capacity = len(keys)
        while capacity < 3 * cells:
            capacity *= 2
        self._allocate(capacity)
        self._used = _rehash(keys, owners, self._keys, self._owners)


@njit(cache=True, nogil=True)
def _slot(keys, key):  # type: ignore[no-untyped-def]
    """Slot of a key, or of the empty place where it belongs."""
    mask = len(keys) - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64(mixed >> np.uint64(32)) & mask
    while keys[slot] != key and keys[slot] != -1:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def _add(keys, owners, counts, limit, who, cells, starts):  # type: ignore[no-untyped-def]
    new = np.empty(len(cells), np.int64)
    new_starts = np.zeros(len(starts), np.int64)
    new_count = 0
    created = 0
    for index in range(len(who)):
        owner = who[index]
        for cell in cells[starts[index] : starts[index + 1]]:
            slot = _slot(keys, cell)
            known = False
            place = -1
            for candidate in range(OWNERS):
                known = bool(known or owners[slot, candidate] == owner)
                if place < 0 and owners[slot, candidate] < 0:
                    place = candidate
            # Four nodes may know a cell; a fifth does not.
            if known or place < 0 or counts[owner] >= limit:
                continue
            if keys[slot] != cell:
                keys[slot] = cell
                created += 1
            owners[slot, place] = owner
            owners[slot, OWNERS + place] = 0
            counts[owner] += 1
            new[new_count] = cell
            new_count += 1
        new_starts[index + 1] = new_count
    return new[:new_count].copy(), new_starts, created


@njit(cache=True, nogil=True)
def _cells_of(points, starts, cell_m):  # type: ignore[no-untyped-def]
    cells = np.empty(len(points), np.int64)
    new_starts = np.zeros(len(starts), np.int64)
    kept = 0
    cells_per_m = 1.0 / cell_m
    for index in range(len(starts) - 1):
        capacity = 16
        while capacity < 2 * (starts[index + 1] - starts[index]):
            capacity *= 2
        known = np.full(capacity, _EMPTY)
        for point in range(starts[index], starts[index + 1]):
            cell = np.int64(0)
            inside = True
            for axis in range(3):
                step = np.int64(np.floor(np.float64(points[point, axis]) * cells_per_m))
                inside = bool(inside and -_BIAS <= step < _BIAS)
                cell = (cell << 21) | (step + _BIAS)
            if inside:
                slot = _slot(known, cell)
                if known[slot] != cell:
                    known[slot] = cell
                    cells[kept] = cell
                    kept += 1
        new_starts[index + 1] = kept
    return cells[:kept].copy(), new_starts


@njit(cache=True, nogil=True)
def _shares(keys, owners, query, cells, starts, counts):  # type: ignore[no-untyped-def]
    shares = np.zeros((len(starts) - 1, len(counts)))
    on_owner = np.zeros(len(counts), np.int64)
    of_owner = np.zeros(len(counts), np.int64)
    # The cell of the set that met an owner last: a cell meets an owner once.
    met_at = np.full(len(counts), -1, np.int64)
    for index in range(len(starts) - 1):
        query += 1
        on_owner[:] = 0
        of_owner[:] = 0
        for at in range(starts[index], starts[index + 1]):
            for step in STEPS:
                slot = _slot(keys, cells[at] + step)
                if keys[slot] == -1:
                    continue
                for place in range(OWNERS):
                    owner = owners[slot, place]
                    if owner < 0:
                        break
                    if owners[slot, OWNERS + place] != query:
                        owners[slot, OWNERS + place] = query
                        of_owner[owner] += 1
                    if met_at[owner] != at:
                        met_at[owner] = at
                        on_owner[owner] += 1
        cell_count = starts[index + 1] - starts[index]
        for owner in range(len(counts)):
            if on_owner[owner] > 0:
                share = on_owner[owner] / cell_count
                if counts[owner] >= MIN_REVERSE_CELLS:
                    share = max(share, of_owner[owner] / counts[owner])
                shares[index, owner] = share
    return shares


@njit(cache=True, nogil=True)
def _contest(keys, owners, owner_count, who, cells, starts):  # type: ignore[no-untyped-def]
    set_of = np.full(owner_count, -1, np.int64)
    ascending = cells.copy()
    sorted_yet = np.zeros(len(who), np.bool_)
    for index in range(len(who)):
        if who[index] >= 0:
            set_of[who[index]] = index
    lost = np.empty(len(cells) * OWNERS, np.int64)
    losers = np.empty(len(cells) * OWNERS, np.int64)
    count = 0
    for index in range(len(who)):
        for cell in cells[starts[index] : starts[index + 1]]:
            slot = _slot(keys, cell)
            if keys[slot] == -1:
                continue
            for place in range(OWNERS):
                owner = owners[slot, place]
                if owner < 0 or owner == who[index] or set_of[owner] < 0:
                    continue
                own = ascending[starts[set_of[owner]] : starts[set_of[owner] + 1]]
                if not sorted_yet[set_of[owner]]:
                    own.sort()
                    sorted_yet[set_of[owner]] = True
                near = False
                for step in STEPS:
                    at = np.searchsorted(own, cell + step)
                    near = bool(near or (at < len(own) and own[at] == cell + step))
                if not near:
                    lost[count] = cell
                    losers[count] = owner
                    count += 1
    return lost[:count].copy(), losers[:count].copy()


@njit(cache=True, nogil=True)
def _remove(keys, owners, owner, cells):  # type: ignore[no-untyped-def]
    for cell in cells:
        slot = _slot(keys, cell)
        last = OWNERS - 1
        while last >= 0 and owners[slot, last] < 0:
            last -= 1
        for index in range(last + 1):
            if owners[slot, index] == owner:
                owners[slot, index] = owners[slot, last]
                owners[slot, OWNERS + index] = owners[slot, OWNERS + last]
                owners[slot, last] = -1
                break


@njit(cache=True, nogil=True)
def _rehash(keys, owners, new_keys, new_owners):  # type: ignore[no-untyped-def]
    used = 0
    for slot in range(len(keys)):
        if keys[slot] == -1:
            continue
        owned = False
        for index in range(OWNERS):
            owned = bool(owned or owners[slot, index] >= 0)
        if owned:
            place = _slot(new_keys, keys[slot])
            new_keys[place] = keys[slot]
            for index in range(OWNERS):
                new_owners[place, index] = owners[slot, index]
            used += 1
    return used
