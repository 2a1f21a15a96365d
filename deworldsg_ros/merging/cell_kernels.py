"""Compiled kernels of the surface map (`surface_map`), and the arrays they work on.

Space is divided into cells, and 4 x 4 x 4 cells are a block. The 64 cells of a block are the bits
of a uint64 mask: bit 16 x + 4 y + z. Adjacent cells are then found by shifts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int8, Int32, Int64, UInt64

# Cell indices lie in ±2^20: with cells of 3 cm, 31 km around the origin.
INDEX_BIAS = 1 << 20
INDEX_MASK = (1 << 21) - 1
# An owner with fewer cells says too little by lying within a set.
MIN_OWNER_CELLS = 4
# Scores of a cell: that it is its owner's surface, by surface points and images; by images alone.
SURFACE, SHOWN = range(2)
SCORES = 2
# A block and the touching cells of its six neighbours have 160 cells with four owners each.
MAX_BLOCK_OWNERS = 640
# The six faces of a block. For each face: its cells, the rotation to the right that turns their
# bits into the bits of the cells that they touch in the adjacent block, and the step to that block.
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
_ROTATIONS = np.array([3, 61, 12, 52, 48, 16], np.uint64)
_STEPS = np.array([1, -1, 1 << 21, -(1 << 21), 1 << 42, -(1 << 42)], np.int64)
# Fibonacci hashing: the upper bits of the product depend on all bits of a block.
_GOLDEN_RATIO = np.uint64(0x9E3779B97F4A7C15)


class CellSets(NamedTuple):
    """Cells of n sets of points, one set after the other.

    Attributes:
        blocks: (m,) int64, packed block indices; those of set k, all different, are
            blocks[starts[k] : starts[k + 1]].
        masks: (m,) uint64, the cells in each block.
        starts: (n + 1,) int64.
    """

    blocks: Int64
    masks: UInt64
    starts: Int64


class CellTable(NamedTuple):
    """Hash table of cells. A row holds the cells of one owner in one block.

    Rows are in the order in which they came, so those of one owner mostly lie together. The slots
    of a block lie between its home slot and the next empty slot.

    Attributes:
        slots: (capacity,) int32, row of each slot; -1 = empty. All others have a value of each row,
            and room for half as many rows as slots: what is not used takes no memory.
        blocks: (n,) int64.
        masks: (n,) uint64, cells in the block.
        owners: (n,) int32; -1 = removed.
        marks: (n,) uint64, cells that a query has met; zero between queries.
        rejected: (n,) uint64, cells with a negative score `SURFACE`.
        scores: (n, SCORES, 64) int8, evidence on each cell of the owner (`surface_map`). It stays
            when the owner loses the cell.
        nexts: (n,) int32, next row of the same owner; -1 = none.
    """

    slots: Int32
    blocks: Int64
    masks: UInt64
    owners: Int32
    marks: UInt64
    rejected: UInt64
    scores: Int8
    nexts: Int32


# The kernels take the same arrays as plain tuples: numba is slower to call with named ones.
TableArrays = tuple[Int32, Int64, UInt64, Int32, UInt64, UInt64, Int8, Int32]
SetArrays = tuple[Int64, UInt64, Int64]
# Sums of a query by owner, zero between queries: cells of a block of the set that lie on the owner;
# number of cells of the set on the owner, and of the owner on the set.
SumArrays = tuple[UInt64, Int64, Int64]


def new_table(capacity: int) -> CellTable:
    """An empty table; the capacity is a power of two."""
    room = capacity // 2
    return CellTable(
        np.full(capacity, -1, np.int32),
        np.zeros(room, np.int64),
        np.zeros(room, np.uint64),
        np.zeros(room, np.int32),
        np.zeros(room, np.uint64),
        np.zeros(room, np.uint64),
        np.zeros((room, SCORES, 64), np.int8),
        np.zeros(room, np.int32),
    )


@kernel
def _home_slot(slots: Int32, block: np.int64) -> int:
    """First slot in which a block may lie."""
    mixed = np.uint64(block) * _GOLDEN_RATIO
    return int(np.int64(mixed >> np.uint64(32)) & (len(slots) - 1))


@kernel
def bit_count(mask: np.uint64) -> int:
    """Number of set bits."""
    mask -= (mask >> np.uint64(1)) & np.uint64(0x5555555555555555)
    pairs = np.uint64(0x3333333333333333)
    mask = (mask & pairs) + ((mask >> np.uint64(2)) & pairs)
    mask = (mask + (mask >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int(np.int64((mask * np.uint64(0x0101010101010101)) >> np.uint64(56)))


@kernel
def _dilated(mask: np.uint64) -> np.uint64:
    """Cells of a block, and the cells of the same block that share a face with them."""
    z, y, x = np.uint64(1), np.uint64(4), np.uint64(16)
    dilated = mask | (mask << x) | (mask >> x)
    dilated |= ((mask & ~_FACES[0]) << z) | ((mask & ~_FACES[1]) >> z)
    return np.uint64(dilated | ((mask & ~_FACES[2]) << y) | ((mask & ~_FACES[3]) >> y))


@kernel
def _cell_of(point: Float32, cells_per_m: float) -> tuple[np.int64, np.uint64]:
    """Block and bit of the cell of a point; block -1 if it is beyond the map."""
    block = np.int64(0)
    bit = np.int64(0)
    inside = True
    for axis in range(3):
        step = np.int64(np.floor(np.float64(point[axis]) * cells_per_m)) + INDEX_BIAS
        inside = bool(inside and 0 <= step < 2 * INDEX_BIAS)
        block = (block << 21) | (step >> 2)
        bit = (bit << 2) | (step & 3)
    return (block if inside else np.int64(-1)), np.uint64(1) << np.uint64(bit)


@kernel
def cells_of(points: Float32, starts: Int64, cell_m: float) -> tuple[Int64, UInt64, Int64]:
    """Arrays of the `CellSets` of sets of points; set k is points[starts[k] : starts[k + 1]]."""
    blocks = np.empty(len(points), np.int64)
    masks = np.zeros(len(points), np.uint64)
    new_starts = np.zeros(len(starts), np.int64)
    count = 0
    cells_per_m = 1.0 / cell_m
    for index in range(len(starts) - 1):
        capacity = 16
        while capacity < 2 * (starts[index + 1] - starts[index]):
            capacity *= 2
        # Position of each block in `blocks`, by hash.
        known = np.empty(capacity, np.int32)
        for slot in range(capacity):
            known[slot] = -1
        for point in range(starts[index], starts[index + 1]):
            block, bit = _cell_of(points[point], cells_per_m)
            if block < 0:
                continue
            slot = _home_slot(known, block)
            while known[slot] >= 0 and blocks[known[slot]] != block:
                slot = (slot + 1) & (capacity - 1)
            if known[slot] < 0:
                known[slot] = count
                blocks[count] = block
                count += 1
            masks[known[slot]] |= bit
        new_starts[index + 1] = count
    return blocks[:count].copy(), masks[:count].copy(), new_starts


@kernel
def add(
    table: TableArrays,
    counts: Int64,
    firsts: Int64,
    max_cells: int,
    used: int,
    owners: Int64,
    sets: SetArrays,
) -> int:
    """Add the cells of each set to its owner.

    Args:
        table: with room for all blocks of the sets.
        counts: number of cells of each owner; updated.
        firsts: first row of each owner, -1 = none; updated.
        max_cells: of an owner.
        used: number of rows.
        owners: (n,) owner of each set.
        sets: n sets.

    Returns:
        The new `used`.
    """
    slots, blocks, masks, row_owners, _, _, _, nexts = table
    set_blocks, set_masks, starts = sets
    for index in range(len(owners)):
        owner = owners[index]
        for at in range(starts[index], starts[index + 1]):
            # The owner's row of the block, and a removed row; -1 = none.
            row = removed = -1
            # The three bits of the number of owners of each cell.
            ones = twos = fours = np.uint64(0)
            slot = _home_slot(slots, set_blocks[at])
            while slots[slot] != -1:
                other = slots[slot]
                if row_owners[other] < 0:
                    removed = other
                elif blocks[other] == set_blocks[at]:
                    if row_owners[other] == owner:
                        row = other
                    carried = ones & masks[other]
                    ones ^= masks[other]
                    fours |= twos & carried
                    twos ^= carried
                slot = (slot + 1) & (len(slots) - 1)
            # A cell keeps four owners; a fifth is not recorded.
            cells = set_masks[at] & ~fours
            if row >= 0:
                cells &= ~masks[row]
            while bit_count(cells) > max_cells - counts[owner]:
                cells &= cells - np.uint64(1)
            if cells == 0:
                continue
            if row < 0:
                row = removed
                if removed < 0:
                    row = slots[slot] = used
                    used += 1
                blocks[row] = set_blocks[at]
                row_owners[row] = owner
                nexts[row] = firsts[owner]
                firsts[owner] = row
            masks[row] |= cells
            counts[owner] += bit_count(cells)
    return used


@kernel
def rows_at(table: TableArrays, owners: Int64, sets: SetArrays) -> Int64:
    """The owner's row of each block of its set; -1 = none."""
    slots, row_blocks, _, row_owners, _, _, _, _ = table
    blocks, _, starts = sets
    rows = np.empty(len(blocks), np.int64)
    for index in range(len(owners)):
        for at in range(starts[index], starts[index + 1]):
            rows[at] = -1
            slot = _home_slot(slots, blocks[at])
            while slots[slot] != -1:
                row = slots[slot]
                if row_blocks[row] == blocks[at] and row_owners[row] == owners[index]:
                    rows[at] = row
                    break
                slot = (slot + 1) & (len(slots) - 1)
    return rows


