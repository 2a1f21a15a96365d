"""The state of the surface rule for each node besides the graph: one table, one row a node."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.array_file import Arrays
from deworldsg_ros.graph.extent import even_moments
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.merging import beliefs, surface_map
from deworldsg_ros.merging.beliefs import LABELS
from deworldsg_ros.merging.cell_kernels import SCORES, CellSets
from deworldsg_ros.merging.matching import JointEvidence
from deworldsg_ros.merging.surface_map import CELLS_PER_OWNER, VoxelMap
from deworldsg_ros.merging.views import VISIBILITIES, NodeGrid
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int8, Int64, UInt16, UInt64
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.checks import (
    MAX_SUM_ERROR,
    checked,
    distinct,
    holds,
    lengths,
    refuse,
    within,
)
from deworldsg_ros.scene.frame_graph import LocalGraph

# --- What the saved state of the surface rule has to fulfil before a kernel works on it.

# Sums that grow with every frame, far from overflow.
MAX_SUM = 1e15
# Frames in which a new node may have been overlooked.
RECENT_FRAMES = 10
# A block is three indices of 19 bits, 21 bits apart (`cell_kernels`).
_BLOCK_AXIS = (1 << 19) - 1
_BLOCK_MASK = _BLOCK_AXIS << 42 | _BLOCK_AXIS << 21 | _BLOCK_AXIS
# Bits in each byte.
_BIT_COUNTS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(
    axis=1, dtype=np.uint8
)


def check_memory(memory: Arrays, record: np.dtype[np.void], class_count: int) -> None:
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
    said = checked(memory, "said", np.int64, 2)
    within("said", said, 0, 2**52)
    holds("said", said[0] <= said[1], "no more contradictions than viewpoints")
    frames = checked(memory, "frames", np.int64)
    within("frames", frames, 0, 2**52)
    within("records (last_frame)", records["last_frame"], 0, 2**52)
    poses = checked(memory, "recent_poses", np.float64, None, 4, 4)
    holds("recent_poses", len(poses) <= RECENT_FRAMES, f"at most {RECENT_FRAMES}")
    within("recent_poses", poses, -MAX_SUM, MAX_SUM)
    cameras = checked(memory, "recent_cameras", np.float64, len(poses), 6)
    within("recent_cameras", cameras, -MAX_SUM, MAX_SUM)
    _check_cells(memory, len(records))
    joint = checked(memory, "joint", np.int64, None, 3)
    distinct("joint", joint[:, :2])
    holds("joint", (joint[:, 0] != joint[:, 1]).all(), "two different nodes")
    within("joint", joint[:, 2], -(2**52), 2**52)


def _records(memory: Arrays, record: np.dtype[np.void]) -> NDArray[np.void]:
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


def _with_certainties(records: NDArray[np.void]) -> NDArray[np.void]:
    """Records of an older release have no certainties: nothing bounds their names."""
    names = [name for name in RECORD.names or () if name != "most_certain"]
    if records.ndim != 1 or list(records.dtype.names or ()) != names:
        return records
    whole = np.ones(len(records), RECORD)
    for name in names:
        whole[name] = records[name]
    return whole


def _check_existence(records: NDArray[np.void]) -> None:
    within("records (best_score)", records["best_score"], 0.0, 1.0 + 1e-9)
    for name in ("looks", "missed", "reach_m", "before", "pending", "view_detected", "view_shown"):
        within(f"records ({name})", records[name], 0.0, MAX_SUM)
    within("records (views)", records["views"], 0, 2**52)
    within("records (view_camera)", records["view_camera"], -MAX_SUM, MAX_SUM)
    within("records (view_visibility)", records["view_visibility"], 0, len(VISIBILITIES) - 1)
    within("records (named_from)", records["named_from"], -1, beliefs.VIEWS - 1)
    within("records (current)", records["current"], 0, beliefs.VIEWS - 1)
    within("records (view_named)", records["view_named"], 0, 1)
    detected, shown = records["view_detected"], records["view_shown"]
    holds("records (view_detected)", (detected <= shown).all(), "no more than view_shown")
    used = np.arange(beliefs.VIEWS) < records["views"][:, None]
    holds("records (view_shown)", (shown[used] >= 1).all(), "at least one frame")


def _check_names(records: NDArray[np.void], class_count: int) -> None:
    labels, joint = records["labels"], records["joint"]
    within("records (labels)", labels, -1, class_count - 1)
    known = labels >= 0
    holds("records (labels)", known[:, 0].all(), "at least one label")
    holds("records (labels)", (known[:, 1:] <= known[:, :-1]).all(), "labels first, then -1")
    ordered = np.sort(np.where(known, labels, -1 - np.arange(LABELS)), axis=1)
    holds("records (labels)", (np.diff(ordered, axis=1) > 0).all(), "each label once")
    within("records (joint)", joint, 0.0, 1.0 + MAX_SUM_ERROR)
    within("records (most_certain)", records["most_certain"], 0.0, 1.0 + MAX_SUM_ERROR)
    both = known[:, :, None] & known[:, None, :]
    sums = (joint * both).sum(axis=(1, 2))
    within("records (sum of joint)", sums, 1e-12, 1.0 + MAX_SUM_ERROR)


def _check_cells(memory: Arrays, count: int) -> None:
    blocks = checked(memory, "blocks", np.int64, None)
    masks = checked(memory, "masks", np.uint64, len(blocks))
    scores = checked(memory, "scores", np.int8, len(blocks), SCORES, 64)
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


# --- What the surface rule remembers of each node besides the graph.

RECORD = np.dtype(
    [
        ("node_id", np.int64),
        # Consecutive frames that see through the node.
        ("through_frames", np.int64),
        # The last frame that detected it, by its number.
        ("last_frame", np.int64),
        *beliefs.EXISTENCE_FIELDS,
        *beliefs.NAME_FIELDS,
    ],
    align=True,
)


class NodeRecords:
    """The records of nodes, by the slot of the node in the graph.

    Attributes:
        rows: (n,) of `RECORD`, by slot; ``node_id`` is 0 where there is no record.
        looks: viewpoints at objects and those that detected them (`beliefs.first_counts`).
        fates: errors and objects among the nodes so far (`beliefs.first_fates`).
        said: viewpoints so far that contradicted the name of their node, and all of them.
        frames: number of frames so far.
        map: cells of the surfaces, by slot.
        grid: slots by the position of their node.
        joint: evidence that two slots are one object.
    """

    def __init__(self) -> None:
        self.rows: NDArray[np.void] = np.zeros(64, RECORD)
        self.looks = beliefs.first_counts()
        self.fates = beliefs.first_fates()
        self.said = beliefs.first_said()
        self.frames = 0
        self.map = VoxelMap()
        self.grid = NodeGrid()
        self.joint = JointEvidence()
        # Of the newest frames: T_camera_world, and fx, fy, cx, cy, width and height.
        self.recent: deque[tuple[Float64, Float64]] = deque(maxlen=RECENT_FRAMES)

    def note_frame(self, local: LocalGraph) -> None:
        """Remember what a frame could show; after its nodes were added."""
        if local.depth_grid is not None:
            i = local.depth_grid.intrinsics
            camera = np.array([i.fx, i.fy, i.cx, i.cy, i.width, i.height])
            self.recent.appendleft((invert_pose(local.T_world_camera), camera))

    def frames_before(self, mean_world: Float64, camera_world: Float64) -> int:
        """Number of frames just before that had a place (3,) in view from the same viewpoint."""
        count, camera_world = 0, np.ascontiguousarray(camera_world)
        for T, (fx, fy, cx, cy, width, height) in self.recent:
            x, y, z = T[:3, :3] @ mean_world + T[:3, 3]
            other = -T[:3, :3].T @ T[:3, 3]
            if beliefs.viewpoint(other[None], mean_world, camera_world) < 0:
                break
            u, v = fx * x / max(z, 1e-9) + cx, fy * y / max(z, 1e-9) + cy
            count += z > 0 and 0 <= u < width and 0 <= v < height
        return count

    @property
    def slots(self) -> Int64:
        """The slots with a record, ascending."""
        return np.flatnonzero(self.rows["node_id"])

    @property
    def undetected(self) -> Int64:
        """The slots of things that nothing has detected; see `beliefs.THING_LOOKS`."""
        slots = self.slots
        views, looks = self.rows["views"][slots], self.rows["looks"][slots]
        return np.asarray(slots[(views == 0) & (looks == beliefs.THING_LOOKS)])

    @property
    def ids(self) -> list[int]:
        """The nodes with a record."""
        node_ids: list[int] = self.rows["node_id"][self.slots].tolist()
        return node_ids

    def has(self, slot: int | None) -> bool:
        """Whether a slot has a record; None = no slot."""
        return slot is not None and slot < len(self.rows) and bool(self.rows["node_id"][slot])

    def node(self, slot: int) -> int:
        """The node of a slot; 0 if there is no record."""
        return int(self.rows["node_id"][slot])

    def nodes_of(self, slots: Sequence[int] | Int64) -> list[int]:
        """The node of each slot."""
        node_ids: list[int] = self.rows["node_id"][slots].tolist()
        return node_ids

    def add(self, slot: int, node_id: int, class_probabilities: Float64, before: int = 0) -> None:
        """Add the record of a new node.

        Args:
            slot: of the node.
            node_id: of the node.
            class_probabilities: (C,) of its first detection.
            before: number of frames before that could have detected it.
        """
        self._make_room(slot + 1)
        if self.has(slot):  # of a node that has left the graph
            self.remove(slot)
        self.rows[slot] = np.zeros((), RECORD)
        self.rows["node_id"][slot] = node_id
        self.rows["last_frame"][slot], self.rows["before"][slot] = self.frames, before
        beliefs.start(self.rows[slot], np.ascontiguousarray(class_probabilities))

    def place(self, graph: GlobalGraph, slots: Sequence[int] | Int64) -> None:
        """Note where the nodes of slots are, after a change of their Gaussians."""
        nodes = graph.nodes
        self.grid.put(np.asarray(slots, np.int64), nodes.means, nodes.eigenvalue_bounds)

    def look(
        self,
        slots: Int64,
        scores: Float64,
        visibilities: Int64,
        means_world: Float64,
        camera_world: Float64,
    ) -> None:
        """Add a frame to the viewpoints of n nodes, once; see `beliefs.observe_existence`."""
        self.frames += 1
        beliefs.observe_existence(
            self.rows,
            self.looks,
            slots,
            scores,
            visibilities,
            means_world,
            np.ascontiguousarray(camera_world),
        )

    def name(
        self, slots: Int64, seen: Float64, means_world: Float64, camera_world: Float64
    ) -> Float64:
        """Class distributions (n, C) of n detected nodes; see `beliefs.observe_names`."""
        self.rows["last_frame"][slots] = self.frames
        classes, camera = np.empty_like(seen), np.ascontiguousarray(camera_world)
        doubted = beliefs.doubt(self.said)
        beliefs.observe_names(
            self.rows, self.said, doubted, slots, seen, means_world, camera, classes
        )
        return classes

    def existence(self, slots: Int64) -> Float64:
        """Probability (n,) that each of n nodes is an object."""
        return self._existence(slots)[0]

    def settle(self, slots: Int64) -> Float64:
        """The same; nodes that have turned out to be objects, or errors, count for the prior."""
        known, missed = self._existence(slots)
        beliefs.settle(self.rows, self.fates, slots, known, missed)
        return known

    def are_missed(self, slots: Int64, minimum: float) -> Bool:
        """Whether (n,) only misses make the existence of each of n nodes less than a minimum."""
        missed: Bool = self._existence(slots, with_misses=False)[0] >= minimum
        return missed

    def _existence(self, slots: Int64, with_misses: bool = True) -> tuple[Float64, Float64]:
        prior = beliefs.prior(self.fates)
        return beliefs.probabilities(self.rows, self.looks, slots, prior, with_misses)

    def remove(self, slot: int) -> CellSets:
        """Drop everything of a node; returns its cells, as one set."""
        self.rows["node_id"][slot] = 0
        self.joint.forget(slot)
        self.grid.remove(slot)
        return self.map.remove(slot)

    def move(self, graph: GlobalGraph, slot: int, to: int) -> None:
        """Continue the record of a node as that of another node, which has none."""
        node_id = int(graph.nodes.ids[to])
        self._make_room(to + 1)
        self.rows[to] = self.rows[slot]
        self.rows["node_id"][to] = node_id
        self.joint.move(slot, to)
        scores = self.map.scores(slot)
        cells = self.remove(slot)
        self._add_cells(to, cells, scores)
        self.place(graph, [to])

    def merge(self, graph: GlobalGraph, kept: int, removed: int) -> None:
        """Combine the records of the nodes of two slots that the graph has merged."""
        record = self.rows[kept]
        # The frame that has just detected either must not forget both.
        record["last_frame"] = max(record["last_frame"], self.rows["last_frame"][removed])
        beliefs.merge(record, self.rows[removed], graph.nodes.means[kept])
        certain = beliefs.most_certain(record, self.rows[removed])
        beliefs.start(record, graph.nodes.class_probabilities[kept].copy(), certain)
        self.joint.merge(kept, removed)
        scores = self.map.scores(removed)
        cells = self.remove(removed)
        self._add_cells(kept, cells, scores)
        self.place(graph, [kept])

    def keep_largest(self, graph: GlobalGraph, slot: int, surfaces: Sequence[Float32]) -> bool:
        """Leave a node the largest of the parts that are nearest to each of several surfaces.

        Args:
            graph: changed.
            slot: of the node.
            surfaces: (k, 3) metres, one of each object.

        Returns:
            Whether there were other parts.
        """
        nodes, surface = graph.nodes, graph.nodes.surface(slot)
        parts = _nearest(surface, surfaces)
        kept = int(np.bincount(parts).argmax())
        self.joint.forget_several(slot)
        own = parts == kept
        if own.all():
            return False
        mean, covariance = even_moments(surface[own])
        weight = float(nodes.weights[slot]) * np.count_nonzero(own) / len(own)
        classes = nodes.class_probabilities[slot].copy()
        nodes.put(slot, mean, covariance, classes, weight, int(nodes.observations[slot]))
        dropped = np.zeros((1, nodes.surface_points_world.shape[1]), np.bool_)
        dropped[0, : len(own)] = ~own
        graph.drop_points([self.node(slot)], dropped)
        slots = np.array([slot])
        of, centres, scores = self.map.take(slots)
        own = _nearest(centres, surfaces) == kept
        self.map.put(slots, of[own], centres[own], scores[own])
        self.place(graph, slots)
        return True

    def memory(self) -> Arrays:
        """The records as arrays by name, for `restore`; equal records give equal arrays."""
        from numpy.lib.recfunctions import repack_fields  # slow to import, and only for maps

        slots = self.slots
        slots = slots[self.rows["node_id"][slots].argsort()]
        pairs = [[*sorted(map(self.node, pair)), n] for pair, n in self.joint.balances.items()]
        return {
            # Without the padding between fields, which is memory of the process.
            "records": repack_fields(self.rows[slots]),
            "looks": self.looks,
            "fates": self.fates,
            "said": self.said,
            "frames": np.array(self.frames),
            "recent_poses": np.array([T for T, _ in self.recent]).reshape(-1, 4, 4),
            "recent_cameras": np.array([camera for _, camera in self.recent]).reshape(-1, 6),
            **self.map.memory(slots),
            "joint": np.array(sorted(pairs), np.int64).reshape(-1, 3),
        }

    def restore(self, graph: GlobalGraph, memory: Arrays, node_ids: Sequence[int]) -> None:
        """Continue with these nodes of a graph of an earlier run; see `Merging.restore`."""
        slots = graph.nodes.slots_of(node_ids)
        self._make_room(int(slots.max(initial=-1)) + 1)
        self.rows["node_id"][slots] = node_ids
        self.place(graph, slots)
        # The paper's rule has no records, and older releases have other ones; cells of another size
        # are useless.
        if "frames" not in memory or checked(memory, "cell_m", np.float64) != self.map.cell_m:
            _rebuild(self, graph, slots)
            return
        if "scores" in memory and memory["scores"].ndim == 2:  # of an older release: one of a cell
            both = np.repeat(memory["scores"][:, None], SCORES, axis=1)
            memory = {**memory, "scores": both}
        if "records" not in memory:
            raise ValueError("the map has no records: it is damaged")
        whole = _with_certainties(memory["records"])
        memory = {"said": beliefs.first_said(), **memory, "records": whole}
        check_memory(memory, RECORD, len(graph.vocabulary.classes))
        records, counts = memory["records"], memory["block_counts"]
        kept = np.isin(records["node_id"], node_ids)
        known = graph.nodes.slots_of(records["node_id"][kept].tolist())
        _name(self, graph, np.setdiff1d(slots, known))
        # A slice takes no memory.
        everything, every = slice(None), bool(kept.all())
        self.rows[known] = records[everything if every else kept]
        self.looks[:] = memory["looks"]
        self.fates[:] = memory["fates"]
        self.said[:] = memory["said"]
        self.frames = int(memory["frames"])
        self.recent.extend(zip(memory["recent_poses"], memory["recent_cameras"]))
        own = everything if every else np.repeat(kept, counts)
        starts = np.append(0, np.cumsum(counts[kept]))
        cells = CellSets(memory["blocks"][own], memory["masks"][own], starts)
        self.map.add(known, cells)
        self.map.add_scores(known, cells, memory["scores"][own])
        slot_of = dict(zip(node_ids, slots.tolist()))
        self.joint.restore(
            {
                (slot_of[a], slot_of[b]): balance
                for a, b, balance in memory["joint"].tolist()
                if a in slot_of and b in slot_of
            }
        )

    def _add_cells(self, slot: int, cells: CellSets, scores: Int8) -> None:
        self.map.add([slot], cells)
        self.map.add_scores([slot], cells, scores)

    def _make_room(self, count: int) -> None:
        while len(self.rows) < count:
            self.rows = np.concatenate((self.rows, np.zeros_like(self.rows)))


def _nearest(points: Float32, surfaces: Sequence[Float32]) -> Int64:
    """Which of several surfaces (k, 3) is nearest to each point (n, 3): (n,)."""
    # A tree takes a second to import. Near the origin, the squares do not cancel.
    origin = surfaces[0].mean(axis=0, dtype=np.float64)
    points, squared = points - origin, np.empty((len(surfaces), len(points)))
    for index, surface in enumerate(surfaces):
        others = surface - origin
        squared[index] = ((others**2).sum(axis=1) - 2 * points @ others.T).min(axis=1)
    nearest: Int64 = squared.argmin(axis=0)
    return nearest


# A cell moves with a surface point in its cube of this size. Odd factors hash node and cube.
NEAR_M = 0.12
_HASH_FACTORS = np.array(
    [0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0xD6E8FEB86659FD93], np.uint64
)


def move_nodes(
    tables: Sequence[NodeRecords], graph: GlobalGraph, slots: Int64, T_new_old: Float64
) -> Float64:
    """Move nodes of the graph, and their cells and viewpoints, as keyframes have moved.

    A cell moves with a surface point near it. Moved cells do not lie on cells: each gives its
    scores to the one that contains its centre.

    Args:
        tables: records; a node is in one of them, or in none.
        graph: changed.
        slots: (n,) of the nodes.
        T_new_old: (k, 4, 4) by the number of the keyframe; see `NodeTable.move`.

    Returns:
        (n, 4, 4), how most of each node has moved.
    """
    nodes, found = graph.nodes, []
    for records in tables:
        own = slots[slots < len(records.rows)]
        own = own[records.rows["node_id"][own] == nodes.ids[own]]
        of, centres, scores = records.map.take(own)
        T = T_new_old[_seen_from(nodes, own, of, centres)]
        new = (T[:, :3, :3] @ centres.astype(np.float64)[:, :, None])[:, :, 0] + T[:, :3, 3]
        found.append((records, own, of, new.astype(np.float32), scores))
    moved = graph.move_nodes(slots, T_new_old)
    main = dict(zip(slots.tolist(), moved))
    for records, own, of, centres, scores in found:
        records.map.put(own, of, centres, scores)
        records.map.add(own, records.map.cells_of([nodes.surface(slot) for slot in own.tolist()]))
        records.place(graph, own)
        for slot in own.tolist():
            row, T_main = records.rows[slot], main[slot]
            row["view_camera"] = row["view_camera"] @ T_main[:3, :3].T + T_main[:3, 3]
            row["through_frames"] = 0
        records.recent.clear()  # of frames that may have moved, too
    return moved


def _seen_from(nodes: NodeTable, slots: Int64, of: Int64, places: Float32) -> UInt16:
    """The keyframe (m,) of a surface point near each place.

    Args:
        nodes: of the graph.
        slots: (n,) of nodes.
        of: (m,) index of the node of each place.
        places: (m, 3) metres. Where a node has no point near it, the first point of the node tells:
            their order is random.
    """
    counts = nodes.surface_counts[slots]
    used = np.arange(nodes.surface_points_world.shape[1]) < counts[:, None]
    keyframes = nodes.surface_keyframes[slots][used]
    points = nodes.surface_points_world[slots][used]
    keys = _near_keys(np.repeat(np.arange(len(slots)), counts), points)
    order = keys.argsort(kind="stable")
    wanted = _near_keys(of, places)
    at = np.minimum(keys[order].searchsorted(wanted), max(len(keys) - 1, 0))
    first = np.where(counts > 0, nodes.surface_keyframes[slots, 0], 0)[of]
    if not len(keys):
        return np.asarray(first, np.uint16)
    return np.where(keys[order][at] == wanted, keyframes[order][at], first).astype(np.uint16)


def _near_keys(of: Int64, places: Float32) -> UInt64:
    """A hash (m,) of the node and the cube of each place (m, 3)."""
    cubes = np.floor(places.astype(np.float64) / NEAR_M).astype(np.int64)
    keys = np.concatenate((of[:, None], cubes), axis=1).astype(np.uint64)
    return np.asarray(keys @ _HASH_FACTORS)


def _rebuild(records: NodeRecords, graph: GlobalGraph, slots: Int64) -> None:
    """Make records from the surfaces and observations in the graph."""
    nodes = graph.nodes
    _name(records, graph, slots)
    records.map.add(slots, records.map.cells_of([nodes.surface(slot) for slot in slots]))
    for slot, observations in zip(slots, nodes.observations[slots].tolist()):
        beliefs.assume(records.rows[slot], max(observations, 3))


def _name(records: NodeRecords, graph: GlobalGraph, slots: Int64) -> None:
    """Begin the names of nodes that have none."""
    nodes = graph.nodes
    for slot in slots.tolist():
        beliefs.start(records.rows[slot], nodes.class_probabilities[slot])
