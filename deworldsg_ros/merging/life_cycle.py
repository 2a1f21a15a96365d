"""Life cycle of a node under the surface rule: published, hidden, merged, lost, removed."""

from __future__ import annotations

import itertools
from collections.abc import Collection

import numpy as np

from deworldsg_ros.merging import existence
from deworldsg_ros.merging.lost_nodes import LostNodes, moved_object
from deworldsg_ros.merging.node_records import NodeRecords
from deworldsg_ros.merging.views import HALF, NOT_VISIBLE, View
from deworldsg_ros.scene.arrays import Bool, Int64
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.graph import SceneGraph

# A hidden node that is less probable than FORGOTTEN is removed when unseen for FORGOTTEN_NS. The
# time is chosen, not measured: longer than a camera needs to return to an object.
FORGOTTEN = 0.2
FORGOTTEN_NS = 10_000_000_000
# A node is removed from its position after this number of consecutive frames that see through it.
# One frame is not enough: depth images have holes and noise.
ABSENT_FRAMES = 5
# A moved object keeps its id if it is detected again within this time. Chosen, not measured.
LOST_S = 30.0
# Why a deleted node is not published.
DELETED = "deleted by the operator"


class LifeCycle:
    """Publishes, hides, merges and removes nodes.

    Args:
        records: of all nodes.
        min_existence: a node is published if it is an object with at least this probability.
    """

    def __init__(self, records: NodeRecords, min_existence: float) -> None:
        self._records = records
        self._min_existence = min_existence
        self._lost = LostNodes(LOST_S)
        # Nodes that may be forgotten; some may have been removed.
        self._improbable: set[int] = set()

    def restore(self, graph: SceneGraph) -> None:
        """Continue with a graph of an earlier run; call it before the first frame."""
        nodes = graph.nodes
        improbable = _are_improbable(graph, np.arange(len(nodes)))
        self._improbable = set(nodes.ids[improbable].tolist())

    def observe(
        self, graph: SceneGraph, local: LocalGraph, view: View, node_ids: list[int]
    ) -> None:
        """Add a frame to the looks at all nodes that it shows; publish, hide and remove nodes.

        Args:
            graph: changed.
            local: the frame.
            view: what the frame shows of the nodes before it was merged.
            node_ids: node of each row of the frame.
        """
        records = self._records
        self._forget(graph, local.stamp_ns)
        scores: dict[int, float] = {}
        for node_id, score in zip(node_ids, local.scores.tolist()):
            scores[node_id] = max(scores.get(node_id, 0.0), score)
        shown = {
            node_id: visibility
            for node_id, visibility in zip(view.ids.tolist(), view.visibilities.tolist())
            if visibility > NOT_VISIBLE and node_id in records.owner_of
        }
        ids = sorted(scores.keys() | shown.keys())
        owners = np.array(records.owners_of(ids), np.int64)
        rows = graph.nodes.rows_at(ids)
        records.look(
            owners,
            np.array([scores.get(node_id, 0.0) for node_id in ids]),
            np.array([shown.get(node_id, NOT_VISIBLE) for node_id in ids], np.int64),
            graph.nodes.means[rows],
            local.T_world_camera[:3, 3],
            local.stamp_ns,
        )
        self._publish(graph, ids, rows, owners)
        for node_id in self._absent(view, scores.keys()):
            # It may be gone: another absent node of this frame has taken its place.
            if node_id in records and node_id not in graph.edits.deleted:
                self._lose(graph, node_id, local.stamp_ns)

    def _absent(self, view: View, detected: Collection[int]) -> list[int]:
        """Nodes that enough consecutive frames have seen through."""
        records, absent = self._records, []
        present = {*detected, *view.ids[view.visibilities >= HALF].tolist()}
        frames = records.rows["through_frames"]
        frames[records.owners_of([node_id for node_id in present if node_id in records])] = 0
        for node_id in view.ids[view.through].tolist():
            if node_id in present or node_id not in records:
                continue
            owner = records.owner(node_id)
            frames[owner] += 1
            if frames[owner] >= ABSENT_FRAMES:
                absent.append(node_id)
        return absent

    def hidden(self, graph: SceneGraph) -> dict[int, str]:
        """The nodes that are not published, each with its reason, in words."""
        nodes, records = graph.nodes, self._records
        edits = graph.edits
        hidden = [i for i in nodes.ids[~nodes.confirmed].tolist() if i not in edits.replaced]
        ids = [node_id for node_id in hidden if node_id in records]
        missed = records.are_missed(records.owners_of(ids), self._min_existence)
        reasons = {
            i: "absent from its position" if i in self._lost else "seen too little" for i in hidden
        }
        for node_id, is_missed in zip(ids, missed.tolist()):
            reasons[node_id] = "missed by the detector" if is_missed else "seen too little"
        return {**reasons, **dict.fromkeys(edits.deleted, DELETED)}

    def publish_again(self, graph: SceneGraph, node_ids: list[int]) -> None:
        """Publish nodes that an edit has hidden, if they are likely to be objects."""
        owners = self._records.owners_of(node_ids)
        graph.set_existence(node_ids, self._records.existence(owners), self._min_existence)

    def remove(self, graph: SceneGraph, node_id: int) -> None:
        """Remove a node, wherever its object is."""
        if node_id in self._lost:
            self._lost.remove(node_id)
        else:
            self._records.remove(node_id)
        graph.remove_node(node_id)

    def _publish(self, graph: SceneGraph, node_ids: list[int], rows: Int64, owners: Int64) -> None:
        """Publish the nodes that are likely to be objects, and hide the others."""
        records = self._records
        probabilities = records.existence(owners)
        existence.settle(records.rows, records.fates, owners, probabilities)
        new_ids = graph.set_existence(node_ids, probabilities, self._min_existence)
        improbable = _are_improbable(graph, rows).tolist()
        self._improbable.difference_update(node_ids)
        self._improbable.update(itertools.compress(node_ids, improbable))
        for node_id in new_ids:
            # A new node that is the object of a lost node takes the id of the lost node.
            lost_id = self._lost.match(graph, node_id)
            if lost_id is not None:
                self._lost.remove(lost_id)
                self._move(graph, lost_id, node_id)

    def _forget(self, graph: SceneGraph, stamp_ns: int) -> None:
        """Remove improbable nodes that were not seen for long, and nodes lost for too long."""
        nodes = graph.nodes
        if self._improbable:
            # In the order of the rows, which depends on nothing but the frames.
            ids = sorted((i for i in self._improbable if i in nodes), key=nodes.row)
            self._improbable.intersection_update(ids)
            rows = nodes.rows_at(ids)
            old = _are_improbable(graph, rows)
            old &= nodes.last_seen_ns[rows] < stamp_ns - FORGOTTEN_NS
            for node_id in itertools.compress(ids, old.tolist()):
                if node_id not in self._lost and not graph.edits.hides(node_id):
                    self._improbable.discard(node_id)
                    graph.remove_node(node_id)
                    self._records.remove(node_id)
        for node_id in self._lost.take_expired(stamp_ns):
            graph.remove_node(node_id)

    def _lose(self, graph: SceneGraph, node_id: int, stamp_ns: int) -> None:
        """Remove an absent node from its position; its id may continue elsewhere, now or later."""
        self._records.remove(node_id)
        row = graph.nodes.row(node_id)
        if not graph.nodes.confirmed[row]:
            graph.remove_node(node_id)
            return
        graph.set_existence([node_id], graph.nodes.existence[[row]], np.inf)
        moved_id = moved_object(graph, node_id)
        if moved_id is None:
            self._lost.add(node_id, stamp_ns)
        else:
            self._move(graph, node_id, moved_id)

    def _move(self, graph: SceneGraph, old_id: int, new_id: int) -> None:
        """Continue the id of a lost node at the node that its object has become."""
        graph.take_over(old_id, new_id)
        self._records.rename(new_id, old_id)


def _are_improbable(graph: SceneGraph, rows: Int64) -> Bool:
    """Whether (n,) the nodes of rows are hidden and too improbable to be kept."""
    nodes = graph.nodes
    improbable: Bool = ~nodes.confirmed[rows] & (nodes.existence[rows] < FORGOTTEN)
    return improbable
