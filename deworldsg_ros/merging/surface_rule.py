"""Association by overlap of surfaces: beyond the paper, for real input.

The Hellinger distance of Eq. 6 saturates on thin visible surfaces and on partial views, and a
label that flips founds a node a frame. Here two things are one where their surfaces coincide:
each object of a frame votes with the cells of its surface for the nodes that were seen in them,
objects and nodes are matched one to one, and a class that disagrees only raises the bar.
"""

from __future__ import annotations

import numpy as np

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.merging.absence import SeenThrough
from deworldsg_ros.merging.alignment import PoseAlignment
from deworldsg_ros.merging.existence import Existence
from deworldsg_ros.merging.fit import fit, one_to_one
from deworldsg_ros.merging.fit import warm_up as warm_up_fit
from deworldsg_ros.merging.joint import JointEvidence
from deworldsg_ros.merging.limits import LifeCycleLimits
from deworldsg_ros.merging.local import Memory, add_relations, check_fits, warm_up_graph
from deworldsg_ros.merging.lost_nodes import LostNodes, alike_elsewhere
from deworldsg_ros.merging.owners import Owners
from deworldsg_ros.merging.voxel_map import CellSets, VoxelMap
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.nodes import NodeTable

# Gaussians are weighted by their number of pixels; this many make an observation of weight 1.
PIXELS_OF_UNIT_WEIGHT = 1000.0
# A node that has this share of its cells where a frame shows others has swallowed a part of them;
# less are cells along a common border.
CONTESTED_SHARE = 0.1


