"""Which nodes' surfaces pass through which cells of space: a sparse hash of small cubes.

Cells are kept in blocks of 4 x 4 x 4, one bit each, so that neighbours are found by shifts. A cell
knows up to four nodes ("owners"). Everything is linear in the number of points asked about,
whatever the size of the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int32, Int64, UInt64

# Edge of a cell. In the rendered rooms, cells of 2 cm lose objects and cells of 5 cm lose relations
# (docs/dev/notebook.md).
CELL_M = 0.03
# An owner of fewer cells than this says too little by lying within a set.
MIN_REVERSE_CELLS = 4
_EMPTY = np.int64(-1)
_FIRST_CAPACITY = 1 << 12
# Cell indices lie in ±2^20: with cells of 3 cm that is 31 km around the origin.
_BIAS = 1 << 20
_MASK = (1 << 21) - 1
# The six faces of a block: the cells along each, how far their bits are turned to the right to
# become the cells of the next block that they touch, and the way to that block.
_FACES = np.array(
    [
        0x8888888888888888,
        0x1111111111111111,
        0xF000F000F000F000,
        0x000F000F000F000F,
        0xFFFF000000000000,
        0x000000000000FFFF,
    ],
    np.uint64,
)
_TURNS = np.array([3, 61, 12, 52, 48, 16], np.uint64)
_STEPS = np.array([1, -1, 1 << 21, -(1 << 21), 1 << 42, -(1 << 42)], np.int64)


class CellSets(NamedTuple):
    """Cells of several sets of points, one after the other.

    Attributes:
        blocks: (m,) int64, packed indices of blocks; those of set k, all different, are
            blocks[starts[k] : starts[k + 1]].
        masks: (m,) uint64, the cells of each: bit 16 x + 4 y + z.
        starts: (n + 1,) int64.
    """

    blocks: Int64
    masks: UInt64
    starts: Int64


class VoxelMap:
    """Cells of the surfaces of nodes, which are told apart by small owner indices.

    Args:
        cell_m: edge of a cell, metres.
        cells_per_owner: most cells kept an owner; a surface beyond that is not remembered.
    """

    def __init__(self, cell_m: float = CELL_M, cells_per_owner: int = 8192) -> None:
        self.cell_m = cell_m
        self._cells_per_owner = cells_per_owner
        self._allocate(_FIRST_CAPACITY)
        self._used = 0
        self._blocks_of: dict[int, list[Int64]] = {}
        self._counts = np.zeros(64, np.int64)

    def cell_count(self, owner: int) -> int:
        """Number of cells of an owner."""
        return int(self._counts[owner]) if owner < len(self._counts) else 0

    def cells_of(self, point_sets: Sequence[Float32]) -> CellSets:
        """Cells of each set of points (k, 3), metres."""
        points = np.concatenate([np.zeros((0, 3), np.float32), *point_sets])
        starts = np.array([0, *accumulate(map(len, point_sets))])
        return CellSets(*_cells_of(points, starts, self.cell_m))

    def cells(self, owner: int) -> CellSets:
        """An owner's cells, as one set."""
        blocks, slots = self._slots_of(owner)
        return CellSets(blocks, self._masks[slots], np.array([0, len(blocks)]))

    def centres(self, owner: int) -> Float32:
        """Centres of an owner's cells, (n, 3) float32, metres."""
        blocks, masks, _ = self.cells(owner)
        bits = np.arange(64, dtype=np.uint64)
        rows, places = np.nonzero((masks[:, None] >> bits) & np.uint64(1))
        corners = np.stack([blocks >> 42, (blocks >> 21) & _MASK, blocks & _MASK], axis=1)[rows]
        within = np.stack([places >> 4, (places >> 2) & 3, places & 3], axis=1)
        return ((4 * corners + within - _BIAS + 0.5) * self.cell_m).astype(np.float32)

    def add(self, owners: Sequence[int], sets: CellSets) -> None:
        """Note that each owner was seen in the cells of its set."""
        if not len(owners):
            return
        self._make_room(max(owners) + 1)
        if 2 * (self._used + len(sets.blocks)) > len(self._keys):
            self._grow(len(sets.blocks))
        new, starts, self._used = _add(
            self._keys,
            self._masks,
            self._owners,
            self._counts,
            self._cells_per_owner,
            self._used,
            np.array(owners, np.int64),
            *sets,
        )
        for owner, start, stop in zip(owners, starts[:-1].tolist(), starts[1:].tolist()):
            if stop > start:
                self._blocks_of.setdefault(owner, []).append(new[start:stop].copy())

    def shares(self, sets: CellSets) -> tuple[list[int], Float64]:
        """How far the surface of each set coincides with that of each owner.

        The share of the set's cells that the owner was seen in, or that have a face next to such a
        cell; or the share of the owner's cells that were met on the way, where that is more: the
        side that saw less of the object decides.

        Returns:
            The S owners that any set met, ascending, and the shares (n, S) float64 in [0, 1].
        """
        owners, shares = _shares(
            self._keys, self._masks, self._owners, self._marks, self._counts, self._used, *sets
        )
        return owners.tolist(), shares

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
        lost = _contest(
            self._keys,
            self._masks,
            self._owners,
            self._marks,
            self._counts,
            self._used,
            np.array(owners, np.int64),
            *sets,
            least_share,
        )
        losers = np.flatnonzero(lost)
        shares = lost[losers] / (lost[losers] + self._counts[losers])
        return dict(zip(losers.tolist(), shares.tolist()))

    def holds(self, owner: int, points: Float32) -> Bool:
        """Which of the points (k, 3), metres, lie in cells of an owner, (k,)."""
        held: Bool = _holds(self._keys, self._masks, self._owners, owner, points, self.cell_m)
        return held

    def remove(self, owner: int) -> CellSets:
        """Forget an owner; returns the cells it had, as one set."""
        cells = self.cells(owner)
        _, slots = self._slots_of(owner)
        self._masks[slots] = 0
        self._owners[slots] = -1
        if self._blocks_of.pop(owner, None) is not None:
            self._counts[owner] = 0
        return cells

    def _slots_of(self, owner: int) -> tuple[Int64, Int64]:
        """Blocks that an owner has cells in, and the slots of these."""
        blocks = np.concatenate([np.zeros(0, np.int64), *self._blocks_of.get(owner, [])])
        return blocks, _slots_of(self._keys, self._owners, owner, blocks)

    def _make_room(self, owner_count: int) -> None:
        if owner_count > len(self._counts):
            self._counts = np.pad(self._counts, (0, 2 * owner_count - len(self._counts)))

    def _allocate(self, capacity: int) -> None:
        # A slot is an owner's cells in a block. The slots of a block lie between the place where it
        # belongs and the next empty slot.
        self._keys = np.full(capacity, _EMPTY, np.int64)
        self._masks = np.zeros(capacity, np.uint64)
        self._owners: Int32 = np.full(capacity, -1, np.int32)
        # Cells of each slot that a query has met; zero between queries.
        self._marks = np.zeros(capacity, np.uint64)

    def _grow(self, more_slots: int) -> None:
        keys, masks, owners = self._keys, self._masks, self._owners
        # The slots of owners that are gone are left behind.
        slots = np.count_nonzero(owners >= 0) + more_slots
        capacity = len(keys)
        while capacity < 3 * slots:
            capacity *= 2
        self._allocate(capacity)
        self._used = _rehash(keys, masks, owners, self._keys, self._masks, self._owners)


