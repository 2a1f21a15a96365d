"""Association by overlap of surfaces: beyond the paper, for real input.

The Hellinger distance of Eq. 6 saturates for thin visible surfaces and partial views, and labels
that flip create a node in each frame. Here two detections match if their surfaces overlap. Objects
and nodes are matched one to one. If the classes differ, more overlap is required.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from deworldsg_ros.base.array_file import Arrays
from deworldsg_ros.config import MergingConfig
from deworldsg_ros.graph.edits import EditRequest
from deworldsg_ros.graph.extent import even_moments
from deworldsg_ros.graph.floor_plan import FoundThings
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import NodeBoxes, NodeStates
from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.merging import beliefs
from deworldsg_ros.merging.cell_kernels import CellSets
from deworldsg_ros.merging.editing import (
    EditReply,
    SurfaceEditor,
    as_edited,
    may_merge,
    reject_deleted,
)
from deworldsg_ros.merging.life_cycle import LifeCycle
from deworldsg_ros.merging.matching import (
    Matches,
    in_one_place,
    match,
    match_nodes,
    several_on_one,
)
from deworldsg_ros.merging.records import NodeRecords, move_nodes
from deworldsg_ros.merging.views import FrameArrays, View, frame_arrays, see, see_nothing, with_seen
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.camera import Intrinsics, invert_pose
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph, Relations, Vocabulary

# Gaussians are weighted by their number of pixels; this number gives weight 1.
PIXELS_PER_WEIGHT = 1000.0
SPARE = Vocabulary(("a", "b"), ("on",))


class SurfaceMerging:
    """Merges local graphs into a scene graph by the overlap of surfaces.

    Args:
        config: thresholds.
        min_existence: a node is published if it is an object with at least this probability.
    """

    def __init__(self, config: MergingConfig, min_existence: float = 0.5) -> None:
        self.configure(config)
        self._records = NodeRecords()
        self._life_cycle = LifeCycle(self._records, min_existence)
        self._editor = SurfaceEditor(self._records, self._life_cycle)

    def configure(self, config: MergingConfig) -> None:
        """Use another threshold from the next frame on."""
        self._config = config

    def publish_from(self, graph: GlobalGraph, min_existence: float) -> None:
        """Publish the nodes that are objects with at least this probability; hide the others."""
        self._life_cycle.publish_from(graph, min_existence)

    def warm_up(self) -> None:
        """Compile the kernels before the first frame."""
        spare, graph = (
            SurfaceMerging(self._config),
            GlobalGraph(SPARE, "world", even_gaussians=True),
        )
        for stamp_ns in range(1, 4):
            spare.merge(graph, _spare_frame(stamp_ns))
        boxes = NodeBoxes(graph.nodes, lambda slots: spare.shown(graph.nodes, slots))
        NodeStates(graph, 1, 0.0, boxes).refresh()
        spare.hidden(graph)
        spare._records.frames_before(np.zeros(3), np.zeros(3))
        parts = graph.nodes.slot(1), graph.nodes.slot(2)
        graph.merge_nodes(1, 2)
        spare._records.merge(graph, *parts)
        # Points are dropped only from nodes whose parts belong to others.
        slots = graph.nodes.slots
        cells = spare._records.map.cells_of([graph.nodes.surface(slot) for slot in slots])
        inside = spare._records.map.points_in(cells, graph.nodes, slots)
        graph.drop_points(list(graph.nodes.slot_of), inside)
        spare._records.map.warm_up()

    def merge(self, graph: GlobalGraph, local: LocalGraph) -> list[int]:
        """Merge one frame into the graph; see `Merging.merge`.

        Two objects of one frame never become one node, even if both overlap the same node.
        """
        local = graph.admit(local)
        frame, rows = local, list(range(len(local)))
        if graph.edits.merged or graph.edits.separate:
            frame, rows = as_edited(graph, local, self._records)
        live = graph.nodes.slot_of
        merged = [
            node_id if node_id in live else graph.resolve(node_id)
            for node_id in self._merge_frame(graph, frame)
        ]
        node_ids = [merged[row] for row in rows]
        graph.remember_frame(local.stamp_ns, node_ids)
        graph.add_relations(local, node_ids)
        return node_ids

    def _merge_frame(self, graph: GlobalGraph, local: LocalGraph) -> list[int]:
        cells = self._records.map.cells_of(local.surface_points_world)
        frame = None
        if local.depth_grid is not None:
            frame = frame_arrays(invert_pose(local.T_world_camera), local.depth_grid)
        view = self._see(graph, local, frame)
        matches = self._associate(graph, local, cells, view)
        if self._cut(graph, local, matches):
            matches = self._associate(graph, local, cells, view)
        node_ids = self._update(graph, local, cells, matches)
        self._judge_cells(graph, local, cells, node_ids, frame)
        node_ids = self._merge_parts(graph, local, matches, node_ids, view.slots)
        self._life_cycle.observe(graph, local, view, node_ids)
        return node_ids

    def things(self) -> set[int]:
        """See `Merging.things`."""
        return set(self._records.nodes_of(self._records.undetected))

    def add(self, graph: GlobalGraph, found: FoundThings) -> None:
        """See `Merging.add`."""
        records, nodes, count = self._records, graph.nodes, len(graph.vocabulary.classes)
        before = records.undetected.tolist()
        sets = records.map.cells_of([thing.points_world for thing in found.things])
        owners, on_nodes, _ = records.map.overlaps(sets)
        slots, classes = [], np.full(count, 1.0 / count)
        for thing, on in zip(found.things, on_nodes):
            moments = even_moments(thing.points_world)
            same = owners[on >= self._config.overlap_threshold].tolist()
            slot = next((slot for slot in same if slot in before), None)
            if slot is None:
                node_id = graph.add_node(*moments, classes, thing.first_ns, confirmed=False)
                slot = nodes.slot(node_id)
                records.add(slot, node_id, classes)
                beliefs.assume(records.rows[slot], beliefs.THING_LOOKS)
            else:  # more views may show more of it
                before.remove(slot)
                records.map.remove(slot)
                nodes.put(slot, *moments, classes, 1.0, observations=1)
            nodes.set_surface(slot, thing.points_world, thing.keyframes)
            nodes.last_seen_ns[slot], nodes.observations[slot] = thing.last_ns, thing.views
            slots.append(slot)
        records.map.add(slots, sets)
        records.place(graph, slots)
        node_ids = records.nodes_of(slots)
        graph.set_classes(node_ids, np.tile(classes, (len(slots), 1)))
        self._life_cycle.publish_again(graph, node_ids)
        for slot in before:
            node_id, is_searched = records.node(slot), nodes.first_seen_ns[slot] >= found.since_ns
            if is_searched and not graph.edits.hides(node_id) and node_id not in graph.edits.labels:
                self._life_cycle.remove(graph, node_id)

    def hidden(self, graph: GlobalGraph) -> dict[int, str]:
        """See `Merging.hidden`."""
        return self._life_cycle.hidden(graph)

    def shown(self, nodes: NodeTable, slots: Int64) -> Bool:
        """See `Merging.shown`."""
        cells, capacity = self._records.map, nodes.surface_points_world.shape[1]
        inside = np.zeros((len(slots), capacity), np.bool_)
        for index, slot in enumerate(slots.tolist()):
            inside[index] = cells.points_in(cells.shown(slot), nodes, slots[index : index + 1])
        return inside

    def memory(self) -> Arrays:
        """See `Merging.memory`."""
        return {**self._records.memory(), **self._editor.memory()}

    def restore(self, graph: GlobalGraph, memory: Arrays) -> None:
        """See `Merging.restore`."""
        replaced = graph.edits.replaced
        node_ids = [node_id for node_id in graph.nodes.slot_of if node_id not in replaced]
        self._records.restore(graph, memory, node_ids)
        self._editor.restore(graph, memory)
        self._life_cycle.restore(graph)

    def edit(self, graph: GlobalGraph, request: EditRequest, stamp_ns: int) -> EditReply:
        """See `Merging.edit`."""
        return self._editor.apply(graph, request, stamp_ns)

    def move(
        self, graph: GlobalGraph, slots: Int64, T_new_old: Float64, due: Collection[int]
    ) -> Float64:
        """See `Merging.move`."""
        main = move_nodes([self._records, self._editor.aside], graph, slots, T_new_old)
        self._unite(graph, self._life_cycle.bring_back(graph, slots), due)
        return main

    def _unite(self, graph: GlobalGraph, slots: Int64, due: Collection[int]) -> None:
        """Merge nodes with those that they meet after a move, the best matches first.

        A loop that closes brings together what the camera saw as one object at two places. Frames
        that showed both have shown that they are two.
        """
        records, nodes = self._records, graph.nodes
        overlaps = records.map.overlaps(records.map.cells_of([nodes.surface(i) for i in slots]))
        threshold, cell_m = self._config.overlap_threshold, records.map.cell_m
        scores = match_nodes(nodes, slots, overlaps, threshold, cell_m)
        rows, columns = scores.nonzero()
        order = (-scores[rows, columns]).argsort(kind="stable")
        others = overlaps[0][columns]
        for a_id, b_id in zip(nodes.ids[slots[rows]][order], nodes.ids[others][order]):
            a_id, b_id = graph.resolve(int(a_id)), graph.resolve(int(b_id))
            if a_id == b_id or a_id in due or b_id in due:
                continue
            a, b = nodes.slot(a_id), nodes.slot(b_id)
            if records.node(a) and records.node(b) and records.joint.balance(a, b) >= 0:
                self._merge_pair(graph, a, b)

    def _see(self, graph: GlobalGraph, local: LocalGraph, frame: FrameArrays | None) -> View:
        """Compare the frame with the nodes that may be in view."""
        if frame is None:
            return see_nothing(local)
        slots = self._records.grid.in_view(frame)
        slots.sort()
        return see(graph.nodes, slots, local, frame)

    def _associate(
        self, graph: GlobalGraph, local: LocalGraph, cells: CellSets, view: View
    ) -> Matches:
        """Match the objects with the nodes whose surfaces they meet."""
        records = self._records
        slots, on_nodes, covered = records.map.overlaps(cells)
        # If the frame shows enough of a node, its visible part counts, and not the whole node.
        covered = with_seen(covered, slots, view)
        if graph.edits.deleted:
            reject_deleted(graph, local, graph.nodes.ids[slots].tolist(), on_nodes)
        return match(
            local,
            graph.nodes,
            slots,
            on_nodes,
            covered,
            self._config.overlap_threshold,
            records.map.cell_m,
        )

    def _cut(self, graph: GlobalGraph, local: LocalGraph, matches: Matches) -> bool:
        """Cut the nodes that viewpoints enough have shown as several objects; were there any?"""
        records, found = self._records, False
        for column, rows in several_on_one(local, matches):
            slot = int(matches.slots[column])
            if records.joint.add_several(slot, local.T_world_camera[:3, 3]):
                surfaces = [local.surface_points_world[row] for row in rows]
                found |= records.keep_largest(graph, slot, surfaces)
        return found

    def _update(
        self, graph: GlobalGraph, local: LocalGraph, cells: CellSets, matches: Matches
    ) -> list[int]:
        """Fuse each object into the node that it matched, or add a node; returns the node ids."""
        records, weights = self._records, local.pixel_counts / PIXELS_PER_WEIGHT
        slots = [int(matches.slots[column]) if column >= 0 else -1 for column in matches.columns]
        known = [row for row, slot in enumerate(slots) if slot >= 0]
        matched = np.array([slots[row] for row in known], np.int64)
        at, seen = np.array(known, np.int64), local.class_probabilities[known]
        graph.observe_each(
            records.nodes_of(matched),
            local.means_world[at],
            local.covariances_world[at],
            seen,
            local.stamp_ns,
            [local.surface_points_world[row] for row in known],
            weights[at],
            records.name(matched, seen, graph.nodes.means[matched], local.T_world_camera[:3, 3]),
        )
        for row, slot in enumerate(slots):
            if slot < 0:
                classes = local.class_probabilities[row]
                node_id = graph.add_node(
                    local.means_world[row],
                    local.covariances_world[row],
                    classes,
                    local.stamp_ns,
                    local.surface_points_world[row],
                    float(weights[row]),
                    confirmed=False,
                )
                slots[row] = graph.nodes.slot(node_id)
                before = records.frames_before(local.means_world[row], local.T_world_camera[:3, 3])
                records.add(slots[row], node_id, classes, before)
        records.map.add(slots, cells)
        records.place(graph, slots)
        records.note_frame(local)
        return records.nodes_of(slots)

    def _judge_cells(
        self,
        graph: GlobalGraph,
        local: LocalGraph,
        cells: CellSets,
        node_ids: list[int],
        frame: FrameArrays | None,
    ) -> None:
        """Drop surface points in cells that the frames so far show as something else."""
        if frame is None or local.depth_grid is None or local.depth_grid.instances is None:
            return
        slots = graph.nodes.slots_of(node_ids)
        rejected = self._records.map.judge(slots, cells, local.instance_ids, frame)
        if len(rejected.blocks):
            graph.drop_points(node_ids, self._records.map.points_in(rejected, graph.nodes, slots))

    def _merge_parts(
        self,
        graph: GlobalGraph,
        local: LocalGraph,
        matches: Matches,
        node_ids: list[int],
        view_slots: Int64,
    ) -> list[int]:
        """Merge nodes that are parts of one object; returns the node ids of the rows."""
        records = self._records
        slots = graph.nodes.slots_of(node_ids).tolist()
        camera_world = local.T_world_camera[:3, 3]
        records.joint.add_frame(slots, matches, local.scores, local.boxes_xyxy, camera_world)
        merged = False
        while (pair := records.joint.next_merge()) is not None:
            merged |= self._merge_pair(graph, *pair)
        for a, b in in_one_place(graph, slots, view_slots):
            if records.node(a) and records.node(b) and not records.joint.are_two(a, b):
                merged |= self._merge_pair(graph, a, b)
        return [graph.resolve(node_id) for node_id in node_ids] if merged else node_ids

    def _merge_pair(self, graph: GlobalGraph, a: int, b: int) -> bool:
        """Merge the nodes of two slots; the older id stays. False = an edit forbids it."""
        records = self._records
        a_id, b_id = records.node(a), records.node(b)
        if graph.edits and not may_merge(graph, a_id, b_id):
            return False
        kept, removed = (a, b) if a_id < b_id else (b, a)
        graph.merge_nodes(a_id, b_id)
        records.merge(graph, kept, removed)
        return True


def _spare_frame(stamp_ns: int) -> LocalGraph:
    """A frame of two objects, to compile the kernels. In the third frame, one object has moved."""
    shift_m = 0.1 * (stamp_ns == 3)
    points = tuple(
        (np.random.default_rng(0).random((50, 3)) * 0.2 + (x_m, 0.0, 1.0)).astype(np.float32)
        for x_m in (-0.3, 0.1 + shift_m)
    )
    instances = np.repeat(np.arange(3, dtype=np.uint16), 20)[None].repeat(60, axis=0)
    camera = Intrinsics(300.0, 300.0, 240.0, 240.0, 480, 480)
    return LocalGraph(
        stamp_ns=stamp_ns,
        frame_id="world",
        width=480,
        height=480,
        T_world_camera=np.eye(4),
        vocabulary=SPARE,
        instance_ids=np.array([1, 2]),
        boxes_xyxy=np.zeros((2, 4)),
        class_probabilities=np.full((2, 2), 0.5),
        scores=np.ones(2),
        means_world=np.array([cloud.mean(axis=0) for cloud in points], np.float64),
        covariances_world=np.stack([0.01 * np.eye(3)] * 2),
        depths_m=np.ones(2),
        pixel_counts=np.array([50, 50]),
        surface_points_world=points,
        relations=Relations.none(1),
        depth_grid=DepthGrid(np.full((60, 60), 1100, np.uint16), 8, camera, instances),
    )
