"""Surface map: the cells of space that the surface of each node passes through."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from deworldsg_ros.base.array_file import Arrays
from deworldsg_ros.base.kernels import kernel
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.merging import cell_kernels
from deworldsg_ros.merging.cell_kernels import (
    INDEX_BIAS,
    INDEX_MASK,
    SHOWN,
    SURFACE,
    CellSets,
    SumArrays,
    TableArrays,
    bit_count,
)
from deworldsg_ros.merging.views import NEAR_M, FrameArrays
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int8, Int64, UInt64

# --- Evidence that a cell of an owner is its surface: how many of the frames that saw it say so.
#
# A mask may include a part of another object, or of the floor. Its cells are then cells of the
# owner. So each cell has a score. A frame that shows the owner and the cell raises the score if the
# pixel of the cell is in the owner's mask, and lowers it if not. Cells with a negative score are
# rejected.

# A cell is rejected if less than 60 % of the frames that saw it say that it is the owner's. With
# 50 %, more of a bleeding mask stays; with 67 %, more of the true surface is lost if masks are cut
# (docs/dev/notebook.md).
HIT = 2
MISS = 3
# Bounds of a score, so that a cell can be rejected or accepted again: 60 hits, 40 misses.
MAX_SCORE = 120
# A box is around the cells that the images alone show as the owner's, in three frames of four and
# at least four. A surface point is no evidence here: it hits its cell whatever the image says, and
# so do those of a bleeding mask. Cells of a younger owner need less.
HIT_SHOWN = 1
MISS_SHOWN = 3
LEAST_SHOWN = 4
# A frame shows a cell if the measured depth differs from that of its centre by at most SHOWN_M and
# SHOWN_FRACTION of it: the distance of a cell's corner from its centre, and the noise of cameras.
SHOWN_M = 0.03
SHOWN_FRACTION = 0.01


@kernel
def judge(
    table: TableArrays,
    firsts: Int64,
    owners: Int64,
    values: Int64,
    frame: FrameArrays,
    cell_m: float,
) -> tuple[Int64, UInt64, Int64]:
    """Update the scores of all cells of some owners by one frame.

    Args:
        table: marked cells are hit, whatever the images say; the marks are removed.
        firsts: first row of each owner.
        owners: (n,) owners that the frame shows.
        values: (n,) value of each in the instance image.
        frame: the frame.
        cell_m: edge of a cell, metres.

    Returns:
        Arrays of the `CellSets` of each owner's cells that this frame has rejected, and of its
        rejected cells that were marked.
    """
    _, row_blocks, masks, _, marks, rejected, scores, nexts = table
    # Position of each cell of a block from its first one, in camera axes, metres.
    T, offsets = frame[0], np.empty((64, 3), np.float64)
    for cell in range(64):
        for axis in range(3):
            steps = T[axis, 0] * (cell >> 4) + T[axis, 1] * ((cell >> 2) & 3)
            offsets[cell, axis] = cell_m * (steps + T[axis, 2] * (cell & 3))
    most = 0
    for index in range(len(owners)):
        row = firsts[owners[index]]
        while row >= 0:
            row = nexts[row]
            most += 1
    blocks, cells = np.empty(most, np.int64), np.empty(most, np.uint64)
    starts = np.zeros(len(owners) + 1, np.int64)
    count = 0
    for index in range(len(owners)):
        row = firsts[owners[index]]
        while row >= 0:
            marked = masks[row] & marks[row]
            marks[row] = 0
            changed, lost = _judge_block(
                row_blocks[row],
                masks[row],
                marked,
                scores[row],
                values[index],
                frame,
                offsets,
                cell_m,
            )
            dropped = (lost & ~rejected[row]) | (lost & marked)
            rejected[row] = (rejected[row] & ~changed) | lost
            if dropped != 0:
                blocks[count], cells[count] = row_blocks[row], dropped
                count += 1
            row = nexts[row]
        starts[index + 1] = count
    return blocks[:count].copy(), cells[:count].copy(), starts


@kernel
def _judge_block(
    block: np.int64,
    cells: np.uint64,
    marked: np.uint64,
    scores: Int8,
    value: int,
    frame: FrameArrays,
    offsets: Float64,
    cell_m: float,
) -> tuple[np.uint64, np.uint64]:
    """Update the scores (SCORES, 64) of the cells of a block that a frame shows.

    A marked cell is hit, and one in a pixel with this value; another one is missed.

    Returns:
        The cells whose score `SURFACE` was updated, and those of them with a negative one.
    """
    T, depth_mm, instances, (fx, fy, cx, cy) = frame
    rows, columns = depth_mm.shape
    changed = lost = np.uint64(0)
    # Centre of the block's first cell.
    x = cell_m * (4 * (block >> 42) - INDEX_BIAS + 0.5)
    y = cell_m * (4 * ((block >> 21) & INDEX_MASK) - INDEX_BIAS + 0.5)
    z = cell_m * (4 * (block & INDEX_MASK) - INDEX_BIAS + 0.5)
    right = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    down = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    ahead = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    while cells != 0:
        bit = cells & (~cells + np.uint64(1))
        cells ^= bit
        cell = bit_count(bit - np.uint64(1))
        depth_m = ahead + offsets[cell, 2]
        shown = is_own = False
        if depth_m >= NEAR_M:
            u = fx * (right + offsets[cell, 0]) / depth_m + cx
            v = fy * (down + offsets[cell, 1]) / depth_m + cy
            if u >= 0.0 and v >= 0.0 and u < columns and v < rows:
                row, column = int(v), int(u)
                apart_m = abs(0.001 * depth_mm[row, column] - depth_m)
                shown = apart_m <= SHOWN_M + SHOWN_FRACTION * depth_m
                is_own = shown and instances[row, column] == value
        if shown:
            score = scores[SHOWN, cell] + (HIT_SHOWN if is_own else -MISS_SHOWN)
            scores[SHOWN, cell] = min(max(score, -MAX_SCORE), MAX_SCORE)
        is_hit = is_own or marked & bit != 0
        if not shown and not is_hit:
            continue
        score = scores[SURFACE, cell] + (HIT if is_hit else -MISS)
        scores[SURFACE, cell] = min(max(score, -MAX_SCORE), MAX_SCORE)
        changed |= bit
        if score < 0:
            lost |= bit
    return changed, lost


# --- Surface map: the cells of space that the surface of each node passes through.
#
# The map is a sparse hash of small cubes. A cell keeps up to four nodes ("owners"). The cost of
# each operation is linear in the number of its points, and independent of the size of the map. Each
# cell of an owner has a score, the evidence that it is the owner's surface (above).

# Edge of a cell. In the rendered rooms, cells of 2 cm lose objects and cells of 5 cm lose relations
# (docs/dev/notebook.md).
CELL_M = 0.03
# At 3 cm, a surface of about 7 m²; larger surfaces are not stored in full.
CELLS_PER_OWNER = 8192


class VoxelMap:
    """Cells of the surfaces of nodes. The owner of a cell is the slot of a node.

    Args:
        cell_m: edge of a cell, metres.
        cells_per_owner: maximum number of cells of an owner; more cells are not stored.
    """

    def __init__(self, cell_m: float = CELL_M, cells_per_owner: int = CELLS_PER_OWNER) -> None:
        self.cell_m = cell_m
        self._cells_per_owner = cells_per_owner
        self._table = cell_kernels.new_table(1 << 12)
        # Rows of the table, also removed ones.
        self._used = 0
        # Number of cells of each owner, and its first row.
        self._counts = np.zeros(64, np.int64)
        self._firsts = np.full(64, -1, np.int64)
        self._sums = _new_sums(64)

    @property
    def capacity(self) -> int:
        """Number of slots, used or not."""
        return len(self._table.slots)

    def cells_of(self, point_sets: Sequence[Float32]) -> CellSets:
        """Cells of each set of points (k, 3), metres."""
        points = np.concatenate([np.zeros((0, 3), np.float32), *point_sets])
        starts = np.array([0, *accumulate(map(len, point_sets))])
        return CellSets(*cell_kernels.cells_of(points, starts, self.cell_m))

    def cells(self, owner: int) -> CellSets:
        """An owner's cells, as one set."""
        rows = self._rows_of(owner)
        blocks, masks = self._table.blocks[rows], self._table.masks[rows]
        return CellSets(blocks, masks, np.array([0, len(rows)]))

    def scores(self, owner: int) -> Int8:
        """Scores of each cell in each block of `cells` (m, SCORES, 64)."""
        return self._table.scores[self._rows_of(owner)]

    def memory(self, owners: Int64) -> Arrays:
        """The cells and scores of all owners as arrays by name; the blocks of each ascend.

        Args:
            owners: all owners, in the order of the arrays.
        """
        table, places = self._table, np.zeros(int(owners.max(initial=0)) + 1, np.int64)
        places[owners] = np.arange(len(owners))
        rows = np.flatnonzero(table.owners[: self._used] >= 0)
        of = places[table.owners[rows]]
        rows = rows[np.lexsort((table.blocks[rows], of))]
        return {
            "cell_m": np.array(self.cell_m),
            "blocks": table.blocks[rows],
            "masks": table.masks[rows],
            "block_counts": np.bincount(of, minlength=len(owners)),
            "scores": table.scores[rows],
        }

    def centres(self, owner: int) -> Float32:
        """Centres of an owner's cells, (n, 3) float32, metres."""
        rows = self._rows_of(owner)
        at, cells = np.nonzero(self._bits(rows))
        return self._centres(at, cells, rows)

    def take(self, owners: Int64) -> tuple[Int64, Float32, Int8]:
        """Remove n owners.

        Returns:
            Of each of m cells: its owner, as an index (m,), ascending; its centre (m, 3), metres;
            its scores (m, SCORES).
        """
        table, index_of = self._table, np.full(len(self._counts) + 1, -1)
        known = owners < len(self._counts)
        index_of[owners[known]] = np.flatnonzero(known)
        of = index_of[table.owners[: self._used]]  # that of no owner, -1, is the last: -1
        rows = np.flatnonzero(of >= 0)
        rows = rows[of[rows].argsort(kind="stable")]
        at, cells = np.nonzero(self._bits(rows))
        found = of[rows[at]], self._centres(at, cells, rows), table.scores[rows[at], :, cells]
        table.masks[rows] = table.rejected[rows] = 0
        table.scores[rows], table.owners[rows] = 0, -1
        self._counts[owners[known]], self._firsts[owners[known]] = 0, -1
        return found

    def put(self, owners: Int64, of: Int64, points: Float32, scores: Int8) -> None:
        """Give n owners the cells of points, with scores; of one cell, the highest scores count.

        Args:
            owners: (n,) owners.
            of: (m,) index of the owner of each point, ascending.
            points: (m, 3) metres.
            scores: (m, SCORES) int8.
        """
        starts: Int64 = of.searchsorted(np.arange(len(owners) + 1))
        self.add(owners, CellSets(*cell_kernels.cells_of(points, starts, self.cell_m)))
        steps = np.floor(points.astype(np.float64) * (1.0 / self.cell_m)).astype(np.int64)
        steps += INDEX_BIAS
        blocks: Int64 = (steps >> 2) @ np.array([1 << 42, 1 << 21, 1])
        within = (steps & 3) @ np.array([16, 4, 1])
        sets = CellSets(blocks, np.zeros(len(blocks), np.uint64), starts)
        rows = cell_kernels.rows_at(self._table[:], owners, sets[:])
        order = scores[:, SURFACE].argsort(kind="stable")
        order = order[rows[order] >= 0]
        self._table.scores[rows[order], :, within[order]] = scores[order]
        rows = np.unique(rows[order])
        self._table.rejected[rows] = _masks(self._table.scores[rows, SURFACE] < 0)

    def _bits(self, rows: Int64) -> UInt64:
        return cell_bits(self._table.masks[rows])

    def _centres(self, at: Int64, cells: Int64, rows: Int64) -> Float32:
        """Centres of the cells (n,) of blocks, by the index of their row."""
        blocks = self._table.blocks[rows]
        corners = np.stack([blocks >> 42, (blocks >> 21) & INDEX_MASK, blocks & INDEX_MASK], axis=1)
        within = np.stack([cells >> 4, (cells >> 2) & 3, cells & 3], axis=1)
        indices = 4 * corners[at] + within - INDEX_BIAS
        return ((indices + 0.5) * self.cell_m).astype(np.float32)

    def add(self, owners: Sequence[int] | Int64, sets: CellSets) -> None:
        """Add the cells of each set to its owner."""
        if not len(owners):
            return
        self._make_room(max(owners) + 1)
        if 2 * (self._used + len(sets.blocks)) > self.capacity:
            self._grow(len(sets.blocks))
        self._used = cell_kernels.add(
            self._table[:],
            self._counts,
            self._firsts,
            self._cells_per_owner,
            self._used,
            np.array(owners, np.int64),
            sets[:],
        )

    def add_scores(self, owners: Sequence[int] | Int64, sets: CellSets, scores: Int8) -> None:
        """Add to the scores of owners' cells, (m, SCORES, 64): of each block of their sets.

        Blocks without a cell of the owner are left out.
        """
        rows, known = self._rows_at(np.array(owners, np.int64), sets)
        sums = np.clip(self._table.scores[rows] + scores[known].astype(int), -MAX_SCORE, MAX_SCORE)
        self._table.scores[rows] = sums
        self._table.rejected[rows] = _masks(sums[:, SURFACE] < 0)

    def judge(
        self,
        owners: Int64,
        sets: CellSets,
        values: Int64,
        frame: FrameArrays,
    ) -> CellSets:
        """Update the scores of the cells of owners that a frame shows.

        Args:
            owners: n owners.
            sets: cells in which the frame shows each owner, and which it has (`add`).
            values: (n,) value of each owner in the instances of the frame.
            frame: with instances.

        Returns:
            For each owner, the cells that became rejected, and the rejected ones of its set.
        """
        rows, known = self._rows_at(owners, sets)
        self._table.marks[rows] = sets.masks[known]
        changed = judge(self._table[:], self._firsts, owners, values, frame, self.cell_m)
        return CellSets(*changed)

    def shown(self, owner: int) -> CellSets:
        """The cells that the images alone show as the owner's, as one set."""
        rows = self._rows_of(owner)
        scores = self._table.scores[rows]
        cells = (cell_bits(self._table.masks[rows]) > 0) & (scores[:, SURFACE] >= 0)
        shown = np.maximum(scores[:, SHOWN][cells], 0)
        # Thin and small things are in few pixels of the depth grid.
        least = min(LEAST_SHOWN, 0.25 * float(np.quantile(shown, 0.75))) if len(shown) else 0.0
        own = cells & (scores[:, SHOWN] >= least)
        return CellSets(self._table.blocks[rows], _masks(own), np.array([0, len(rows)]))

    def points_in(self, sets: CellSets, nodes: NodeTable, slots: Int64) -> Bool:
        """Which surface points of nodes lie in a cell of a set: (n, K), by slot and by set."""
        return cell_kernels.points_in(
            nodes.surface_points_world,
            nodes.surface_counts,
            slots,
            sets[:],
            self.cell_m,
        )

    def overlaps(self, sets: CellSets) -> tuple[Int64, Float64, Float64]:
        """How much of each set lies on each owner, and of each owner on each set.

        A cell lies on a surface if it is a cell of it or shares a face with one.

        Returns:
            The k owners that any set meets, ascending; and two fractions (n, k) float64 in [0, 1]:
            of the set's cells that lie on the owner, and of the owner's cells that lie on the set.
        """
        known = self._table[:], self._counts, self._sums, self._used
        return cell_kernels.overlaps(*known, sets[:])

    def remove(self, owner: int) -> CellSets:
        """Remove an owner; returns its cells, as one set."""
        cells = self.cells(owner)
        rows = self._rows_of(owner)
        self._table.masks[rows] = self._table.rejected[rows] = 0
        self._table.scores[rows] = 0
        self._table.owners[rows] = -1
        if len(rows):
            self._counts[owner], self._firsts[owner] = 0, -1
        return cells

    def warm_up(self) -> None:
        """Compile the kernels that the first frames do not need."""
        self._grow(0)
        self.add_scores([0], self.cells(0), self.scores(0))

    def _rows_of(self, owner: int) -> Int64:
        """Rows of an owner."""
        rows, row = [], int(self._firsts[owner]) if owner < len(self._firsts) else -1
        while row >= 0:
            rows.append(row)
            row = int(self._table.nexts[row])
        return np.array(rows, np.int64)

    def _rows_at(self, owners: Int64, sets: CellSets) -> tuple[Int64, Bool]:
        """Rows of the blocks of sets where the owner of the set has cells, and which blocks do."""
        rows = cell_kernels.rows_at(self._table[:], owners, sets[:])
        known = rows >= 0
        return rows[known], known

    def _make_room(self, owner_count: int) -> None:
        if owner_count > len(self._counts):
            more = (0, 2 * owner_count - len(self._counts))
            self._counts = np.pad(self._counts, more)
            self._firsts = np.pad(self._firsts, more, constant_values=-1)
            self._sums = _new_sums(len(self._counts))

    def _grow(self, more_rows: int) -> None:
        # Rows of removed owners are not copied.
        rows = np.count_nonzero(self._table.owners[: self._used] >= 0) + more_rows
        capacity = self.capacity
        while capacity < 3 * rows:
            capacity *= 2
        larger = cell_kernels.new_table(capacity)
        self._used = cell_kernels.rehash(self._table[:], self._used, larger[:], self._firsts)
        self._table = larger


def cell_bits(masks: UInt64) -> UInt64:
    """Which cells of blocks are in their masks (m,): (m, 64), 1 or 0."""
    bits: UInt64 = (masks[:, None] >> np.arange(64, dtype=np.uint64)) & np.uint64(1)
    return bits


def _masks(bits: Bool) -> UInt64:
    """One mask for each of m blocks, (m,); bits (m, 64) say which cells are in it."""
    return np.packbits(bits, axis=1, bitorder="little").view("<u8")[:, 0]


def _new_sums(owner_count: int) -> SumArrays:
    counts = np.zeros(owner_count, np.int64)
    return np.zeros(owner_count, np.uint64), counts, counts.copy()
