"""Life cycle of a node under the surface rule: tentative, confirmed, hidden, lost, removed."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.merging.limits import LifeCycleLimits
from deworldsg_ros.merging.lost_nodes import LostNodes, moved_object
from deworldsg_ros.merging.node_records import NodeRecords
from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.graph import SceneGraph


class LifeCycle:
    """Confirms, hides, merges and removes nodes.

    Args:
        records: of all nodes.
        limits: times and numbers of frames.
    """

    def __init__(self, records: NodeRecords, limits: LifeCycleLimits) -> None:
        self._records = records
        self._expire_ns = int(limits.expire_tentative_s * 1e9)
        self._lost = LostNodes(limits.lost_s)
        # Nodes that were confirmed before and are tentative again. They are hidden and keep their
        # ids.
        self._hidden: set[int] = set()

    def confirm(self, graph: SceneGraph, node_id: int) -> int:
        """Confirm a node if there is enough evidence; returns its id.

        A new node that is the object of a lost node takes the id of the lost node.
        """
        row = graph.nodes.row(node_id)
        if graph.nodes.confirmed[row]:
            return node_id
        if not self._records.existence.is_confirmed(self._records.owners.of(node_id)):
            return node_id
        graph.set_confirmed(node_id, True)
        if node_id in self._hidden:
            self._hidden.remove(node_id)
            return node_id
        lost_id = self._lost.match(graph, node_id)
        if lost_id is None:
            return node_id
        self._lost.remove(lost_id)
        self._move(graph, lost_id, node_id)
        return lost_id

    def merge_parts(self, graph: SceneGraph) -> None:
        """Merge the nodes that are parts of one object."""
        records = self._records
        while (pair := records.joint.next_merge()) is not None:
            a_id, b_id = (records.owners.node(owner) for owner in pair)
            kept_id = graph.merge_nodes(a_id, b_id)
            removed_id = b_id if kept_id == a_id else a_id
            if removed_id in self._hidden and not graph.nodes.confirmed[graph.nodes.row(kept_id)]:
                self._hidden.add(kept_id)
            self._hidden.discard(removed_id)
            records.merge(kept_id, removed_id)

    def observe_depth(self, graph: SceneGraph, local: LocalGraph, node_ids: list[int]) -> None:
        """Compare all nodes with the depth of a frame: hide missed nodes, remove absent ones.

        Args:
            graph: changed.
            local: the frame.
            node_ids: nodes detected in the frame.
        """
        records = self._records
        detected = {records.owners.of(node_id) for node_id in node_ids}
        records.changed |= detected
        if local.depth_grid is None:
            return
        # A detected node is present. Its surface is sampled once it is no longer detected.
        changed = list(records.changed - detected)
        records.absence.update_points(changed, graph.nodes, records.rows(graph, changed))
        records.changed = detected
        absent, visibilities = records.absence.observe(
            local.T_world_camera, local.depth_grid, list(detected)
        )
        visible = np.flatnonzero(visibilities).tolist()
        found = [owner for owner in visible if owner in detected]
        records.existence.update_visibility(found, visibilities[found])
        missed = [owner for owner in visible if owner not in detected]
        self._hide_doubtful(graph, local, missed, visibilities)
        for owner in absent:
            # 0: removed while an earlier absent node of this frame was processed.
            if records.owners.node(owner):
                self._lose(graph, records.owners.node(owner), local.stamp_ns)

    def expire(self, graph: SceneGraph, stamp_ns: int) -> None:
        """Remove tentative nodes that were not seen for long, and nodes lost for too long."""
        nodes = graph.nodes
        oldest_ns = stamp_ns - self._expire_ns
        old = nodes.ids[~nodes.confirmed & (nodes.last_seen_ns < oldest_ns)].tolist()
        for node_id in old:
            if node_id not in self._lost and node_id not in self._hidden:
                graph.remove_node(node_id)
                self._records.remove(node_id)
        for node_id in self._lost.take_expired(stamp_ns):
            graph.remove_node(node_id)

    def _hide_doubtful(
        self, graph: SceneGraph, local: LocalGraph, missed: list[int], visibilities: Int64
    ) -> None:
        """Hide confirmed nodes that the detector misses too often."""
        records = self._records
        doubtful = records.existence.add_misses(
            missed,
            visibilities[missed],
            graph.nodes.means[records.rows(graph, missed)],
            local.T_world_camera[:3, 3],
            local.stamp_ns,
        )
        for owner in doubtful:
            node_id = records.owners.node(owner)
            if graph.nodes.confirmed[graph.nodes.row(node_id)]:
                graph.set_confirmed(node_id, False)
                self._hidden.add(node_id)

    def _lose(self, graph: SceneGraph, node_id: int, stamp_ns: int) -> None:
        """Remove an absent node from its position; its id may continue elsewhere, now or later."""
        self._records.remove(node_id)
        self._hidden.discard(node_id)
        if not graph.nodes.confirmed[graph.nodes.row(node_id)]:
            graph.remove_node(node_id)
            return
        graph.set_confirmed(node_id, False)
        moved_id = moved_object(graph, node_id)
        if moved_id is None:
            self._lost.add(node_id, stamp_ns)
        else:
            self._move(graph, node_id, moved_id)

    def _move(self, graph: SceneGraph, old_id: int, new_id: int) -> None:
        """Continue the id of a lost node at the node that its object has become."""
        graph.take_over(old_id, new_id)
        self._records.rename(new_id, old_id)
