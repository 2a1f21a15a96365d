"""Surface map: the cells of space that the surface of each node passes through.

The map is a sparse hash of small cubes. A cell keeps up to four nodes ("owners"). The cost of each
operation is linear in the number of its points, and independent of the size of the map. Each cell
of an owner has a score, the evidence that it is the owner's surface (`cell_beliefs`).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from deworldsg_ros.merging import cell_beliefs, cell_kernels
from deworldsg_ros.merging.cell_kernels import INDEX_BIAS, INDEX_MASK, CellSets, SumArrays
from deworldsg_ros.merging.common import Memory
from deworldsg_ros.merging.views import FrameArrays
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int8, Int64, UInt64
from deworldsg_ros.scene.nodes import NodeTable

# Edge of a cell. In the rendered rooms, cells of 2 cm lose objects and cells of 5 cm lose relations
# (docs/dev/notebook.md).
CELL_M = 0.03
# At 3 cm, a surface of about 7 m²; larger surfaces are not stored in full.
CELLS_PER_OWNER = 8192


class VoxelMap:
    """Cells of the surfaces of nodes. Nodes are numbered by small owner indices.

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
        """Score of each cell in each block of `cells` (m, 64)."""
        return self._table.scores[self._rows_of(owner)]

    def memory(self, owners: Sequence[int]) -> Memory:
        """The cells and scores of all owners as arrays by name; the blocks of each ascend.

        Args:
            owners: all owners, in the order of the arrays.
        """
        table, places = self._table, np.zeros(max(owners, default=0) + 1, np.int64)
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
        blocks, masks, _ = self.cells(owner)
        rows, cells = np.nonzero(cell_bits(masks))
        corners = np.stack([blocks >> 42, (blocks >> 21) & INDEX_MASK, blocks & INDEX_MASK], axis=1)
        within = np.stack([cells >> 4, (cells >> 2) & 3, cells & 3], axis=1)
        indices = 4 * corners[rows] + within - INDEX_BIAS
        return ((indices + 0.5) * self.cell_m).astype(np.float32)

    def add(self, owners: Sequence[int], sets: CellSets) -> None:
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

    def add_scores(self, owners: Sequence[int], sets: CellSets, scores: Int8) -> None:
        """Add to the scores of owners' cells, (m, 64): those of each block of their sets.

        Blocks without a cell of the owner are left out.
        """
        owner_array, limit = np.array(owners, np.int64), cell_beliefs.MAX_SCORE
        cell_kernels.add_scores(self._table[:], owner_array, sets[:], scores, limit)

    def judge(
        self,
        owners: Sequence[int],
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
        owner_array = np.array(owners, np.int64)
        cell_kernels.mark(self._table[:], owner_array, sets[:])
        changed = cell_beliefs.judge(
            self._table[:], self._firsts, owner_array, values, frame, self.cell_m
        )
        return CellSets(*changed)

    def points_in(self, sets: CellSets, nodes: NodeTable, rows: Sequence[int]) -> Bool:
        """Which surface points of nodes lie in a cell of a set: (n, K), by row and by set."""
        return cell_kernels.points_in(
            nodes.surface_points_world,
            nodes.surface_counts,
            np.array(rows, np.int64),
            sets[:],
            self.cell_m,
        )

    def overlaps(self, sets: CellSets) -> tuple[list[int], Float64, Float64]:
        """How much of each set lies on each owner, and of each owner on each set.

        A cell lies on a surface if it is a cell of it or shares a face with one.

        Returns:
            The k owners that any set meets, ascending; and two fractions (n, k) float64 in [0, 1]:
            of the set's cells that lie on the owner, and of the owner's cells that lie on the set.
        """
        owners, on, of = cell_kernels.overlaps(
            self._table[:], self._counts, self._sums, self._used, sets[:]
        )
        return owners.tolist(), on, of

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
        first = int(self._firsts[owner]) if owner < len(self._firsts) else -1
        return cell_kernels.rows_of(self._table[:], first)

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


def _new_sums(owner_count: int) -> SumArrays:
    counts = np.zeros(owner_count, np.int64)
    return np.zeros(owner_count, np.uint64), counts, counts.copy()
