"""Which nodes' surfaces pass through which cells of space: a sparse hash of small cubes.

A cell knows up to four nodes ("owners") and how often each was seen in it. Everything is linear in
the number of points asked about, whatever the size of the map.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]
Float32 = NDArray[np.float32]

OWNERS = 4
_EMPTY = np.int64(-1)
_FIRST_CAPACITY = 1 << 14
# Cell indices lie in ±2^20: with cells of 3 cm that is 31 km around the origin.
_BIAS = 1 << 20
_MASK = (1 << 21) - 1


class Overlap(NamedTuple):
    """How the cells of one observation lie on the cells of each owner (S owner indices).

    Attributes:
        cells: number of distinct cells of the observation.
        own: (S,) int64, cells that the owner was seen in.
        near: (S,) int64, further cells with a face next to a cell of the owner.
        reverse: (S,) int64, distinct cells of the owner that were met on the way.
    """

    cells: int
    own: Int64
    near: Int64
    reverse: Int64


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
        self._counts_of: dict[int, int] = {}

    def __len__(self) -> int:
        """Number of cells that have, or had, an owner."""
        return self._used

    def cell_count(self, owner: int) -> int:
        """Number of cells of an owner."""
        return self._counts_of.get(owner, 0)

    def cells_of(self, points_world: Float32) -> Int64:
        """Packed indices of the distinct cells of points (n, 3), ascending."""
        indices = np.floor(np.asarray(points_world, np.float64) / self.cell_m).astype(np.int64)
        inside = ((indices >= -_BIAS) & (indices < _BIAS)).all(axis=1)
        indices = indices[inside] + _BIAS
        return np.unique((indices[:, 0] << 42) | (indices[:, 1] << 21) | indices[:, 2])

    def centres(self, owner: int) -> Float32:
        """Centres of an owner's cells, (n, 3) float32, metres."""
        keys = np.concatenate([np.zeros(0, np.int64), *self._cells_of.get(owner, [])])
        indices = np.stack([keys >> 42, (keys >> 21) & _MASK, keys & _MASK], axis=1) - _BIAS
        return ((indices + 0.5) * self.cell_m).astype(np.float32)

    def add(self, owner: int, cells: Int64, times: int = 1) -> None:
        """Note that an owner was seen in these distinct cells."""
        room = self._cells_per_owner - self.cell_count(owner)
        if 2 * (self._used + len(cells)) > len(self._keys):
            self._grow(self._used + len(cells))
        new, created = _add(self._keys, self._owners, self._seen, owner, cells, times, room)
        self._used += created
        if len(new):
            self._cells_of.setdefault(owner, []).append(new)
            self._counts_of[owner] = self.cell_count(owner) + len(new)

    def overlap(self, cells: Int64, owner_count: int) -> Overlap:
        """How these distinct cells lie on the cells of owners 0 … owner_count - 1."""
        self._query += 1
        own, near, reverse = _overlap(
            self._keys, self._owners, self._touched, self._query, cells, owner_count
        )
        return Overlap(len(cells), own, near, reverse)

    def remove(self, owner: int) -> Int64:
        """Forget an owner; returns the cells it had."""
        cells = np.concatenate([np.zeros(0, np.int64), *self._cells_of.pop(owner, [])])
        self._counts_of.pop(owner, None)
        _remove(self._keys, self._owners, self._seen, owner, cells)
        return cells

    def _allocate(self, capacity: int) -> None:
        self._keys = np.full(capacity, _EMPTY, np.int64)
        self._owners: Int32 = np.full((capacity, OWNERS), -1, np.int32)
        self._seen: Int32 = np.zeros((capacity, OWNERS), np.int32)
        self._touched: Int64 = np.zeros((capacity, OWNERS), np.int64)

    def _grow(self, cells: int) -> None:
        keys, owners, seen = self._keys, self._owners, self._seen
        capacity = len(keys)
        while capacity < 4 * cells:
            capacity *= 2
        self._allocate(capacity)
        self._used = _rehash(keys, owners, seen, self._keys, self._owners, self._seen)


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
def _add(keys, owners, seen, owner, cells, times, room):  # type: ignore[no-untyped-def]
    new = np.empty(len(cells), np.int64)
    new_count = 0
    created = 0
    for cell in cells:
        slot = _slot(keys, cell)
        place = -1
        if keys[slot] == cell:
            for index in range(OWNERS):
                if owners[slot, index] == owner:
                    place = index
                    break
        if place >= 0:
            seen[slot, place] += times
            continue
        if new_count >= room:
            continue
        if keys[slot] != cell:
            keys[slot] = cell
            created += 1
        for index in range(OWNERS):
            if owners[slot, index] < 0:
                place = index
                break
        if place < 0:  # four nodes know this cell already
            continue
        owners[slot, place] = owner
        seen[slot, place] = times
        new[new_count] = cell
        new_count += 1
    return new[:new_count].copy(), created


@njit(cache=True, nogil=True)
def _overlap(keys, owners, touched, query, cells, owner_count):  # type: ignore[no-untyped-def]
    own = np.zeros(owner_count, np.int64)
    near = np.zeros(owner_count, np.int64)
    reverse = np.zeros(owner_count, np.int64)
    met = np.empty(7 * OWNERS, np.int32)
    steps = np.array([0, 1 << 42, -(1 << 42), 1 << 21, -(1 << 21), 1, -1], np.int64)
    for cell in cells:
        met_count = 0
        for step_index in range(7):
            slot = _slot(keys, cell + steps[step_index])
            if keys[slot] == -1:
                continue
            for index in range(OWNERS):
                owner = owners[slot, index]
                if owner < 0 or owner >= owner_count:
                    continue
                if touched[slot, index] != query:
                    touched[slot, index] = query
                    reverse[owner] += 1
                known = False
                for other in range(met_count):
                    if met[other] == owner:
                        known = True
                        break
                if known:
                    continue
                met[met_count] = owner
                met_count += 1
                if step_index == 0:
                    own[owner] += 1
                else:
                    near[owner] += 1
    return own, near, reverse


@njit(cache=True, nogil=True)
def _remove(keys, owners, seen, owner, cells):  # type: ignore[no-untyped-def]
    for cell in cells:
        slot = _slot(keys, cell)
        for index in range(OWNERS):
            if owners[slot, index] == owner:
                owners[slot, index] = -1
                seen[slot, index] = 0


@njit(cache=True, nogil=True)
def _rehash(keys, owners, seen, new_keys, new_owners, new_seen):  # type: ignore[no-untyped-def]
    used = 0
    for slot in range(len(keys)):
        if keys[slot] == -1:
            continue
        owned = False
        for index in range(OWNERS):
            owned = owned or owners[slot, index] >= 0
        if owned:
            place = _slot(new_keys, keys[slot])
            new_keys[place] = keys[slot]
            for index in range(OWNERS):
                new_owners[place, index] = owners[slot, index]
                new_seen[place, index] = seen[slot, index]
            used += 1
    return used