@kernel
def points_in(points: Float32, counts: Int64, rows: Int64, sets: SetArrays, cell_m: float) -> Bool:
    """Which of the first points of n rows lie in a cell of the row's set.

    Args:
        points: (S, K, 3) metres.
        counts: (S,) number of points of each row.
        rows: (n,) rows.
        sets: n sets.
        cell_m: edge of a cell, metres.

    Returns:
        (n, K) bool.
    """
    blocks, set_masks, starts = sets
    inside = np.zeros((len(rows), points.shape[1]), np.bool_)
    cells_per_m = 1.0 / cell_m
    for index in range(len(rows)):
        # Most points are in no block of the set, and most of them need no comparison.
        hashes = np.uint64(0)
        for at in range(starts[index], starts[index + 1]):
            hashes |= np.uint64(1) << (np.uint64(blocks[at]) * _GOLDEN_RATIO >> np.uint64(58))
        row = rows[index]
        for place in range(counts[row] if hashes != 0 else 0):
            block, bit = _cell_of(points[row, place], cells_per_m)
            hashed = np.uint64(1) << (np.uint64(block) * _GOLDEN_RATIO >> np.uint64(58))
            if hashes & hashed == 0:
                continue
            for at in range(starts[index], starts[index + 1]):
                inside[index, place] |= blocks[at] == block and set_masks[at] & bit != 0
    return inside


