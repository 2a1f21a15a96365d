"""What the saved state of the surface rule has to fulfil before a kernel works on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.merging import cell_beliefs
from deworldsg_ros.merging.common import Memory
from deworldsg_ros.merging.names import LABELS
from deworldsg_ros.merging.views import VISIBILITIES
from deworldsg_ros.merging.voxel_map import CELLS_PER_OWNER
from deworldsg_ros.scene.array_checks import (
    MAX_SUM_ERROR,
    checked,
    distinct,
    holds,
    lengths,
    refuse,
    within,
)
from deworldsg_ros.scene.arrays import Int64

# Sums that grow with every frame, far from overflow.
MAX_SUM = 1e15
# Stamps have 32-bit seconds. Those of an earlier run move into the past, by one such span at most.
MAX_STAMP_NS = 2 * 2**31 * 10**9
# A block is three indices of 19 bits, 21 bits apart (`cell_kernels`).
_BLOCK_AXIS = (1 << 19) - 1
_BLOCK_MASK = _BLOCK_AXIS << 42 | _BLOCK_AXIS << 21 | _BLOCK_AXIS
# Bits in each byte.
_BIT_COUNTS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(
    axis=1, dtype=np.uint8
)


def check_memory(memory: Memory, record: np.dtype[np.void], class_count: int) -> None:
    """Raise ValueError unless the arrays are those of `NodeRecords.memory`.

    Args:
        memory: by name.
        record: expected fields of the records; they may be packed.
        class_count: of the graph.
    """
    records = _records(memory, record)
    _check_existence(records)
    _check_names(records, class_count)
    looks = checked(memory, "looks", np.float64, len(VISIBILITIES), 2)
    within("looks", looks, 1e-9, MAX_SUM)
    # The rate of detections is below one: its logarithm is taken.
    holds("looks", (looks[:, 1] < looks[:, 0]).all(), "fewer detections than looks")
    within("fates", checked(memory, "fates", np.int64, 2), 1, 2**52)
    _check_stamps("last_ns", checked(memory, "last_ns", np.int64))
    _check_cells(memory, len(records))
    joint = checked(memory, "joint", np.int64, None, 3)
    distinct("joint", joint[:, :2])
    holds("joint", (joint[:, 0] != joint[:, 1]).all(), "two different nodes")
    within("joint", joint[:, 2], -(2**52), 2**52)


def _records(memory: Memory, record: np.dtype[np.void]) -> NDArray[np.void]:
    records: NDArray[np.void] = memory["records"]
    names = record.names or ()
    if records.ndim != 1 or records.dtype.names != names:
        refuse("records", f"{records.dtype} of shape {records.shape}", f"the fields {names}")
    for name in names:
        if records.dtype[name] != record[name]:
            refuse("records", f"{records.dtype[name]} as {name}", str(record[name]))
    ids = records["node_id"]
    within("records (node_id)", ids, 1, 2**52)
    distinct("records (node_id)", ids)
    within("records (through_frames)", records["through_frames"], 0, 2**52)
    return records


def _check_existence(records: NDArray[np.void]) -> None:
    within("records (best_score)", records["best_score"], 0.0, 1.0 + 1e-9)
    for name in ("looks", "missed", "missed_since", "reach_m", "detected", "shown", "pending"):
        within(f"records ({name})", records[name], 0.0, MAX_SUM)
    within("records (look_weight)", records["look_weight"], 0.0, 1e3)
    within("records (visibility)", records["visibility"], 0, len(VISIBILITIES) - 1)
    for name in ("first_ns", "last_ns", "look_ns", "named_ns"):
        _check_stamps(f"records ({name})", records[name])
    # Infinite for the records of nodes without looks.
    camera = records["camera_world"]
    within("records (camera_world)", camera[~np.isposinf(camera)], -MAX_SUM, MAX_SUM)
    detected, shown = records["detected"], records["shown"]
    holds("records (detected)", (detected <= shown * (1 + 1e-9)).all(), "no more than shown")


def _check_names(records: NDArray[np.void], class_count: int) -> None:
    labels, joint = records["labels"], records["joint"]
    within("records (labels)", labels, -1, class_count - 1)
    known = labels >= 0
    holds("records (labels)", known[:, 0].all(), "at least one label")
    holds("records (labels)", (known[:, 1:] <= known[:, :-1]).all(), "labels first, then -1")
    ordered = np.sort(np.where(known, labels, -1 - np.arange(LABELS)), axis=1)
    holds("records (labels)", (np.diff(ordered, axis=1) > 0).all(), "each label once")
    within("records (joint)", joint, 0.0, 1.0 + MAX_SUM_ERROR)
    both = known[:, :, None] & known[:, None, :]
    sums = (joint * both).sum(axis=(1, 2))
    within("records (sum of joint)", sums, 1e-12, 1.0 + MAX_SUM_ERROR)


def _check_cells(memory: Memory, count: int) -> None:
    blocks = checked(memory, "blocks", np.int64, None)
    masks = checked(memory, "masks", np.uint64, len(blocks))
    scores = checked(memory, "scores", np.int8, len(blocks), 64)
    counts = checked(memory, "block_counts", np.int64, count)
    lengths("block_counts", counts, len(blocks))
    holds("blocks", (blocks & ~np.int64(_BLOCK_MASK) == 0).all(), "three indices of 19 bits")
    holds("masks", (masks != 0).all(), "at least one cell in each block")
    within("scores", scores, -cell_beliefs.MAX_SCORE, cell_beliefs.MAX_SCORE)
    owners = np.repeat(np.arange(count), counts)
    distinct("blocks of a node", np.stack([owners, blocks], axis=1))
    bits = _BIT_COUNTS[masks.view(np.uint8)].reshape(-1, 8).sum(axis=1, dtype=np.uint8)
    cells = np.bincount(owners, bits, count)
    holds("masks", (cells <= CELLS_PER_OWNER).all(), f"at most {CELLS_PER_OWNER} cells of a node")


def _check_stamps(name: str, stamps_ns: Int64) -> None:
    within(name, stamps_ns, -MAX_STAMP_NS, MAX_STAMP_NS)
