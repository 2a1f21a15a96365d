"""Evidence that a cell of an owner is its surface: how many of the frames that saw it say so.

A mask may include a part of another object, or of the floor. Its cells are then cells of the owner.
So each cell has a score. A frame that shows the owner and the cell raises the score if the pixel of
the cell is in the owner's mask, and lowers it if not. Cells with a negative score are rejected.
"""

from __future__ import annotations

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.merging.cell_kernels import INDEX_BIAS, INDEX_MASK, TableArrays
from deworldsg_ros.merging.views import NEAR_M, FrameArrays
from deworldsg_ros.scene.arrays import Float64, Int8, Int64, UInt64

# A cell is rejected if less than 60 % of the frames that saw it say that it is the owner's. With
# 50 %, more of a bleeding mask stays; with 67 %, more of the true surface is lost if masks are cut
# (docs/dev/notebook.md).
HIT = 2
MISS = 3
# Bounds of a score, so that a cell can be rejected or accepted again: 60 hits, 40 misses.
MAX_SCORE = 120
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
    offsets = _offsets(frame[0], cell_m)
    blocks, cells = np.empty(64, np.int64), np.empty(64, np.uint64)
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
                if count == len(blocks):
                    blocks = np.concatenate((blocks, blocks))
                    cells = np.concatenate((cells, cells))
                blocks[count], cells[count] = row_blocks[row], dropped
                count += 1
            row = nexts[row]
        starts[index + 1] = count
    return blocks[:count].copy(), cells[:count].copy(), starts


@kernel
def _offsets(T_camera_world: Float64, cell_m: float) -> Float64:
    """Position of each cell of a block from its first one, in camera axes (64, 3), metres."""
    offsets = np.empty((64, 3))
    for cell in range(64):
        for axis in range(3):
            row = T_camera_world[axis]
            steps = row[0] * (cell >> 4) + row[1] * ((cell >> 2) & 3) + row[2] * (cell & 3)
            offsets[cell, axis] = cell_m * steps
    return offsets


@kernel
def _index(bit: np.uint64) -> int:
    """Index of a single bit: the number of bits below it.

    As `_bit_count` of `cell_kernels`: a kernel calls kernels of its own module only.
    """
    mask = bit - np.uint64(1)
    mask -= (mask >> np.uint64(1)) & np.uint64(0x5555555555555555)
    pairs = np.uint64(0x3333333333333333)
    mask = (mask & pairs) + ((mask >> np.uint64(2)) & pairs)
    mask = (mask + (mask >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int(np.int64((mask * np.uint64(0x0101010101010101)) >> np.uint64(56)))


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
    """Update the scores (64,) of the cells of a block that a frame shows.

    A marked cell is hit, and one in a pixel with this value; another one is missed.

    Returns:
        The cells whose score was updated, and those of them with a negative one.
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
        cell = _index(bit)
        step = HIT
        if marked & bit == 0:
            depth_m = ahead + offsets[cell, 2]
            if depth_m < NEAR_M:
                continue
            u = fx * (right + offsets[cell, 0]) / depth_m + cx
            v = fy * (down + offsets[cell, 1]) / depth_m + cy
            if u < 0.0 or v < 0.0 or u >= columns or v >= rows:
                continue
            row, column = int(v), int(u)
            measured_mm = depth_mm[row, column]
            apart_m = abs(0.001 * measured_mm - depth_m)
            if measured_mm == 0 or apart_m > SHOWN_M + SHOWN_FRACTION * depth_m:
                continue
            if instances[row, column] != value:
                step = -MISS
        score = scores[cell] + step
        scores[cell] = min(max(score, -MAX_SCORE), MAX_SCORE)
        changed |= bit
        if score < 0:
            lost |= bit
    return changed, lost