@kernel
def overlaps(
    table: TableArrays, counts: Int64, sums: SumArrays, used: int, sets: SetArrays
) -> tuple[Int64, Float64, Float64]:
    """Owners that any set meets, and the overlap fractions; see `VoxelMap.overlaps`."""
    owners, marks = table[3], table[4]
    blocks, set_masks, starts = sets
    on_block, on_owner, of_owner = sums
    set_count = len(starts) - 1
    # For each set and owner that meet: both, and the two numbers of cells. Most rows are not used,
    # and take no memory.
    most = min(set_count * len(counts), len(blocks) * MAX_BLOCK_OWNERS)
    found, total = np.empty((most, 4), np.int64), 0
    block_owners = np.empty(MAX_BLOCK_OWNERS, np.int64)
    most = 0
    for index in range(set_count):
        most = max(most, int(starts[index + 1] - starts[index]))
    marked = np.empty(min(used, most * MAX_BLOCK_OWNERS), np.int64)
    for index in range(set_count):
        # Numba would compile the kernels that it calls once more for a literal.
        marked_count, first = int(np.int64(0)), total
        for at in range(starts[index], starts[index + 1]):
            owner_count, marked_count = _meet(
                table, blocks[at], set_masks[at], on_block, block_owners, marked, marked_count
            )
            for position in range(owner_count):
                owner = block_owners[position]
                if on_block[owner] != 0 and on_owner[owner] == 0:
                    found[total, 0], found[total, 1] = index, owner
                    total += 1
                on_owner[owner] += bit_count(on_block[owner])
                on_block[owner] = 0
        for position in range(marked_count):
            row = marked[position]
            of_owner[owners[row]] += bit_count(marks[row])
            marks[row] = 0
        for row in range(first, total):
            owner = found[row, 1]
            found[row, 2], found[row, 3] = on_owner[owner], of_owner[owner]
            on_owner[owner] = of_owner[owner] = 0
    # The owners that any set meets, ascending, and the column of each.
    columns, count, column_of = np.empty(total, np.int64), 0, on_owner
    for row in range(total):
        owner, column = found[row, 1], count
        if column_of[owner] == 0:
            while column > 0 and columns[column - 1] > owner:
                columns[column] = columns[column - 1]
                column -= 1
            columns[column], column_of[owner] = owner, 1
            count += 1
    for column in range(count):
        column_of[columns[column]] = column
    on_fractions = np.zeros((set_count, count), np.float64)
    of_fractions = np.zeros((set_count, count), np.float64)
    cell_counts = np.zeros(set_count, np.float64)
    for index in range(set_count):
        for at in range(starts[index], starts[index + 1]):
            cell_counts[index] += bit_count(set_masks[at])
    for row in range(total):
        index, owner = found[row, 0], found[row, 1]
        column = column_of[owner]
        on_fractions[index, column] = found[row, 2] / cell_counts[index]
        if counts[owner] >= MIN_OWNER_CELLS:
            of_fractions[index, column] = found[row, 3] / counts[owner]
    for column in range(count):
        column_of[columns[column]] = 0
    return columns[:count], on_fractions, of_fractions


