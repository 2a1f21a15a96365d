"""Association by overlap of surfaces: beyond the paper, for real input.

The Hellinger distance of Eq. 6 saturates for thin visible surfaces and partial views, and labels
that flip create a node in each frame. Here two detections match if their surfaces overlap. Objects
and nodes are matched one to one. If the classes differ, more overlap is required.
"""

from __future__ import annotations

import numpy as np

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.merging.cell_kernels import CellSets
from deworldsg_ros.merging.common import Memory, add_relations, check_fits, warm_up_graph
from deworldsg_ros.merging.coverage import coverage
from deworldsg_ros.merging.life_cycle import LifeCycle
from deworldsg_ros.merging.limits import LifeCycleLimits
from deworldsg_ros.merging.matching import match
from deworldsg_ros.merging.matching import warm_up as warm_up_matching
from deworldsg_ros.merging.node_records import NodeRecords
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.graph import SceneGraph

# Gaussians are weighted by their number of pixels; this number gives weight 1.
PIXELS_PER_WEIGHT = 1000.0


class SurfaceMerging:
    """Merges local graphs into a scene graph by the overlap of surfaces.

    Args:
        config: thresholds.
        limits: of the life cycle of a node; only tests change them.
    """

    def __init__(self, config: MergingConfig, limits: LifeCycleLimits = LifeCycleLimits()) -> None:
        self._config = config
        self._records = NodeRecords(config.confirm_observations, limits)
        self._life_cycle = LifeCycle(self._records, limits)

    def warm_up(self) -> None:
        """Compile the kernels before the first frame."""
        self._records.warm_up()
        self._records.drift.warm_up()
        warm_up_matching()
        warm_up_graph()

    def merge(self, graph: SceneGraph, local: LocalGraph) -> list[int]:
        """Merge one frame into the graph; see `Merging.merge`.

        Two objects of one frame never become one node, even if both overlap the same node.
        """
        check_fits(graph, local)
        records = self._records
        local = records.drift.align(local)
        cells = records.map.cells_of(local.surface_points_world)
        owners, on_nodes, of_nodes = records.map.overlaps(cells)
        rows = np.array(records.rows(graph, owners), np.int64)
        T_camera_world = invert_pose(local.T_world_camera)
        covered = coverage(
            graph.nodes, rows, local.instance_ids, T_camera_world, local.depth_grid, of_nodes
        )
        matches = match(
            local,
            graph.nodes,
            rows,
            owners,
            on_nodes,
            covered,
            self._config.overlap_threshold,
            records.map.cell_m,
        )
        matched_owners = [owners[column] if column >= 0 else -1 for column in matches.columns]
        node_ids = self._fuse(graph, local, cells, matched_owners)
        object_owners = [records.owners.of(node_id) for node_id in node_ids]
        records.joint.add_frame(object_owners, matches, local.scores, local.T_world_camera[:3, 3])
        self._life_cycle.merge_parts(graph)
        node_ids = [graph.resolve(node_id) for node_id in node_ids]
        self._life_cycle.observe_depth(graph, local, node_ids)
        self._life_cycle.expire(graph, local.stamp_ns)
        node_ids = [graph.resolve(node_id) for node_id in node_ids]
        graph.remember_frame(local.stamp_ns, node_ids)
        add_relations(graph, local, node_ids)
        return node_ids

    def memory(self) -> Memory:
        """See `Merging.memory`."""
        return self._records.memory()

    def restore(self, graph: SceneGraph, memory: Memory) -> None:
        """See `Merging.restore`."""
        self._records.restore(graph, memory)

    def pose_correction(self) -> Float64:
        """See `Merging.pose_correction`."""
        return self._records.drift.T_graph_poses

    def moved(self, graph: SceneGraph, node_ids: list[int], T_correction: Float64) -> None:
        """See `Merging.moved`."""
        self._records.apply_correction(graph, node_ids, T_correction)

    def _judge(
        self,
        graph: SceneGraph,
        local: LocalGraph,
        cells: CellSets,
        owners: list[int],
        node_ids: list[int],
    ) -> None:
        """Drop surface points in cells that the frames so far show as something else."""
        if local.depth_grid is None:
            return
        T_camera_world = invert_pose(local.T_world_camera)
        rejected = self._records.map.judge(
            owners, cells, local.instance_ids, T_camera_world, local.depth_grid
        )
        if len(rejected.blocks):
            rows = [graph.nodes.row(node_id) for node_id in node_ids]
            graph.drop_points(node_ids, self._records.map.points_in(rejected, graph.nodes, rows))

    def _fuse(
        self, graph: SceneGraph, local: LocalGraph, cells: CellSets, owners: list[int]
    ) -> list[int]:
        """Fuse each object into the node of its owner, or create a tentative node (owner -1)."""
        weights = local.pixel_counts / PIXELS_PER_WEIGHT
        surfaces = local.surface_points_world
        records = self._records
        known = [row for row, owner in enumerate(owners) if owner >= 0]
        node_ids = [records.owners.node(owner) if owner >= 0 else 0 for owner in owners]
        graph.observe_each(
            [node_ids[row] for row in known],
            local.means_world[known],
            local.covariances_world[known],
            local.class_probabilities[known],
            local.stamp_ns,
            [surfaces[row] for row in known],
            weights[known],
        )
        owners = owners.copy()
        for row, node_id in enumerate(node_ids):
            if not node_id:
                node_ids[row] = graph.add_node(
                    local.means_world[row],
                    local.covariances_world[row],
                    local.class_probabilities[row],
                    local.stamp_ns,
                    surfaces[row],
                    float(weights[row]),
                    confirmed=False,
                )
                owners[row] = records.owners.add(node_ids[row])
        records.map.add(owners, cells)
        self._judge(graph, local, cells, owners, node_ids)
        records.existence.add_detections(
            owners,
            local.means_world,
            local.scores,
            local.T_world_camera[:3, 3],
            local.stamp_ns,
        )
        return [self._life_cycle.confirm(graph, node_id) for node_id in node_ids]