class SurfaceMerging:
    """Merges local graphs into a scene graph by the overlap of surfaces."""

    def __init__(self, config: MergingConfig, limits: LifeCycleLimits = LifeCycleLimits()) -> None:
        self._config = config
        self._limits = limits
        self._owners = Owners()
        # Each of these knows the nodes by their owner indices.
        self._map = VoxelMap()
        self._joint = JointEvidence()
        self._existence = Existence(config.confirm_observations, limits)
        self._through = SeenThrough(limits.absent_frames)
        # Owners whose surface has changed since `_through` took points of it.
        self._changed: set[int] = set()
        self._lost = LostNodes(limits.lost_s)
        # Nodes that were sure once; they are hidden, and keep their ids until they are found again.
        self._doubted: set[int] = set()
        self._alignment = PoseAlignment()

    def warm_up(self) -> None:
        """Compile now what would else be compiled during the first frame."""
        known = VoxelMap()
        sets = known.cells_of([np.zeros((1, 3), np.float32)])
        known.add([0], sets)
        known.shares(sets)
        known.contest([0], sets, 0.0)
        known.remove(0)
        grid = DepthGrid(np.ones((1, 1), np.uint16), 8, Intrinsics(1.0, 1.0, 0.0, 0.0, 8, 8))
        absence = SeenThrough(1)
        nodes = NodeTable(1, 1)
        nodes.append(1)
        absence.renew([0], nodes, [0])
        absence.look(np.eye(4), grid, [])
        self._existence.warm_up()
        if self._config.align_poses:
            self._alignment.warm_up()
        warm_up_fit()
        warm_up_graph()

    def merge(self, graph: SceneGraph, local: LocalGraph) -> list[int]:
        """Merge one frame into the graph; see `Merging.merge`.

        Two objects of one frame are never one node: they stay two even where both overlap it.
        """
        check_fits(graph, local)
        if self._config.align_poses:
            local = self._alignment.align(graph, local)
        cells = self._map.cells_of(local.surface_points_world)
        owners, shares = self._map.shares(cells)
        rows = [graph.nodes.row(self._owners.node(owner)) for owner in owners]
        values, touching = fit(
            local,
            graph.nodes,
            np.array(rows, np.int64),
            shares,
            self._config.overlap_threshold,
            self._map.cell_m,
        )
        matched = one_to_one(values)
        places = [owners[column] if column >= 0 else -1 for column in matched]
        self._contest(graph, cells, places)
        node_ids = self._place(graph, local, cells, places)
        seen = [self._owner(node_id) for node_id in node_ids]
        self._joint.note(seen, owners, values, touching, matched)
        self._merge_grown(graph)
        node_ids = [graph.resolve(node_id) for node_id in node_ids]
        self._look_for_absent(graph, local, node_ids)
        self._expire(graph, local.stamp_ns)
        node_ids = [graph.resolve(node_id) for node_id in node_ids]
        graph.remember_frame(local.stamp_ns, node_ids)
        add_relations(graph, local, node_ids)
        return node_ids

    def memory(self) -> Memory:
        """See `Merging.memory`."""
        node_ids = list(self._owners.ids)
        owners = list(self._owners.ids.values())
        sets = [self._map.cells(owner) for owner in owners]
        counts = self._joint.counts
        pairs = [[*map(self._owners.node, pair), count] for pair, count in counts.items()]
        return {
            "cell_m": np.array(self._map.cell_m),
            "node_ids": np.array(node_ids, np.int64),
            "blocks": np.concatenate([np.zeros(0, np.int64), *(cells.blocks for cells in sets)]),
            "masks": np.concatenate([np.zeros(0, np.uint64), *(cells.masks for cells in sets)]),
            "block_counts": np.array([len(cells.blocks) for cells in sets], np.int64),
            "existence": self._existence.records(owners),
            "looks_by_view": self._existence.by_view,
            "joint": np.array(pairs, np.int64).reshape(-1, 3),
        }

    def restore(self, graph: SceneGraph, memory: Memory) -> None:
        """See `Merging.restore`."""
        nodes = graph.nodes
        owner_of = {node_id: self._owners.take(node_id) for node_id in nodes.ids.tolist()}
        owners = list(owner_of.values())
        self._changed.update(owners)
        # Of the paper's rule there is none, and cells of another size say nothing.
        if not memory or memory["cell_m"] != self._map.cell_m:
            surfaces = [nodes.surface(row) for row in range(len(nodes))]
            self._map.add(owners, self._map.cells_of(surfaces))
            for owner, observations in zip(owners, nodes.observations.tolist()):
                self._existence.presume(owner, observations)
            return
        kept = [row for row, node_id in enumerate(memory["node_ids"]) if node_id in owner_of]
        owners = [owner_of[node_id] for node_id in memory["node_ids"][kept].tolist()]
        records = memory["existence"][kept]
        self._existence.restore(owners, records, memory["looks_by_view"])
        counts = memory["block_counts"]
        stops = np.cumsum(counts)
        for owner, row in zip(owners, kept):
            own = slice(stops[row] - counts[row], stops[row])
            cells = memory["blocks"][own], memory["masks"][own], np.array([0, counts[row]])
            self._map.add([owner], CellSets(*cells))
        self._joint.restore(
            {
                (owner_of[a], owner_of[b]): count
                for a, b, count in memory["joint"].tolist()
                if a in owner_of and b in owner_of
            }
        )

    def moved(self, graph: SceneGraph, node_ids: list[int], T_correction: Float64) -> None:
        """See `Merging.moved`."""
        # Whoever corrects the past corrects the poses to come.
        self._alignment = PoseAlignment()
        for node_id in node_ids:
            owner = self._owners.of(node_id)
            if owner is None:  # lost: it is in no cell
                continue
            centres = self._map.centres(owner).astype(np.float64)
            centres = centres @ T_correction[:3, :3].T + T_correction[:3, 3]
            row = graph.nodes.row(node_id)
            points = graph.nodes.surface(row)
            cells = self._map.cells_of([np.concatenate((centres.astype(np.float32), points))])
            self._map.remove(owner)
            self._map.add([owner], cells)
            self._through.renew([owner], graph.nodes, [row])

    def _contest(self, graph: SceneGraph, cells: CellSets, owners: list[int]) -> None:
        """Correct nodes that have a part of what this frame shows to be another.

        A Gaussian with so much of another object in it is worth less than those to come.
        """
        for owner, share in self._map.contest(owners, cells, CONTESTED_SHARE).items():
            node_id = self._owners.node(owner)
            points = graph.nodes.surface(graph.nodes.row(node_id))
            graph.correct(node_id, 1.0 - share, points[self._map.holds(owner, points)])

    def _place(
        self, graph: SceneGraph, local: LocalGraph, cells: CellSets, owners: list[int]
    ) -> list[int]:
        """Fuse each object into the node of its owner; without one (-1), found a tentative node."""
        weights = local.pixel_counts / PIXELS_OF_UNIT_WEIGHT
        surfaces = local.surface_points_world
        known = [row for row, owner in enumerate(owners) if owner >= 0]
        node_ids = [self._owners.node(owner) if owner >= 0 else 0 for owner in owners]
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
                owners[row] = self._owners.take(node_ids[row])
        self._map.add(owners, cells)
        self._existence.detected(
            owners,
            local.means_world,
            local.scores,
            local.T_world_camera[:3, 3],
            local.stamp_ns,
        )
        return [self._confirm(graph, node_id) for node_id in node_ids]

    def _confirm(self, graph: SceneGraph, node_id: int) -> int:
        """Confirm a node that was seen often enough; it may take up the id of one that was lost."""
        row = graph.nodes.row(node_id)
        if graph.nodes.confirmed[row] or not self._existence.sure(self._owner(node_id)):
            return node_id
        graph.set_confirmed(node_id, True)
        if node_id in self._doubted:
            self._doubted.remove(node_id)
            return node_id
        lost_id = self._lost.match(graph, node_id)
        if lost_id is None:
            return node_id
        self._lost.found(lost_id)
        self._move(graph, lost_id, node_id)
        return lost_id

    def _look_for_absent(self, graph: SceneGraph, local: LocalGraph, node_ids: list[int]) -> None:
        """Lose the nodes through whose place the camera has looked for some frames in a row."""
        seen = {self._owner(node_id) for node_id in node_ids}
        self._changed |= seen
        if local.depth_grid is None:
            return
        # What is seen need not be looked for: its points are renewed when it is out of sight.
        changed = list(self._changed - seen)
        rows = [graph.nodes.row(self._owners.node(owner)) for owner in changed]
        self._through.renew(changed, graph.nodes, rows)
        self._changed = seen
        gone, views = self._through.look(local.T_world_camera, local.depth_grid, list(seen))
        in_view = np.flatnonzero(views).tolist()
        found = [owner for owner in in_view if owner in seen]
        self._existence.viewed(found, views[found])
        self._doubt(graph, local, [owner for owner in in_view if owner not in seen], views)
        for owner in gone:
            # Of two that are gone, the one may just have become the other.
            if self._owners.node(owner):
                self._lose(graph, self._owners.node(owner), local.stamp_ns)

    def _doubt(self, graph: SceneGraph, local: LocalGraph, missed: list[int], views: Int64) -> None:
        """Hide the nodes that the detector fails to find although they are in view."""
        node_ids = [self._owners.node(owner) for owner in missed]
        rows = [graph.nodes.row(node_id) for node_id in node_ids]
        camera_world = local.T_world_camera[:3, 3]
        for owner in self._existence.missed(
            missed, views[missed], graph.nodes.means[rows], camera_world, local.stamp_ns
        ):
            node_id = self._owners.node(owner)
            if graph.nodes.confirmed[graph.nodes.row(node_id)]:
                graph.set_confirmed(node_id, False)
                self._doubted.add(node_id)

    def _lose(self, graph: SceneGraph, node_id: int, stamp_ns: int) -> None:
        """Take a node from its place; its id may turn up elsewhere, now or soon."""
        self._free(node_id)
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
        self._owners.rename(new_id, old_id)
        self._alignment.forget(new_id)

    def _merge_grown(self, graph: SceneGraph) -> None:
        """Merge nodes that have turned out to be parts of one object."""
        while (pair := self._joint.take()) is not None:
            a_id, b_id = (self._owners.node(owner) for owner in pair)
            kept_id = graph.merge_nodes(a_id, b_id)
            kept = self._owner(kept_id)
            gone_id = b_id if kept_id == a_id else a_id
            self._existence.merge(kept, self._owner(gone_id))
            if gone_id in self._doubted and not graph.nodes.confirmed[graph.nodes.row(kept_id)]:
                self._doubted.add(kept_id)
            self._joint.merge(kept, self._owner(gone_id))
            cells = self._free(gone_id)
            self._map.add([kept], cells)
            self._changed.add(kept)

    def _expire(self, graph: SceneGraph, stamp_ns: int) -> None:
        """Remove tentative nodes that have not been seen for long, and what was lost for good."""
        nodes = graph.nodes
        oldest_ns = stamp_ns - int(self._limits.expire_tentative_s * 1e9)
        old = nodes.ids[~nodes.confirmed & (nodes.last_seen_ns < oldest_ns)].tolist()
        for node_id in old:
            if node_id not in self._lost and node_id not in self._doubted:
                graph.remove_node(node_id)
                self._free(node_id)
        for node_id in self._lost.take_expired(stamp_ns):
            graph.remove_node(node_id)

    def _owner(self, node_id: int) -> int:
        owner = self._owners.of(node_id)
        assert owner is not None, f"node {node_id} has no owner index"
        return owner

    def _free(self, node_id: int) -> CellSets:
        """Forget a node that is gone; returns the cells it had."""
        owner = self._owners.free(node_id)
        self._doubted.discard(node_id)
        self._existence.forget(owner)
        self._alignment.forget(node_id)
        self._joint.forget(owner)
        self._through.forget(owner)
        self._changed.discard(owner)
        return self._map.remove(owner)