@kernel
def _meet(
    table: TableArrays,
    set_block: np.int64,
    set_mask: np.uint64,
    on_block: UInt64,
    block_owners: Int64,
    marked: Int64,
    marked_count: int,
) -> tuple[int, int]:
    """Record the owners that the cells of one block of a set meet, in it or through a face.

    Returns:
        The number of owners, and the new number of marked rows.
    """
    slots, blocks, masks, owners, marks, _, _, _ = table
    owner_count = 0
    # The block itself (-1), then the adjacent blocks that the cells touch through a face.
    for face in range(-1, 6):
        block = set_block
        touching = _dilated(set_mask)
        if face >= 0:
            block += _STEPS[face]
            right, left = _ROTATIONS[face], np.uint64(64) - _ROTATIONS[face]
            touching = set_mask & _FACES[face]
            touching = (touching >> right) | (touching << left)
            if touching == 0:
                continue
        slot = _home_slot(slots, block)
        while slots[slot] != -1:
            row = slots[slot]
            cells = touching & masks[row]
            if blocks[row] == block and cells != 0:
                owner = owners[row]
                if marks[row] == 0:
                    marked[marked_count] = row
                    marked_count += 1
                marks[row] |= cells
                if on_block[owner] == 0:
                    block_owners[owner_count] = owner
                    owner_count += 1
                if face >= 0:
                    on_block[owner] |= (cells << right) | (cells >> left)
                else:
                    on_block[owner] |= _dilated(masks[row]) & set_mask
            slot = (slot + 1) & (len(slots) - 1)
    return owner_count, marked_count


@kernel
def rehash(table: TableArrays, used: int, larger: TableArrays, firsts: Int64) -> int:
    """Copy all rows with an owner to an empty table; returns their number.

    `firsts`, the first row of each owner, is updated.
    """
    _, blocks, masks, owners, _, rejected, scores, _ = table
    slots, new_blocks, new_masks, new_owners, _, new_rejected, new_scores, new_nexts = larger
    count = 0
    for owner in range(len(firsts)):
        firsts[owner] = -1
    for row in range(used):
        owner = owners[row]
        if owner < 0:
            continue
        slot = _home_slot(slots, blocks[row])
        while slots[slot] != -1:
            slot = (slot + 1) & (len(slots) - 1)
        slots[slot] = count
        new_blocks[count] = blocks[row]
        new_masks[count] = masks[row]
        new_owners[count] = owner
        new_rejected[count] = rejected[row]
        for score in range(SCORES):
            for cell in range(64):
                new_scores[count, score, cell] = scores[row, score, cell]
        new_nexts[count] = firsts[owner]
        firsts[owner] = count
        count += 1
    return count
