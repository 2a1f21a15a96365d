"""Life cycle of a node under the surface rule: published, hidden, merged, lost, removed."""

from __future__ import annotations

import itertools
from collections.abc import Collection

import numpy as np

from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import ABSENT
from deworldsg_ros.merging.records import NodeRecords
from deworldsg_ros.merging.views import HALF, NOT_VISIBLE, View
from deworldsg_ros.scene.arrays import Bool, Int64
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.gaussian import hellinger_distance

# --- Nodes whose object is absent from its position, and their recognition elsewhere.

# Maximum Hellinger distance of two Gaussians with the same mean whose shapes are similar.
SHAPE_THRESHOLD = 0.6


class LostNodes:
    """Keeps lost nodes, hidden, for a while. A new node may turn out to be one of them.

    Args:
        memory_frames: number of frames in which a lost node may be recognised.
    """

    def __init__(self, memory_frames: int) -> None:
        self._memory_frames = memory_frames
        # The frame that lost each node.
        self._lost: dict[int, int] = {}

    def __contains__(self, node_id: object) -> bool:
        return node_id in self._lost

    def __len__(self) -> int:
        return len(self._lost)

    def add(self, node_id: int, frame: int) -> None:
        """Add a node whose object is absent since this frame, by its number."""
        self._lost[node_id] = frame

    def match(self, graph: GlobalGraph, node_id: int) -> int | None:
        """The lost node that is the same object as a new node; None if there is not exactly one."""
        nodes = graph.nodes
        slots = nodes.slots_of(list(self._lost))
        earlier = slots[nodes.last_seen_ns[slots] < nodes.first_seen_ns[nodes.slot(node_id)]]
        similar = earlier[_are_similar(graph, node_id, earlier)]
        return int(nodes.ids[similar[0]]) if len(similar) == 1 else None

    def remove(self, node_id: int) -> None:
        """Remove a lost node that was recognised."""
        del self._lost[node_id]

    def take_expired(self, frame: int) -> list[int]:
        """Remove and return the nodes that have been lost for too long at this frame."""
        # The first one was lost first.
        expired = []
        for node_id, since in self._lost.items():
            if frame - since <= self._memory_frames:
                break
            expired.append(node_id)
        for node_id in expired:
            del self._lost[node_id]
        return expired


def moved_object(graph: GlobalGraph, lost_id: int) -> int | None:
    """The confirmed node that is the object of a lost node at its new position.

    It was first seen after the lost node was last seen, and has the same class and a similar shape.
    None if there is not exactly one.
    """
    nodes = graph.nodes
    last_ns = nodes.last_seen_ns[nodes.slot(lost_id)]
    later = np.flatnonzero(nodes.confirmed & (nodes.first_seen_ns > last_ns))
    similar = later[_are_similar(graph, lost_id, later)]
    return int(nodes.ids[similar[0]]) if len(similar) == 1 else None


def _are_similar(graph: GlobalGraph, node_id: int, slots: Int64) -> Bool:
    """Whether a node and those of some slots (n,) have the same class and similar shapes."""
    nodes = graph.nodes
    slot = nodes.slot(node_id)
    label = nodes.class_probabilities[slot].argmax()
    similar: Bool = nodes.class_probabilities[slots].argmax(axis=1) == label
    if similar.any():
        origin, alike = np.zeros(3), slots[similar]
        similar[similar] = (
            hellinger_distance(origin, nodes.covariances[slot], origin, nodes.covariances[alike])
            < SHAPE_THRESHOLD
        )
    return similar


# --- Life cycle of a node under the surface rule: published, hidden, merged, lost, removed.

