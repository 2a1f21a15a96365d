"""Merging and relation fusion, composed: local graphs and relation evidence become the graph.

The graph node and the in-process pipeline both use this, so that they give the same graph.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import numpy as np

from deworldsg_ros.config import Config, MergingConfig
from deworldsg_ros.graph.edits import GraphEdit, NameRoom
from deworldsg_ros.graph.floor_plan import FoundThings, Things
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import NodeBoxes, hidden_node
from deworldsg_ros.graph.pairs import frame_votes
from deworldsg_ros.graph.provenance import FrameMemory, SeenSpace, Trail, TrailChange
from deworldsg_ros.graph.publication import Publication
from deworldsg_ros.graph.rooms import RoomMap
from deworldsg_ros.merging.editing import EditReply
from deworldsg_ros.merging.stage import build_merging
from deworldsg_ros.poses.drift import Drift, moved
from deworldsg_ros.relations import beliefs
from deworldsg_ros.relations.beliefs import EdgeBeliefs
from deworldsg_ros.relations.paper import ClassPairPrior, candidates
from deworldsg_ros.scene.arrays import Float64, Int64, softmax_weights
from deworldsg_ros.scene.camera import UpEstimator, check_pose
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence, Vocabulary, derived
from deworldsg_ros.scene.limits import RESTART_NS
from deworldsg_ros.wire import messages as wire

# Parts of the kernels that take about equally long to compile.
KERNEL_PARTS = ("merging", "drift", "pairs")
# Nodes that follow a trajectory in one call: about 10 ms.
MOVED_A_CALL = 32


class GraphBuilder:
    """Keeps the global graph and publishes it.

    Args:
        config: sections ``merging``, ``relations`` and ``output`` are used.
        vocabulary: of the local graphs to come; they may bring more classes.
        frame_id: world frame of all local graphs to come.
        graph, prior: to continue with, e.g. those of a map; empty ones if omitted.

    Attributes:
        graph: the global graph.
        merging: the association rule.
        frames: from which frames the nodes and edges come.
        space: the space that the camera has seen as free.
        trail: the poses of the frames.
        poses_frame: world frame of the local graphs and corrections to come.
        rooms: the rooms of that space, as of the last `find_rooms_and_things` or `set_rooms`.
        things: views for `find_things`; None = not configured.
        prior: of class pairs.
        refused: what was left out of the newest frame, in words, by reason.
    """

    def __init__(
        self,
        config: Config,
        vocabulary: Vocabulary,
        frame_id: str,
        graph: GlobalGraph | None = None,
        prior: ClassPairPrior | None = None,
    ) -> None:
        if graph is None:
            graph = GlobalGraph(vocabulary, frame_id, **graph_settings(config.merging))
        if prior is None:
            prior = ClassPairPrior(len(vocabulary.classes), len(vocabulary.predicates))
        output = config.output
        self._relations = config.relations
        self.graph = graph
        self.merging = build_merging(config.merging, output.min_existence)
        # The paper takes poses as they are, and has no boxes.
        self._drift = Drift() if config.merging.association != "paper" else None
        self._edges = EdgeBeliefs(config, graph, prior)
        self._boxes = NodeBoxes(graph.nodes, lambda slots: self.merging.shown(graph.nodes, slots))
        self._publication = Publication(
            graph,
            self._edges.states,
            self._edges.refresh,
            self._boxes,
            top_k=output.top_k,
            min_name=output.min_name,
            include_surface_points=output.include_surface_points,
        )
        self.frames, self.space, self.trail = FrameMemory(), SeenSpace(), Trail()
        self.rooms = RoomMap()
        self.things = Things() if config.merging.association == "things" else None
        # How keyframes have moved, and the nodes that have still to follow.
        self._T_new_old, self._due = np.eye(4)[None], list[int]()
        self._newest_ns: int | None = None
        self.poses_frame = frame_id
        self._T_graph_world: Float64 | None = None
        self.refused: dict[str, str] = {}

    @property
    def prior(self) -> ClassPairPrior:
        """The world model's prior of class pairs."""
        return self._edges.prior

    @property
    def up(self) -> UpEstimator:
        """Estimates the direction against gravity from the poses of the frames."""
        return self._edges.up

    @property
    def T_graph_poses(self) -> Float64:  # noqa: N802
        """From the frame of the newest poses to that of the graph, (4, 4): the drift."""
        return np.eye(4) if self._drift is None else self._drift.T_graph_poses

    def place(self, T_graph_world: Float64, poses_frame: str) -> None:
        """Take poses in another world frame from now on; the graph stays in its own.

        Args:
            T_graph_world: (4, 4), from that frame to the graph's.
            poses_frame: name of that frame.

        Raises:
            RefusedInput: ``invalid_pose`` if it is no rigid transform.
        """
        check_pose(T_graph_world)
        self._T_graph_world, self.poses_frame = T_graph_world, poses_frame
        self.trail.place(T_graph_world)

    def place_as(self, other: GraphBuilder) -> None:
        """Take poses as a graph in the same frame does."""
        if other.graph.frame_id == self.graph.frame_id and other._T_graph_world is not None:
            self.place(other._T_graph_world, other.poses_frame)

    def _placed(self, local: LocalGraph) -> LocalGraph:
        if self._T_graph_world is None:
            return local
        if local.frame_id != self.poses_frame:
            raise RefusedInput(
                "wrong_frame",
                f"local graph is in frame {local.frame_id!r}: expected {self.poses_frame!r}",
            )
        return derived(moved(local, self._T_graph_world), frame_id=self.graph.frame_id)

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest frame."""
        return self._newest_ns or int(self.graph.nodes.last_seen_ns.max(initial=0))

    @property
    def confirmed(self) -> int:
        """Number of confirmed nodes."""
        return int(self.graph.nodes.confirmed.sum())

    @property
    def hidden(self) -> dict[str, int]:
        """Number of nodes that are not published, by reason, in words."""
        return dict(Counter(self.merging.hidden(self.graph).values()))

    def configure(self, config: Config) -> None:
        """Use other thresholds of merging, relations and publication from now on."""
        self.merging.configure(config.merging)
        self.merging.publish_from(self.graph, config.output.min_existence)
        self._relations = config.relations

    def integrate(self, local: LocalGraph) -> list[int]:
        """Merge a frame's local graph; returns the node id of each of its rows.

        Raises:
            RefusedInput: ``out_of_order`` for a frame that is not newer than the last one, by up to
                a second; also the reasons of `Merging.merge`. An older frame is of a clock that was
                set back, and is merged.
        """
        self.refused = {}
        last_ns = self._newest_ns
        if last_ns is not None and last_ns - RESTART_NS <= local.stamp_ns <= last_ns:
            raise RefusedInput(
                "out_of_order",
                f"local graph of {local.stamp_ns} ns came after that of {self._newest_ns} ns",
            )
        local = candidates(self.graph.admit(self._placed(local)), self._relations)
        if self._due or self.trail.is_changing:
            local = self._catch_up(local)
        T_given = local.T_world_camera
        if self._drift is not None:
            local = self._drift.align(local)
        if self.trail.note(local.stamp_ns, T_given, local.T_world_camera):
            self.settle()  # by the old numbers
            self.graph.nodes.halve_keyframes()
            if self.things is not None:
                self.things.forget()
        self.graph.nodes.keyframe = self.trail.keyframe
        logits = local.relations.logits
        weights = softmax_weights(logits) if logits.size else None
        if self._drift is not None:
            self.graph.up_world = self.up.estimate()
        node_ids = self.merging.merge(self.graph, self._edges.weigh(local, weights))
        self.graph.add_colours(local, node_ids)
        self._add_embeddings(local, node_ids)
        votes = frame_votes(logits, weights)
        self._edges.observe(local, node_ids, votes)
        if self._drift is not None:
            self._boxes.observe(local, node_ids, self.up.estimate)
        self.frames.note(self.graph, local, node_ids, votes)
        self.space.note(local)
        if self.things is not None:
            self.things.note(local, self.trail.keyframe)
        self._newest_ns = local.stamp_ns
        self._publication.note_frame(local.stamp_ns, node_ids)
        return node_ids

    def _catch_up(self, local: LocalGraph) -> LocalGraph:
        """The frame under the present trajectory; the next nodes follow it, too."""
        if self._due:
            self._move_some()
        T_new_old = self.trail.admit(local.stamp_ns, local.T_world_camera)
        return local if T_new_old is None else moved(local, T_new_old)

    def _add_embeddings(self, local: LocalGraph, node_ids: list[int]) -> None:
        try:
            self.graph.add_embeddings(local, node_ids)
        except RefusedInput as refusal:
            self.refused[refusal.reason] = str(refusal)

    def edit(self, request: GraphEdit) -> EditReply:
        """Make an operator's edit, or undo the newest one.

        The next `update` contains what it changes.

        Raises:
            RefusedInput: ``invalid_request``, with the reason; nothing is changed then.
        """
        self.settle()
        if isinstance(request, NameRoom):
            rooms = self.rooms.named(request.room, request.name)
            self.set_rooms(rooms, rooms.states(self.snapshot().nodes))
            said = f"is called {request.name}" if request.name else "is called by what it contains"
            return EditReply("name_room", [], f"room {request.room} {said}")
        reply = self.merging.edit(self.graph, request, self.newest_ns)
        for node_id in reply.nodes:
            for old_id in self.graph.edits.origins(node_id):
                self.frames.copy(old_id, node_id)
        return reply

    @property
    def has_rooms(self) -> bool:
        """Whether rooms are looked for: the paper has none."""
        return self._drift is not None and len(self.space) > 0

    def find_rooms_and_things(self) -> None:
        """Find the things and the rooms of what was seen so far; takes some seconds."""
        self.find_things()
        if self.has_rooms:
            rooms = self.rooms.found_in(self.space, self.up.up_world().tolist())
            self.set_rooms(rooms, rooms.states(self._publication.full().nodes))

    def find_things(self) -> None:
        """Find things that no detector fires at, if configured; takes two seconds or more."""
        if self.things is not None and self.things.is_new:
            self.add_things(self.search(self.full().nodes)())

    def search(self, nodes: Sequence[wire.NodeState]) -> Callable[[], FoundThings]:
        """What finds the things, in any thread, besides the nodes that were detected."""
        if self.things is None or not self.things.is_new:
            return lambda: FoundThings([], 0, -1)
        self.things.is_new = False
        views, up, things = copy(self.things), self.up.up_world().tolist(), self.merging.things()
        return lambda: views.find(up, (node for node in nodes if node.id not in things))

    def add_things(self, found: FoundThings) -> None:
        """Make things nodes without a name, unless the views have moved since they were found.

        Those of before that are not found again go. The next `update` has the changes.
        """
        if self.things is not None and self.things.moves == found.moves:
            self.merging.add(self.graph, found)

    def set_rooms(self, rooms: RoomMap, states: list[wire.RoomState]) -> None:
        """Set the rooms, and their messages; the next `update` has them if they are others."""
        self.rooms = rooms
        self._publication.set_rooms(states, rooms.floors_m)

    def add_evidence(self, evidence: RelationEvidence) -> None:
        """Take in neighbour pairs and predictions; see `EdgeBeliefs.add`."""
        self._edges.add(evidence)

    def apply_trajectory(self, stamps_ns: Int64, T_world_body: Float64) -> int:
        """Follow a trajectory that SLAM has corrected, see `Trail.follow`; returns as `follow`."""
        return self.follow(self.trail.follow(stamps_ns, T_world_body))

    def apply_correction(self, T_correction: Float64, since_ns: int) -> int:
        """Follow one transform of all poses since a stamp; poses to come have to be corrected.

        Args:
            T_correction: (4, 4), from the old world frame to the corrected one.
            since_ns: stamp of the first pose that was corrected.

        Returns:
            As `follow`.

        Raises:
            RefusedInput: ``invalid_pose`` if it is no rigid transform.
        """
        check_pose(T_correction)
        return self.follow(self.trail.since(T_correction, since_ns))

    def follow(self, change: TrailChange | None) -> int:
        """Move what was seen with the poses that it was seen from.

        Objects move, their surfaces point by point, and the views of the room. Nodes that meet then
        are merged; the older id stays. The first nodes move at once, the nearest first, the others
        with the next frames and updates.

        Args:
            change: of `trail`; None = none.

        Returns:
            The number of nodes that move.
        """
        if change is None:
            return 0
        self.settle()
        if self._drift is not None:
            self._drift = Drift()
        self.space.move(change)
        if self.things is not None:
            self.things.move(change)
        nodes, self._T_new_old = self.graph.nodes, change.T_new_old
        slots = nodes.slots
        counts = np.maximum(nodes.surface_counts[slots, None], 1)
        used = np.arange(nodes.surface_keyframes.shape[1]) < counts
        moves = (change.moved[nodes.surface_keyframes[slots]] & used).any(axis=1)
        slots = slots[moves]
        # The nearest first: the next frames meet no node that has still to be moved.
        apart = np.linalg.norm(nodes.means[slots] - self.trail.camera_world, axis=1)
        self._due = nodes.ids[slots[apart.argsort(kind="stable")]].tolist()
        count = len(self._due)
        self._move_some()
        return count

    def settle(self) -> None:
        """Move all nodes that have still to follow a trajectory."""
        while self._due:
            self._move_some()

    def _move_some(self) -> None:
        """Move the next nodes."""
        part, self._due = self._due[:MOVED_A_CALL], self._due[MOVED_A_CALL:]
        node_ids = [node_id for node_id in part if node_id in self.graph]
        if node_ids:
            # Points of frames since then stay.
            known = len(self._T_new_old)
            T = np.broadcast_to(np.eye(4), (max(known, self.trail.keyframe + 1), 4, 4)).copy()
            T[:known] = self._T_new_old
            slots = self.graph.nodes.slots_of(node_ids)
            self._boxes.move(node_ids, self.merging.move(self.graph, slots, T, self._due))

    def update(self) -> wire.SceneGraphUpdateMessage | None:
        """The changes since the last call; None if there are none.

        It costs as much as what changed, however large the graph is. Of many surfaces and pairs
        that changed, some are left for the next calls: see `waiting`. After a large map was read,
        the first calls return None and prepare it in parts: the first update has all of it.
        """
        if self._due:
            self._move_some()
        self._publication.set_up(self.up.up_world(exact=False))
        return self._publication.update()

    @property
    def waiting(self) -> int:
        """Number of nodes, surfaces and pairs that the next updates take in; `full` leaves none."""
        return len(self._due) + self._edges.waiting + self._publication.waiting

    def snapshot(self) -> wire.SceneGraphMessage:
        """The graph after the last `update`."""
        return self._publication.snapshot()

    def full(self) -> wire.SceneGraphMessage:
        """The present graph with surface points and hidden nodes; `update` is unaffected."""
        self.settle()
        self._publication.set_up(self.up.up_world())
        message = self._publication.full()
        message.hidden = self._hidden_nodes()
        return message

    def _hidden_nodes(self) -> list[wire.HiddenNode]:
        reasons = self.merging.hidden(self.graph)
        return [hidden_node(self.graph, node_id, reasons[node_id]) for node_id in sorted(reasons)]


def warm_up(config: Config, *parts: str) -> None:
    """Compile the kernels before the first frame.

    Args:
        config: kernels that it does not use are not compiled.
        parts: of `KERNEL_PARTS`, to compile in several processes; none = all.
    """
    for part in parts or KERNEL_PARTS:
        if part == "merging":
            build_merging(config.merging, config.output.min_existence).warm_up()
        elif part == "drift" and config.merging.association != "paper":
            Drift().warm_up()
        elif part == "pairs":
            beliefs.warm_up(config)


def graph_settings(merging: MergingConfig) -> dict[str, Any]:
    """Settings of `GlobalGraph` by name."""
    return {"even_gaussians": merging.association != "paper"}