@kernel
def _place(keys: Int64, block: np.int64) -> int:
    """Slot where a block belongs; it is in this or one of the next before an empty one."""
    mixed = np.uint64(block) * np.uint64(0x9E3779B97F4A7C15)
    return int(np.int64(mixed >> np.uint64(32)) & (len(keys) - 1))


@kernel
def _count(mask: np.uint64) -> int:
    """Number of bits that are set."""
    mask -= (mask >> np.uint64(1)) & np.uint64(0x5555555555555555)
    pairs = np.uint64(0x3333333333333333)
    mask = (mask & pairs) + ((mask >> np.uint64(2)) & pairs)
    mask = (mask + (mask >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int(np.int64((mask * np.uint64(0x0101010101010101)) >> np.uint64(56)))


@kernel
def _turned(mask: np.uint64, by: np.uint64) -> np.uint64:
    return (mask >> by) | (mask << (np.uint64(64) - by))


@kernel
def _grown(mask: np.uint64) -> np.uint64:
    """Cells of a block with those of the same block that share a face with them."""
    z, y, x = np.uint64(1), np.uint64(4), np.uint64(16)
    grown = mask | (mask << x) | (mask >> x)
    grown |= ((mask & ~_FACES[0]) << z) | ((mask & ~_FACES[1]) >> z)
    return np.uint64(grown | ((mask & ~_FACES[2]) << y) | ((mask & ~_FACES[3]) >> y))


@kernel
def _cell_of(point: Float32, cells_per_m: float) -> tuple[np.int64, np.uint64]:
    """Block and bit of the cell of a point; block -1 where it is too far away."""
    block = np.int64(0)
    bit = np.int64(0)
    inside = True
    for axis in range(3):
        step = np.int64(np.floor(np.float64(point[axis]) * cells_per_m)) + _BIAS
        inside = bool(inside and 0 <= step < 2 * _BIAS)
        block = (block << 21) | (step >> 2)
        bit = (bit << 2) | (step & 3)
    return (block if inside else np.int64(-1)), np.uint64(1) << np.uint64(bit)


@kernel
def _holds(
    keys: Int64, masks: UInt64, owners: Int32, owner: int, points: Float32, cell_m: float
) -> Bool:
    held = np.zeros(len(points), np.bool_)
    for index in range(len(points)):
        block, bit = _cell_of(points[index], 1.0 / cell_m)
        slot = _place(keys, block)
        while keys[slot] != -1:
            if keys[slot] == block and owners[slot] == owner:
                held[index] = masks[slot] & bit != 0
            slot = (slot + 1) & (len(keys) - 1)
    return held


@kernel
def _cells_of(points: Float32, starts: Int64, cell_m: float) -> tuple[Int64, UInt64, Int64]:
    blocks = np.empty(len(points), np.int64)
    masks = np.zeros(len(points), np.uint64)
    new_starts = np.zeros(len(starts), np.int64)
    kept = 0
    cells_per_m = 1.0 / cell_m
    for index in range(len(starts) - 1):
        capacity = 16
        while capacity < 2 * (starts[index + 1] - starts[index]):
            capacity *= 2
        # Where each block is kept, by hash.
        known = np.full(capacity, -1, np.int64)
        for point in range(starts[index], starts[index + 1]):
            block, bit = _cell_of(points[point], cells_per_m)
            if block < 0:
                continue
            place = _place(known, block)
            while known[place] >= 0 and blocks[known[place]] != block:
                place = (place + 1) & (capacity - 1)
            if known[place] < 0:
                known[place] = kept
                blocks[kept] = block
                kept += 1
            masks[known[place]] |= bit
        new_starts[index + 1] = kept
    return blocks[:kept].copy(), masks[:kept].copy(), new_starts


@kernel
def _add(
    keys: Int64,
    masks: UInt64,
    owners: Int32,
    counts: Int64,
    limit: int,
    used: int,
    who: Int64,
    blocks: Int64,
    set_masks: UInt64,
    starts: Int64,
) -> tuple[Int64, Int64, int]:
    new = np.empty(len(blocks), np.int64)
    new_starts = np.zeros(len(starts), np.int64)
    new_count = 0
    for index in range(len(who)):
        owner = who[index]
        for at in range(starts[index], starts[index + 1]):
            own = free = -1
            # Bits of the number of owners of each cell, which is at most four.
            ones = twos = fours = np.uint64(0)
            slot = _place(keys, blocks[at])
            while keys[slot] != -1:
                if owners[slot] < 0:
                    free = slot
                elif keys[slot] == blocks[at]:
                    if owners[slot] == owner:
                        own = slot
                    carried = ones & masks[slot]
                    ones ^= masks[slot]
                    fours |= twos & carried
                    twos ^= carried
                slot = (slot + 1) & (len(keys) - 1)
            # Four nodes may know a cell; a fifth does not.
            seen = set_masks[at] & ~fours
            if own >= 0:
                seen &= ~masks[own]
            while _count(seen) > limit - counts[owner]:
                seen &= seen - np.uint64(1)
            if seen == 0:
                continue
            if own < 0:
                own = slot if free < 0 else free
                used += int(free < 0)
                keys[own] = blocks[at]
                owners[own] = owner
                new[new_count] = blocks[at]
                new_count += 1
            masks[own] |= seen
            counts[owner] += _count(seen)
        new_starts[index + 1] = new_count
    return new[:new_count].copy(), new_starts, used


@kernel
def _shares(
    keys: Int64,
    masks: UInt64,
    owners: Int32,
    marks: UInt64,
    counts: Int64,
    used: int,
    blocks: Int64,
    set_masks: UInt64,
    starts: Int64,
) -> tuple[Int64, Float64]:
    set_count = len(starts) - 1
    on_owner = np.zeros((set_count, len(counts)), np.int64)
    of_owner = np.zeros((set_count, len(counts)), np.int64)
    met = np.zeros(len(counts), np.bool_)
    # Cells of the present block of the set that lie on an owner, and which owners these are.
    on_block = np.zeros(len(counts), np.uint64)
    block_owners = np.empty(len(counts), np.int64)
    marked = np.empty(used, np.int64)
    for index in range(set_count):
        marked_count = 0
        for at in range(starts[index], starts[index + 1]):
            owner_count = 0
            # The block itself, then those that the set's cells touch through its faces.
            for face in range(-1, 6):
                block = blocks[at]
                touching = _grown(set_masks[at])
                if face >= 0:
                    block += _STEPS[face]
                    touching = _turned(set_masks[at] & _FACES[face], _TURNS[face])
                    if touching == 0:
                        continue
                slot = _place(keys, block)
                while keys[slot] != -1:
                    of_block = touching & masks[slot]
                    if keys[slot] == block and of_block != 0:
                        owner = owners[slot]
                        if marks[slot] == 0:
                            marked[marked_count] = slot
                            marked_count += 1
                        marks[slot] |= of_block
                        if on_block[owner] == 0:
                            block_owners[owner_count] = owner
                            owner_count += 1
                        if face >= 0:
                            on_block[owner] |= _turned(of_block, np.uint64(64) - _TURNS[face])
                        else:
                            on_block[owner] |= _grown(masks[slot]) & set_masks[at]
                    slot = (slot + 1) & (len(keys) - 1)
            for place in range(owner_count):
                owner = block_owners[place]
                on_owner[index, owner] += _count(on_block[owner])
                on_block[owner] = 0
                met[owner] = True
        for place in range(marked_count):
            slot = marked[place]
            of_owner[index, owners[slot]] += _count(marks[slot])
            marks[slot] = 0
    columns = np.flatnonzero(met)
    shares = np.zeros((set_count, len(columns)))
    for index in range(set_count):
        cell_count = 0
        for at in range(starts[index], starts[index + 1]):
            cell_count += _count(set_masks[at])
        for column in range(len(columns)):
            owner = columns[column]
            if on_owner[index, owner] > 0:
                share = on_owner[index, owner] / cell_count
                if counts[owner] >= MIN_REVERSE_CELLS:
                    share = max(share, of_owner[index, owner] / counts[owner])
                shares[index, column] = share
    return columns, shares


@kernel
def _near(block: np.int64, blocks: Int64, set_masks: UInt64, start: int, stop: int) -> np.uint64:
    """Cells of a block that are in a set, or have a face next to one that is."""
    near = np.uint64(0)
    for at in range(start, stop):
        if blocks[at] == block:
            near |= _grown(set_masks[at])
        for face in range(6):
            if blocks[at] + _STEPS[face] == block:
                near |= _turned(set_masks[at] & _FACES[face], _TURNS[face])
    return near


@kernel
def _contest(
    keys: Int64,
    masks: UInt64,
    owners: Int32,
    marks: UInt64,
    counts: Int64,
    used: int,
    who: Int64,
    blocks: Int64,
    set_masks: UInt64,
    starts: Int64,
    least_share: float,
) -> Int64:
    set_of = np.full(len(counts), -1, np.int64)
    for index in range(len(who)):
        if who[index] >= 0:
            set_of[who[index]] = index
    lost = np.zeros(len(counts), np.int64)
    marked = np.empty(used, np.int64)
    marked_count = 0
    for index in range(len(who)):
        for at in range(starts[index], starts[index + 1]):
            slot = _place(keys, blocks[at])
            while keys[slot] != -1:
                owner = owners[slot]
                shown = set_masks[at] & masks[slot] & ~marks[slot]
                if (
                    keys[slot] == blocks[at]
                    and shown != 0
                    and owner != who[index]
                    and set_of[owner] >= 0
                ):
                    start, stop = starts[set_of[owner]], starts[set_of[owner] + 1]
                    shown &= ~_near(blocks[at], blocks, set_masks, start, stop)
                    if shown != 0 and marks[slot] == 0:
                        marked[marked_count] = slot
                        marked_count += 1
                    marks[slot] |= shown
                    lost[owner] += _count(shown)
                slot = (slot + 1) & (len(keys) - 1)
    for owner in range(len(counts)):
        if lost[owner] <= least_share * counts[owner]:
            lost[owner] = 0
    for index in range(marked_count):
        slot = marked[index]
        if lost[owners[slot]] > 0:
            masks[slot] &= ~marks[slot]
        marks[slot] = 0
    for owner in range(len(counts)):
        counts[owner] -= lost[owner]
    return lost


@kernel
def _slots_of(keys: Int64, owners: Int32, owner: int, blocks: Int64) -> Int64:
    slots = np.empty(len(blocks), np.int64)
    for index in range(len(blocks)):
        slot = _place(keys, blocks[index])
        while keys[slot] != blocks[index] or owners[slot] != owner:
            slot = (slot + 1) & (len(keys) - 1)
        slots[index] = slot
    return slots


@kernel
def _rehash(
    keys: Int64, masks: UInt64, owners: Int32, new_keys: Int64, new_masks: UInt64, new_owners: Int32
) -> int:
    used = 0
    for slot in range(len(keys)):
        if owners[slot] < 0:
            continue
        place = _place(new_keys, keys[slot])
        while new_keys[place] != -1:
            place = (place + 1) & (len(new_keys) - 1)
        new_keys[place] = keys[slot]
        new_masks[place] = masks[slot]
        new_owners[place] = owners[slot]
        used += 1
    return used