# A hidden node that is less probable than FORGOTTEN is removed when no frame has detected it for
# FORGOTTEN_FRAMES, three seconds of video; 30 and 300 found about as much. Frames are counted and
# not seconds: the same pictures say the same at any rate.
FORGOTTEN = 0.2
FORGOTTEN_FRAMES = 100
# A node is removed from its position after this number of consecutive frames that see through it.
# One frame is not enough: depth images have holes and noise.
ABSENT_FRAMES = 5
# A moved object keeps its id if it is detected again within this number of frames, 30 s of video.
# Chosen, not measured.
LOST_FRAMES = 900
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
        self._lost = LostNodes(LOST_FRAMES)
        # Nodes that may be forgotten; some may have been removed.
        self._improbable: set[int] = set()

    def restore(self, graph: GlobalGraph) -> None:
        """Continue with a graph of an earlier run; call it before the first frame."""
        nodes = graph.nodes
        slots = nodes.slots
        self._improbable = set(nodes.ids[slots[_are_improbable(graph, slots)]].tolist())

    def observe(
        self, graph: GlobalGraph, local: LocalGraph, view: View, node_ids: list[int]
    ) -> None:
        """Add a frame to the looks at all nodes that it shows; publish, hide and remove nodes.

        Args:
            graph: changed.
            local: the frame.
            view: what the frame shows of the nodes before it was merged.
            node_ids: node of each row of the frame.
        """
        records, slot_of = self._records, graph.nodes.slot_of
        self._forget(graph)
        scores: dict[int, float] = {}
        for node_id, score in zip(node_ids, local.scores.tolist()):
            scores[node_id] = max(scores.get(node_id, 0.0), score)
        seen = (view.visibilities > NOT_VISIBLE) & self._live(view)
        shown = dict(zip(view.ids[seen].tolist(), view.visibilities[seen].tolist()))
        ids = sorted(scores.keys() | shown.keys())
        slots = graph.nodes.slots_of(ids)
        records.look(
            slots,
            np.array([scores.get(node_id, 0.0) for node_id in ids]),
            np.array([shown.get(node_id, NOT_VISIBLE) for node_id in ids], np.int64),
            graph.nodes.means[slots],
            local.T_world_camera[:3, 3],
        )
        self._publish(graph, ids, slots)
        for node_id in self._absent(graph, view, scores.keys()):
            # It may be gone: another absent node of this frame has taken its place.
            if records.has(slot_of.get(node_id)) and node_id not in graph.edits.deleted:
                self._lose(graph, node_id)

    def _absent(self, graph: GlobalGraph, view: View, detected: Collection[int]) -> list[int]:
        """Nodes that enough consecutive frames have seen through."""
        live = self._live(view)
        frames, absent = self._records.rows["through_frames"], []
        present = live & (view.visibilities >= HALF)
        slot_of = graph.nodes.slot_of
        frames[[slot_of[node_id] for node_id in detected if node_id in slot_of]] = 0
        frames[view.slots[present]] = 0
        through = live & view.through & ~present
        for node_id, slot in zip(view.ids[through].tolist(), view.slots[through].tolist()):
            if node_id in detected:
                continue
            frames[slot] += 1
            if frames[slot] >= ABSENT_FRAMES:
                absent.append(node_id)
        return absent

    def _live(self, view: View) -> Bool:
        """Whether (m,) the nodes of a view still have a record after this frame."""
        live: Bool = self._records.rows["node_id"][view.slots] == view.ids
        return live

    def hidden(self, graph: GlobalGraph) -> dict[int, str]:
        """The nodes that are not published, each with its reason, in words."""
        nodes, records = graph.nodes, self._records
        edits = graph.edits
        slots = nodes.slots
        hidden = nodes.ids[slots[~nodes.confirmed[slots]]].tolist()
        hidden = [node_id for node_id in hidden if node_id not in edits.replaced]
        ids = [node_id for node_id in hidden if records.has(nodes.slot(node_id))]
        missed = records.are_missed(nodes.slots_of(ids), self._min_existence)
        reasons = {i: ABSENT if i in self._lost else "seen too little" for i in hidden}
        for node_id, is_missed in zip(ids, missed.tolist()):
            reasons[node_id] = "missed by the detector" if is_missed else "seen too little"
        return {**reasons, **dict.fromkeys(edits.deleted, DELETED)}

    def bring_back(self, graph: GlobalGraph, slots: Int64) -> Int64:
        """Take lost nodes of n slots back: they were lost under poses that were wrong.

        Returns:
            The slots that have a record.
        """
        records, nodes = self._records, graph.nodes
        for node_id, slot in zip(nodes.ids[slots].tolist(), slots.tolist()):
            if node_id in self._lost:
                self._lost.remove(node_id)
                records.rows["node_id"][slot] = node_id  # the slot is the node's: the rest stays
                records.rows["through_frames"][slot] = 0
                records.map.add([slot], records.map.cells_of([nodes.surface(slot)]))
                records.place(graph, [slot])
                self.publish_again(graph, [node_id])
        return slots[[records.has(slot) for slot in slots.tolist()]]

    def publish_again(self, graph: GlobalGraph, node_ids: list[int]) -> None:
        """Publish nodes that were hidden, if they are likely to be objects; hide the others."""
        existence = self._records.existence(graph.nodes.slots_of(node_ids))
        graph.set_existence(node_ids, existence, self._min_existence)

    def publish_from(self, graph: GlobalGraph, min_existence: float) -> None:
        """Use another least probability, also for the nodes that are known already."""
        if min_existence != self._min_existence:
            self._min_existence = min_existence
            slot_of = graph.nodes.slot_of
            self.publish_again(graph, [i for i in slot_of if self._records.has(slot_of[i])])

    def remove(self, graph: GlobalGraph, node_id: int) -> None:
        """Remove a node, wherever its object is."""
        if node_id in self._lost:
            self._lost.remove(node_id)
        else:
            self._records.remove(graph.nodes.slot(node_id))
        graph.remove_node(node_id)

    def _publish(self, graph: GlobalGraph, node_ids: list[int], slots: Int64) -> None:
        """Publish the nodes that are likely to be objects, and hide the others."""
        records = self._records
        probabilities = records.settle(slots)
        new_ids = graph.set_existence(node_ids, probabilities, self._min_existence)
        improbable = _are_improbable(graph, slots).tolist()
        self._improbable.difference_update(node_ids)
        self._improbable.update(itertools.compress(node_ids, improbable))
        for node_id in new_ids:
            # A new node that is the object of a lost node takes the id of the lost node.
            lost_id = self._lost.match(graph, node_id)
            if lost_id is not None:
                self._lost.remove(lost_id)
                self._move(graph, lost_id, node_id)

    def _forget(self, graph: GlobalGraph) -> None:
        """Remove improbable nodes that were not detected for long, and nodes lost for too long."""
        nodes = graph.nodes
        if self._improbable:
            # In the order of the slots, which depends on nothing but the frames.
            ids = sorted((i for i in self._improbable if i in nodes), key=nodes.slot)
            self._improbable.intersection_update(ids)
            slots = nodes.slots_of(ids)
            old = _are_improbable(graph, slots)
            last = self._records.rows["last_frame"][slots]
            old &= last < self._records.frames - FORGOTTEN_FRAMES
            for node_id in itertools.compress(ids, old.tolist()):
                if node_id not in self._lost and not graph.edits.hides(node_id):
                    self._improbable.discard(node_id)
                    self._records.remove(nodes.slot(node_id))
                    graph.remove_node(node_id)
        for node_id in self._lost.take_expired(self._records.frames):
            graph.remove_node(node_id)

    def _lose(self, graph: GlobalGraph, node_id: int) -> None:
        """Remove an absent node from its position; its id may continue elsewhere, now or later."""
        slot = graph.nodes.slot(node_id)
        self._records.remove(slot)
        if not graph.nodes.confirmed[slot]:
            graph.remove_node(node_id)
            return
        graph.set_existence([node_id], graph.nodes.existence[[slot]], np.inf)
        moved_id = moved_object(graph, node_id)
        if moved_id is None:
            self._lost.add(node_id, self._records.frames)
        else:
            self._move(graph, node_id, moved_id)

    def _move(self, graph: GlobalGraph, old_id: int, new_id: int) -> None:
        """Continue the id of a lost node at the node that its object has become."""
        old, new = graph.nodes.slot(old_id), graph.nodes.slot(new_id)
        graph.take_over(old_id, new_id)
        self._records.move(graph, new, old)


def _are_improbable(graph: GlobalGraph, slots: Int64) -> Bool:
    """Whether (n,) the nodes of slots are hidden and too improbable to be kept."""
    nodes = graph.nodes
    improbable: Bool = ~nodes.confirmed[slots] & (nodes.existence[slots] < FORGOTTEN)
    return improbable
