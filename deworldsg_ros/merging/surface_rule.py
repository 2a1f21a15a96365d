"""Association by overlap of surfaces: beyond the paper, for real input.

The Hellinger distance of Eq. 6 saturates on thin visible surfaces and on partial views, and a
label that flips founds a node a frame. Here two things are one where their surfaces coincide:
each object of a frame votes with the cells of its surface for the nodes that were seen in them,
objects and nodes are matched one to one, and a class that disagrees only raises the bar.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.merging.absence import look
from deworldsg_ros.merging.local import add_relations, check_fits
from deworldsg_ros.merging.lost_nodes import LostNodes, alike_elsewhere
from deworldsg_ros.merging.voxel_map import CellSets, VoxelMap
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph
from deworldsg_ros.scene.gaussian import Float64
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.surface import hash_each

# Classes agree where two labels drawn from the two distributions are the same this often.
CLASS_AGREEMENT = 0.3
# What agreeing classes add to the share of overlap, when several nodes could be the one.
CLASS_BONUS = 0.5
# Two nodes are one when this many objects more lay on both than saw them apart.
JOINT_EVIDENCE = 3
# Surface points of a node that the depth image is compared with.
SAMPLED_POINTS = 48
# Gaussians are weighted by their number of pixels; this many make an observation of weight 1.
PIXELS_OF_UNIT_WEIGHT = 1000.0


class SurfaceMerging:
    """Merges local graphs into a scene graph by the overlap of surfaces."""

    def __init__(self, config: MergingConfig) -> None:
        self._config = config
        self._map = VoxelMap(config.cell_m)
        # Owner index of each node in the map, and back; 0 = the index is free.
        self._owner_of: dict[int, int] = {}
        self._node_of: list[int] = []
        self._joint: dict[tuple[int, int], int] = {}
        # A few surface points of each owner, and the frames in a row that saw through them.
        self._samples = np.zeros((0, SAMPLED_POINTS, 3), np.float32)
        self._sample_counts = np.zeros(0, np.int64)
        self._absent_frames = np.zeros(0, np.int64)
        self._lost = LostNodes(config.lost_s)

    def warm_up(self) -> None:
        """Compile now what would else be compiled during the first frame."""
        known = VoxelMap(self._config.cell_m)
        sets = known.cells_of([np.zeros((1, 3), np.float32)])
        known.add(0, sets.of(0))
        known.shares(sets, 1)
        known.remove(0)
        grid = DepthGrid(np.ones((1, 1), np.uint16), 8, Intrinsics(1.0, 1.0, 0.0, 0.0, 8, 8))
        look(np.zeros((1, 1, 3), np.float32), np.ones(1, np.int64), np.eye(4), grid)

    def merge(self, graph: SceneGraph, local: LocalGraph) -> list[int]:
        """Merge one frame into the graph; see `Merging.merge`.

        Two objects of one frame are never one node: they stay two even where both overlap it.
        """
        check_fits(graph, local)
        if not self._owner_of and len(graph):
            self._restore(graph)
        cells = self._map.cells_of(local.surface_points_world)
        values = self._values(graph, local, cells)
        matched = _one_to_one(values)
        node_ids = self._place(graph, local, cells, matched)
        self._note_joint(values, matched)
        self._merge_grown(graph)
        self._look_for_absent(graph, local, node_ids)
        self._expire(graph, local.stamp_ns)
        node_ids = [graph.resolve(node_id) for node_id in node_ids]
        graph.remember_frame(local.stamp_ns, node_ids)
        add_relations(graph, local, node_ids)
        return node_ids

    def moved(self, graph: SceneGraph, node_ids: list[int], T_correction: Float64) -> None:
        """Follow nodes that a correction (4, 4) has moved in the graph."""
        for node_id in node_ids:
            owner = self._owner_of.get(node_id)
            if owner is None:  # lost: it is in no cell
                continue
            centres = self._map.centres(owner).astype(np.float64)
            centres = centres @ T_correction[:3, :3].T + T_correction[:3, 3]
            points = graph.nodes.surfaces[graph.nodes.row(node_id)].points_world
            cells = self._map.cells_of([np.concatenate((centres.astype(np.float32), points))])
            self._map.remove(owner)
            self._map.add(owner, cells.of(0))
            self._absent_frames[owner] = 0
            self._sample_counts[owner] = len(points[:SAMPLED_POINTS])
            self._samples[owner, : self._sample_counts[owner]] = points[:SAMPLED_POINTS]

    def _values(self, graph: SceneGraph, local: LocalGraph, cells: CellSets) -> Float64:
        """How well each object fits each owner, (n, S); 0 where they cannot be the same."""
        shares = self._map.shares(cells, len(self._node_of))
        objects, owners = np.nonzero(shares)
        node_rows = [graph.nodes.row(self._node_of[owner]) for owner in owners.tolist()]
        agreements = np.einsum(
            "ij,ij->i",
            local.class_probabilities[objects],
            graph.nodes.class_probabilities[node_rows],
        )
        wanted = np.where(
            agreements > CLASS_AGREEMENT,
            self._config.overlap_threshold,
            self._config.overlap_threshold_other_class,
        )
        found = shares[objects, owners]
        values = np.zeros_like(shares)
        values[objects, owners] = np.where(found >= wanted, found + CLASS_BONUS * agreements, 0.0)
        return values

    def _place(
        self, graph: SceneGraph, local: LocalGraph, cells: CellSets, matched: list[int]
    ) -> list[int]:
        """Fuse each object into the node of its owner, or found a tentative node."""
        surfaces = hash_each(local.surface_points_world)
        node_ids = []
        for row, owner in enumerate(matched):
            weight = float(local.pixel_counts[row]) / PIXELS_OF_UNIT_WEIGHT
            observation = (
                local.means_world[row],
                local.covariances_world[row],
                local.class_probabilities[row],
                local.stamp_ns,
                surfaces[row],
                weight,
            )
            if owner < 0:
                node_id = graph.add_node(*observation, confirmed=False)
                owner = self._take_owner(node_id)
            else:
                node_id = self._node_of[owner]
                graph.observe(node_id, *observation)
            self._map.add(owner, cells.of(row))
            self._sample_surface(graph, node_id)
            node = graph.nodes.row(node_id)
            if (
                not graph.nodes.confirmed[node]
                and graph.nodes.observations[node] >= self._config.confirm_observations
            ):
                graph.set_confirmed(node_id, True)
                lost_id = self._lost.match(graph, node_id)
                if lost_id is not None:
                    self._lost.found(lost_id)
                    self._move(graph, lost_id, node_id)
                    node_id = lost_id
            node_ids.append(node_id)
        return node_ids

    def _sample_surface(self, graph: SceneGraph, node_id: int) -> None:
        """Renew a node's few surface points, often at first and then now and again."""
        row, owner = graph.nodes.row(node_id), self._owner_of[node_id]
        seen = int(graph.nodes.observations[row])
        if seen > 4 and seen % 8:
            return
        points = graph.nodes.surfaces[row].points_world[:SAMPLED_POINTS]
        self._samples[owner, : len(points)] = points
        self._sample_counts[owner] = len(points)

    def _look_for_absent(self, graph: SceneGraph, local: LocalGraph, node_ids: list[int]) -> None:
        """Lose the nodes through whose place the camera has looked for some frames in a row."""
        if local.depth_grid is None or not self._config.absent_frames:
            return
        seen_through, present = look(
            self._samples, self._sample_counts, local.T_world_camera, local.depth_grid
        )
        for node_id in node_ids:
            present[self._owner_of[graph.resolve(node_id)]] = True
        self._absent_frames[seen_through] += 1
        self._absent_frames[present] = 0
        for owner in np.flatnonzero(self._absent_frames >= self._config.absent_frames).tolist():
            # Of two that are gone, the one may just have become the other.
            if self._node_of[owner]:
                self._lose(graph, self._node_of[owner], local.stamp_ns)

    def _lose(self, graph: SceneGraph, node_id: int, stamp_ns: int) -> None:
        """Take a node from its place; its id may turn up elsewhere, now or soon."""
        self._map.remove(self._owner_of[node_id])
        self._free_owner(node_id)
        if not graph.nodes.confirmed[graph.nodes.row(node_id)]:
            graph.remove_node(node_id)
            return
        graph.set_confirmed(node_id, False)
        found_id = alike_elsewhere(graph, node_id)
        if found_id is None:
            self._lost.add(node_id, stamp_ns)
        else:
            self._move(graph, node_id, found_id)

    def _move(self, graph: SceneGraph, old_id: int, new_id: int) -> None:
        """Let the id of a lost node stand for the node that its object has become."""
        graph.take_over(old_id, new_id)
        owner = self._owner_of.pop(new_id)
        self._node_of[owner] = old_id
        self._owner_of[old_id] = owner

    def _note_joint(self, values: Float64, matched: list[int]) -> None:
        """Count where one object lay on two nodes, against where both were seen apart."""
        taken = {owner for owner in matched if owner >= 0}
        for row, owner in enumerate(matched):
            if owner < 0:
                continue
            for other in np.flatnonzero(values[row]).tolist():
                if other != owner:
                    pair = (min(owner, other), max(owner, other))
                    change = -1 if other in taken else 1
                    self._joint[pair] = self._joint.get(pair, 0) + change

    def _merge_grown(self, graph: SceneGraph) -> None:
        """Merge nodes that have turned out to be parts of one object."""
        for pair in [pair for pair, count in self._joint.items() if count >= JOINT_EVIDENCE]:
            if pair not in self._joint:  # one of them has just been merged
                continue
            a_id, b_id = (self._node_of[owner] for owner in pair)
            kept = graph.merge_nodes(a_id, b_id)
            gone = b_id if kept == a_id else a_id
            cells = self._map.remove(self._owner_of[gone])
            self._map.add(self._owner_of[kept], cells)
            self._free_owner(gone)

    def _expire(self, graph: SceneGraph, stamp_ns: int) -> None:
        """Remove tentative nodes that have not been seen for long, and what was lost for good."""
        nodes = graph.nodes
        oldest_ns = stamp_ns - int(self._config.expire_tentative_s * 1e9)
        old = nodes.ids[~nodes.confirmed & (nodes.last_seen_ns < oldest_ns)].tolist()
        for node_id in [node_id for node_id in old if node_id not in self._lost]:
            graph.remove_node(node_id)
            self._map.remove(self._owner_of[node_id])
            self._free_owner(node_id)
        for node_id in self._lost.take_expired(stamp_ns):
            graph.remove_node(node_id)

    def _restore(self, graph: SceneGraph) -> None:
        """Take the nodes of a graph that was loaded, by their surface points."""
        cells = self._map.cells_of([surface.points_world for surface in graph.nodes.surfaces])
        for row, node_id in enumerate(graph.nodes.ids.tolist()):
            self._map.add(self._take_owner(node_id), cells.of(row))
            self._sample_surface(graph, node_id)

    def _take_owner(self, node_id: int) -> int:
        try:
            owner = self._node_of.index(0)
            self._node_of[owner] = node_id
        except ValueError:
            owner = len(self._node_of)
            self._node_of.append(node_id)
            if owner == len(self._samples):
                more = max(64, owner)
                self._samples = np.pad(self._samples, ((0, more), (0, 0), (0, 0)))
                self._sample_counts = np.pad(self._sample_counts, (0, more))
                self._absent_frames = np.pad(self._absent_frames, (0, more))
        self._owner_of[node_id] = owner
        return owner

    def _free_owner(self, node_id: int) -> None:
        owner = self._owner_of.pop(node_id)
        self._node_of[owner] = 0
        self._sample_counts[owner] = self._absent_frames[owner] = 0
        for pair in [pair for pair in self._joint if owner in pair]:
            del self._joint[pair]


def _one_to_one(values: Float64) -> list[int]:
    """Owner of each object, -1 = none: the assignment of greatest total value."""
    matched = [-1] * len(values)
    if values.any():
        for row, owner in zip(*linear_sum_assignment(values, maximize=True)):
            if values[row, owner] > 0:
                matched[int(row)] = int(owner)
    return matched
