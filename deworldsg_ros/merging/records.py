"""The state of the surface rule for each node besides the graph: one table, one row a node."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.merging import beliefs, surface_map
from deworldsg_ros.merging.beliefs import LABELS
from deworldsg_ros.merging.cell_kernels import CellSets
from deworldsg_ros.merging.common import Memory
from deworldsg_ros.merging.matching import JointEvidence
from deworldsg_ros.merging.surface_map import CELLS_PER_OWNER, VoxelMap
from deworldsg_ros.merging.views import VISIBILITIES, NodeGrid
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.checks import (
    MAX_SUM_ERROR,
    checked,
    distinct,
    holds,
    lengths,
    refuse,
    within,
)

# --- What the saved state of the surface rule has to fulfil before a kernel works on it.

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
    within("scores", scores, -surface_map.MAX_SCORE, surface_map.MAX_SCORE)
    owners = np.repeat(np.arange(count), counts)
    distinct("blocks of a node", np.stack([owners, blocks], axis=1))
    bits = _BIT_COUNTS[masks.view(np.uint8)].reshape(-1, 8).sum(axis=1, dtype=np.uint8)
    cells = np.bincount(owners, bits, count)
    holds("masks", (cells <= CELLS_PER_OWNER).all(), f"at most {CELLS_PER_OWNER} cells of a node")


def _check_stamps(name: str, stamps_ns: Int64) -> None:
    within(name, stamps_ns, -MAX_STAMP_NS, MAX_STAMP_NS)


# --- What the surface rule remembers of each node besides the graph: one table, one row for each.

RECORD = np.dtype(
    [
        ("node_id", np.int64),
        # Consecutive frames that see through the node.
        ("through_frames", np.int64),
        *beliefs.EXISTENCE_FIELDS,
        *beliefs.NAME_FIELDS,
    ],
    align=True,
)


class NodeRecords:
    """Records of nodes, found by id. The row of a record, its "owner", stays while the node lives.

    Attributes:
        rows: (capacity,) of `RECORD`; ``node_id`` is 0 in rows that are free.
        looks: looks at objects and those that detected them (`existence.first_counts`).
        fates: errors and objects among the nodes so far (`existence.first_fates`).
        last_ns: stamp of the newest frame; 0 = none.
        map: cells of the surfaces, by owner.
        grid: owners by the position of their node.
        joint: evidence that two owners are one object.
        owner_of: the owner of each node; read only.
    """

    def __init__(self) -> None:
        self.rows: NDArray[np.void] = np.zeros(64, RECORD)
        self.looks = beliefs.first_counts()
        self.fates = beliefs.first_fates()
        self.last_ns = 0
        self.map = VoxelMap()
        self.grid = NodeGrid()
        self.joint = JointEvidence()
        self.owner_of: dict[int, int] = {}
        self._free: list[int] = []

    def __contains__(self, node_id: object) -> bool:
        return node_id in self.owner_of

    def owner(self, node_id: int) -> int:
        """Owner of a node that has a record."""
        return self.owner_of[node_id]

    def node(self, owner: int) -> int:
        """The node of an owner; 0 if the record is free."""
        return int(self.rows["node_id"][owner])

    def nodes_of(self, owners: Sequence[int] | Int64) -> list[int]:
        """The node of each owner."""
        node_ids: list[int] = self.rows["node_id"][owners].tolist()
        return node_ids

    def owners_of(self, node_ids: Sequence[int]) -> list[int]:
        """Owners of nodes that have a record."""
        return [self.owner_of[node_id] for node_id in node_ids]

    def graph_rows(self, graph: SceneGraph, owners: Sequence[int] | Int64) -> Int64:
        """Row in the graph of each owner."""
        return graph.nodes.rows_at(self.nodes_of(owners))

    def add(self, node_id: int, class_probabilities: Float64, stamp_ns: int) -> int:
        """Add the record of a new node; returns its owner."""
        if not self._free:
            count = len(self.owner_of)
            if count == len(self.rows):
                self.rows = np.concatenate((self.rows, np.zeros_like(self.rows)))
            self._free.append(count)
        owner = self.owner_of[node_id] = self._free.pop()
        self.rows[owner] = np.zeros((), RECORD)
        self.rows["node_id"][owner] = node_id
        beliefs.start(self.rows[owner], np.ascontiguousarray(class_probabilities), stamp_ns)
        return owner

    def place(self, graph: SceneGraph, owners: list[int]) -> None:
        """Note where the nodes of owners are, after a change of their Gaussians."""
        nodes, rows = graph.nodes, self.graph_rows(graph, owners)
        self.grid.put(owners, rows, nodes.means, nodes.eigenvalue_bounds)

    def look(
        self,
        owners: Sequence[int] | Int64,
        scores: Float64,
        visibilities: Int64,
        means_world: Float64,
        camera_world: Float64,
        stamp_ns: int,
    ) -> None:
        """Add a frame to the looks at n owners; see `existence.observe`. Once for each frame."""
        step_ns = stamp_ns - self.last_ns if self.last_ns else None
        self.last_ns = stamp_ns
        beliefs.observe_existence(
            self.rows,
            self.looks,
            np.asarray(owners, np.int64),
            scores,
            visibilities,
            means_world,
            np.ascontiguousarray(camera_world),
            stamp_ns,
            beliefs.frame_weight(step_ns),
        )

    def name(self, owners: list[int], seen: Float64, stamp_ns: int) -> Float64:
        """Class distributions (n, C) of n owners after a frame; see `names.observe`."""
        classes = np.empty_like(seen)
        beliefs.observe_names(self.rows, np.array(owners, np.int64), seen, stamp_ns, classes)
        return classes

    def existence(self, owners: Sequence[int] | Int64) -> Float64:
        """Probability (n,) that each of n owners is an object."""
        prior = beliefs.prior(self.fates)
        return beliefs.probabilities(self.rows, self.looks, np.asarray(owners, np.int64), prior)

    def are_missed(self, owners: list[int], minimum: float) -> Bool:
        """Whether (n,) only misses make the existence of each of n owners less than a minimum."""
        prior, indices = beliefs.prior(self.fates), np.array(owners, np.int64)
        return beliefs.are_missed(self.rows, self.looks, indices, prior, minimum)

    def remove(self, node_id: int) -> CellSets:
        """Drop everything of a node; returns its cells, as one set."""
        owner = self.owner_of.pop(node_id)
        self.rows["node_id"][owner] = 0
        self._free.append(owner)
        self.joint.forget(owner)
        self.grid.remove(owner)
        return self.map.remove(owner)

    def rename(self, old_id: int, new_id: int) -> None:
        """Continue the record of a node under another id."""
        owner = self.owner_of[new_id] = self.owner_of.pop(old_id)
        self.rows["node_id"][owner] = new_id

    def merge(self, graph: SceneGraph, kept_id: int, removed_id: int) -> None:
        """Combine the records of two nodes that the graph has merged."""
        kept, removed = self.owner_of[kept_id], self.owner_of[removed_id]
        record = self.rows[kept]
        beliefs.merge(record, self.rows[removed])
        classes = graph.nodes.class_probabilities[graph.nodes.row(kept_id)]
        beliefs.start(record, classes.copy(), int(record["named_ns"]))
        self.joint.merge(kept, removed)
        scores = self.map.scores(removed)
        cells = self.remove(removed_id)
        self.map.add([kept], cells)
        self.map.add_scores([kept], cells, scores)
        self.place(graph, [kept])

    def memory(self) -> Memory:
        """The records as arrays by name, for `restore`; equal records give equal arrays."""
        from numpy.lib.recfunctions import repack_fields  # slow to import, and only for maps

        owners = [self.owner_of[node_id] for node_id in sorted(self.owner_of)]
        pairs = [[*sorted(map(self.node, pair)), n] for pair, n in self.joint.balances.items()]
        return {
            # Without the padding between fields, which is memory of the process.
            "records": repack_fields(self.rows[owners]),
            "looks": self.looks,
            "fates": self.fates,
            "last_ns": np.array(self.last_ns),
            **self.map.memory(owners),
            "joint": np.array(sorted(pairs), np.int64).reshape(-1, 3),
        }

    def restore(self, graph: SceneGraph, memory: Memory, node_ids: Sequence[int]) -> None:
        """Continue with these nodes of a graph of an earlier run; see `Merging.restore`."""
        owners = list(range(len(node_ids)))
        self.owner_of = owner_of = dict(zip(node_ids, owners))
        self.rows = np.zeros(max(len(self.rows), len(owners)), RECORD)
        self.rows["node_id"][owners] = node_ids
        self.place(graph, owners)
        # The paper's rule and older releases have no records; cells of another size are useless.
        if "records" not in memory or checked(memory, "cell_m", np.float64) != self.map.cell_m:
            _rebuild(self, graph, owners)
            return
        check_memory(memory, RECORD, len(graph.vocabulary.classes))
        records, counts = memory["records"], memory["block_counts"]
        kept = np.isin(records["node_id"], node_ids)
        owners = [owner_of[node_id] for node_id in records["node_id"][kept].tolist()]
        _name(self, graph, sorted(set(owner_of.values()) - set(owners)))
        # A slice takes no memory.
        everything, every = slice(None), bool(kept.all())
        self.rows[owners] = records[everything if every else kept]
        self.looks[:] = memory["looks"]
        self.fates[:] = memory["fates"]
        self.last_ns = int(memory["last_ns"])
        own = everything if every else np.repeat(kept, counts)
        starts = np.append(0, np.cumsum(counts[kept]))
        cells = CellSets(memory["blocks"][own], memory["masks"][own], starts)
        self.map.add(owners, cells)
        self.map.add_scores(owners, cells, memory["scores"][own])
        self.joint.restore(
            {
                (owner_of[a], owner_of[b]): balance
                for a, b, balance in memory["joint"].tolist()
                if a in owner_of and b in owner_of
            }
        )


def apply_correction(
    records: NodeRecords, graph: SceneGraph, node_ids: list[int], T_correction: Float64
) -> None:
    """Move the cells of nodes that a pose-graph correction (4, 4) has moved in the graph.

    Their scores start again at 0: rotated cells do not lie on cells.
    """
    for node_id in node_ids:
        owner = records.owner_of.get(node_id)
        if owner is None:  # a lost node has no cells
            continue
        centres = records.map.centres(owner).astype(np.float64)
        centres = centres @ T_correction[:3, :3].T + T_correction[:3, 3]
        row = graph.nodes.row(node_id)
        points = graph.nodes.surface(row)
        cells = records.map.cells_of([np.concatenate((centres.astype(np.float32), points))])
        records.map.remove(owner)
        records.map.add([owner], cells)
        records.place(graph, [owner])


def _rebuild(records: NodeRecords, graph: SceneGraph, owners: list[int]) -> None:
    """Make records from the surfaces and observations in the graph."""
    nodes, rows = graph.nodes, records.graph_rows(graph, owners)
    _name(records, graph, owners)
    surfaces = [nodes.surface(row) for row in rows]
    records.map.add(owners, records.map.cells_of(surfaces))
    for owner, observations in zip(owners, nodes.observations[rows].tolist()):
        beliefs.assume(records.rows[owner], observations)


def _name(records: NodeRecords, graph: SceneGraph, owners: list[int]) -> None:
    """Begin the names of owners that have none."""
    nodes = graph.nodes
    for owner, row in zip(owners, records.graph_rows(graph, owners)):
        stamp_ns = int(nodes.last_seen_ns[row])
        beliefs.start(records.rows[owner], nodes.class_probabilities[row], stamp_ns)
