"""State of the surface rule for each node, besides the graph."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.merging.absence import AbsenceEvidence
from deworldsg_ros.merging.cell_kernels import CellSets
from deworldsg_ros.merging.common import Memory
from deworldsg_ros.merging.coverage import coverage
from deworldsg_ros.merging.drift import Drift
from deworldsg_ros.merging.existence import Existence
from deworldsg_ros.merging.joint import JointEvidence
from deworldsg_ros.merging.limits import LifeCycleLimits
from deworldsg_ros.merging.owners import Owners
from deworldsg_ros.merging.voxel_map import VoxelMap
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import DepthGrid
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.nodes import NodeTable


class NodeRecords:
    """Cells and evidence of each node.

    Args:
        confirm_observations: observations that confirm a node.
        limits: of the life cycle.

    Attributes:
        owners: index of each node in the following records.
        map: cells of the surfaces.
        joint: evidence that two nodes are one object.
        existence: evidence that a node is an object.
        absence: evidence that an object is absent from its position.
        changed: owners whose surface has changed since `absence` sampled it.
        drift: correction of the poses.
    """

    def __init__(self, confirm_observations: int, limits: LifeCycleLimits) -> None:
        self.owners = Owners()
        self.map = VoxelMap()
        self.joint = JointEvidence()
        self.existence = Existence(confirm_observations, limits)
        self.absence = AbsenceEvidence(limits.absent_frames)
        self.changed: set[int] = set()
        self.drift = Drift()

    def warm_up(self) -> None:
        """Compile the kernels before the first frame."""
        spare_map = VoxelMap()
        cells = spare_map.cells_of([np.zeros((1, 3), np.float32)])
        spare_map.add([0], cells)
        spare_map.overlaps(cells)
        one = np.ones((1, 1), np.uint16)
        grid = DepthGrid(one, 8, Intrinsics(1.0, 1.0, 0.0, 0.0, 8, 8), one)
        spare_map.judge([0], cells, np.ones(1, np.int64), np.eye(4), grid)
        nodes = NodeTable(1, 1)
        nodes.append(1)
        nodes.drop_points([0], spare_map.points_in(cells, nodes, [0]))
        zeros = np.zeros(1, np.int64)
        coverage(nodes, zeros, np.ones(1, np.int64), np.eye(4), grid, np.zeros((1, 1)))
        spare_map.remove(0)
        spare_absence = AbsenceEvidence(1)
        spare_absence.update_points([0], nodes, [0])
        spare_absence.observe(np.eye(4), grid, [])
        self.existence.warm_up()

    def rows(self, graph: SceneGraph, owners: list[int]) -> list[int]:
        """Row in the graph of each owner."""
        return [graph.nodes.row(self.owners.node(owner)) for owner in owners]

    def remove(self, node_id: int) -> CellSets:
        """Drop all records of a node; returns its cells, as one set."""
        owner = self.owners.remove(node_id)
        self.existence.forget(owner)
        self.joint.forget(owner)
        self.absence.forget(owner)
        self.changed.discard(owner)
        return self.map.remove(owner)

    def rename(self, old_id: int, new_id: int) -> None:
        """Continue the records of a node under another id."""
        self.owners.rename(old_id, new_id)

    def merge(self, kept_id: int, removed_id: int) -> None:
        """Combine the records of two nodes that are one object."""
        kept, removed = self.owners.of(kept_id), self.owners.of(removed_id)
        self.existence.merge(kept, removed)
        self.joint.merge(kept, removed)
        scores = self.map.scores(removed)
        cells = self.remove(removed_id)
        self.map.add([kept], cells)
        self.map.add_scores(kept, cells.blocks, scores)
        self.changed.add(kept)

    def memory(self) -> Memory:
        """The records as arrays by name, for `restore`."""
        node_ids = list(self.owners.ids)
        owners = list(self.owners.ids.values())
        sets = [self.map.cells(owner) for owner in owners]
        balances = self.joint.balances
        pairs = [[*map(self.owners.node, pair), balance] for pair, balance in balances.items()]
        return {
            "cell_m": np.array(self.map.cell_m),
            "node_ids": np.array(node_ids, np.int64),
            "blocks": np.concatenate([np.zeros(0, np.int64), *(cells.blocks for cells in sets)]),
            "masks": np.concatenate([np.zeros(0, np.uint64), *(cells.masks for cells in sets)]),
            "block_counts": np.array([len(cells.blocks) for cells in sets], np.int64),
            "scores": np.concatenate([np.zeros((0, 64), np.int8), *map(self.map.scores, owners)]),
            "existence": self.existence.records(owners),
            "looks_by_view": self.existence.counts_by_visibility,
            "joint": np.array(pairs, np.int64).reshape(-1, 3),
        }

    def restore(self, graph: SceneGraph, memory: Memory) -> None:
        """Continue with a graph of an earlier run; see `Merging.restore`."""
        owner_of = {node_id: self.owners.add(node_id) for node_id in graph.nodes.ids.tolist()}
        self.changed.update(owner_of.values())
        # The paper's rule has no memory, and cells of another size cannot be used.
        if not memory or memory["cell_m"] != self.map.cell_m:
            self._rebuild(graph, list(owner_of.values()))
            return
        kept = [row for row, node_id in enumerate(memory["node_ids"]) if node_id in owner_of]
        owners = [owner_of[node_id] for node_id in memory["node_ids"][kept].tolist()]
        self.existence.restore(owners, memory["existence"][kept], memory["looks_by_view"])
        counts = memory["block_counts"]
        stops = np.cumsum(counts)
        for owner, row in zip(owners, kept):
            own = slice(stops[row] - counts[row], stops[row])
            cells = memory["blocks"][own], memory["masks"][own], np.array([0, counts[row]])
            self.map.add([owner], CellSets(*cells))
            if "scores" in memory:  # not in maps of version 0.2.0
                self.map.add_scores(owner, cells[0], memory["scores"][own])
        self.joint.restore(
            {
                (owner_of[a], owner_of[b]): balance
                for a, b, balance in memory["joint"].tolist()
                if a in owner_of and b in owner_of
            }
        )

    def _rebuild(self, graph: SceneGraph, owners: list[int]) -> None:
        """Make records from the surfaces and observations in the graph, all confirmed."""
        nodes = graph.nodes
        surfaces = [nodes.surface(row) for row in range(len(nodes))]
        self.map.add(owners, self.map.cells_of(surfaces))
        for owner, observations in zip(owners, nodes.observations.tolist()):
            self.existence.assume_confirmed(owner, observations)

    def apply_correction(
        self, graph: SceneGraph, node_ids: list[int], T_correction: Float64
    ) -> None:
        """Move the cells of nodes that a pose-graph correction (4, 4) has moved in the graph.

        Their scores start again at 0: rotated cells do not lie on cells.
        """
        # After a pose-graph correction, the correction of the poses starts again.
        self.drift = Drift()
        for node_id in node_ids:
            owner = self.owners.find(node_id)
            if owner is None:  # a lost node has no cells
                continue
            centres = self.map.centres(owner).astype(np.float64)
            centres = centres @ T_correction[:3, :3].T + T_correction[:3, 3]
            row = graph.nodes.row(node_id)
            points = graph.nodes.surface(row)
            cells = self.map.cells_of([np.concatenate((centres.astype(np.float32), points))])
            self.map.remove(owner)
            self.map.add([owner], cells)
            self.absence.update_points([owner], graph.nodes, [row])
