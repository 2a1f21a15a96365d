"""The edits of an operator: each changes the graph at once, and holds for later frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from deworldsg_ros.base.array_file import Arrays
from deworldsg_ros.graph.edits import (
    MAX_EDITS,
    DeleteNode,
    Edit,
    EditRequest,
    MergeNodes,
    SetLabel,
    SplitNode,
    Undo,
)
from deworldsg_ros.graph.graph import GlobalGraph, copy_node
from deworldsg_ros.merging.life_cycle import LifeCycle
from deworldsg_ros.merging.matching import CLASS_AGREEMENT
from deworldsg_ros.merging.records import NodeRecords
from deworldsg_ros.merging.surface_map import cell_bits
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph, Relations, derived
from deworldsg_ros.scene.gaussian import fuse
from deworldsg_ros.scene.limits import MAX_INSTANCE, check_labels

# --- A frame's objects as an operator has said they are: joined, and cut, before they are
# matched.
#
# The detector goes on to see two objects where the operator has merged them, and one where the
# operator has split it. So its objects are joined or cut like the nodes on which they lie.

# An object is joined with others if this fraction of its cells lies on the merged node.
JOINED_FRACTION = 0.5
# An object is cut if the smaller part has this fraction of its points.
CUT_FRACTION = 0.2
# A single point has no covariance.
LEAST_POINTS = 2
# Added to the covariance of a part of an object, m²: its points may lie on a plane.
RIDGE_M2 = 1e-6


class _Object(NamedTuple):
    """One object of a frame, or a part of it; see `LocalGraph`."""

    value: int
    class_probabilities: Float64
    score: float
    mean: Float64
    covariance: Float64
    pixels: int
    points: Float32


def as_edited(
    graph: GlobalGraph, local: LocalGraph, records: NodeRecords
) -> tuple[LocalGraph, list[int]]:
    """A frame with joined and cut objects.

    Returns:
        The frame, without relations, and the row in it of each object; of one that was cut, the row
        of the largest part.
    """
    if not len(local):
        return local, []
    slots, on_nodes, _ = records.map.overlaps(records.map.cells_of(local.surface_points_world))
    ids = records.nodes_of(slots)
    on_nodes = (
        on_nodes * np.array([_agrees(graph, local, i) for i in ids]).reshape(-1, len(local)).T
    )
    objects: list[_Object] = []
    row_of: list[int] = []
    row_on: dict[int, int] = {}
    grid, value = local.depth_grid, int(local.instance_ids.max())
    for row in range(len(local)):
        item = _object(local, row)
        known = dict(zip(ids, on_nodes[row].tolist()))
        merged_id = _merged_below(graph, known)
        row_of.append(row_on.get(merged_id, len(objects)))
        if merged_id in row_on:
            first = objects[row_of[-1]]
            grid = _renamed(grid, item.value, first.value)
            objects[row_of[-1]] = _joined(first, item)
            continue
        if merged_id:
            row_on[merged_id] = len(objects)
        parts = _parts_of_object(graph, item.points, known)
        values = [item.value, *range(value + 1, value + len(parts))]
        value = max(value, values[-1])
        if len(parts) > 1:
            grid = _cut_pixels(local.T_world_camera, grid, item.points, parts, values)
        objects += [_part(item, part, new) for part, new in zip(parts, values)]
    return _with_objects(local, objects, grid), row_of


def reject_deleted(
    graph: GlobalGraph, local: LocalGraph, node_ids: list[int], on_nodes: Float64
) -> None:
    """Keep objects off deleted nodes of another class: something else may be there now.

    Args:
        graph: the graph.
        local: n objects.
        node_ids: k nodes.
        on_nodes: (n, k) fraction of each object on each node; set to 0 for such pairs.
    """
    for column, node_id in enumerate(node_ids):
        if node_id in graph.edits.deleted:
            classes = graph.nodes.class_probabilities[graph.nodes.slot(node_id)]
            on_nodes[local.class_probabilities @ classes <= CLASS_AGREEMENT, column] = 0.0


def may_merge(graph: GlobalGraph, a_id: int, b_id: int) -> bool:
    """Whether the operator's edits allow that two nodes become one."""
    edits, nodes = graph.edits, graph.nodes
    if (min(a_id, b_id), max(a_id, b_id)) in edits.separate:
        return False
    # A fragment of a deleted object becomes a part of it. A published object is something else.
    others = [node_id for node_id in (a_id, b_id) if node_id not in edits.deleted]
    return len(others) != 1 or not nodes.confirmed[nodes.slot(others[0])]


def _agrees(graph: GlobalGraph, local: LocalGraph, node_id: int) -> Bool:
    """Whether (n,) the class of each object is that of a node, or of one that it was made of."""
    nodes = graph.nodes
    slots = nodes.slots_of([node_id, *graph.edits.origins(node_id)])
    agreement = local.class_probabilities @ nodes.class_probabilities[slots].T
    return np.asarray((agreement > CLASS_AGREEMENT).any(axis=1))


def _merged_below(graph: GlobalGraph, on_nodes: dict[int, float]) -> int:
    """The node on which most of an object lies, if the operator has merged it; 0 = none."""
    best = max(on_nodes, key=lambda node_id: on_nodes[node_id], default=0)
    is_merged = best in graph.edits.merged and on_nodes[best] >= JOINED_FRACTION
    return best if is_merged else 0


def _parts_of_object(
    graph: GlobalGraph, points: Float32, on_nodes: dict[int, float]
) -> list[Int64]:
    """Indices of the points of an object on each part of a node that the operator has split.

    The largest part is the first one. All points, if the object lies on one part only.
    """
    whole = [np.arange(len(points))]
    touched = [node_id for node_id, fraction in on_nodes.items() if fraction > 0]
    best = max(touched, key=lambda node_id: on_nodes[node_id], default=0)
    sides = [best, *(i for i in touched if (min(i, best), max(i, best)) in graph.edits.separate)]
    if len(sides) == 1:
        return whole
    surfaces = [graph.nodes.surface(graph.nodes.slot(node_id)) for node_id in sides]
    side_of = np.repeat(np.arange(len(sides)), [len(surface) for surface in surfaces])
    from scipy.spatial import cKDTree  # slow to import, and only for edits

    nearest = side_of[cKDTree(np.concatenate(surfaces)).query(points)[1]]
    parts = [np.flatnonzero(nearest == side) for side in range(len(sides))]
    least = max(CUT_FRACTION * len(points), LEAST_POINTS)
    parts = [part for part in parts if len(part) >= least]
    return sorted(parts, key=len, reverse=True) if len(parts) > 1 else whole


def _object(local: LocalGraph, row: int) -> _Object:
    return _Object(
        int(local.instance_ids[row]),
        local.class_probabilities[row],
        float(local.scores[row]),
        local.means_world[row],
        local.covariances_world[row],
        int(local.pixel_counts[row]),
        local.surface_points_world[row],
    )


def _part(item: _Object, indices: Int64, value: int) -> _Object:
    """Some of the points of an object."""
    if len(indices) == len(item.points):
        return item
    points = item.points[indices]
    return item._replace(
        value=value,
        mean=points.mean(axis=0, dtype=np.float64),
        covariance=np.cov(points.T) + RIDGE_M2 * np.eye(3),
        pixels=max(item.pixels * len(points) // len(item.points), 1),
        points=points,
    )


def _joined(a: _Object, b: _Object) -> _Object:
    """Two objects as one, by their numbers of pixels (Eq. 7)."""
    mean, covariance = fuse(
        float(a.pixels), a.mean, a.covariance, float(b.pixels), b.mean, b.covariance
    )
    pixels = a.pixels + b.pixels
    classes = a.pixels * a.class_probabilities + b.pixels * b.class_probabilities
    points = np.concatenate([a.points, b.points])
    score = max(a.score, b.score)
    return _Object(a.value, classes / pixels, score, mean, covariance, pixels, points)


def _renamed(grid: DepthGrid | None, old: int, new: int) -> DepthGrid | None:
    """The grid with the pixels of one object as those of another one."""
    if grid is None or grid.instances is None:
        return grid
    instances = np.where(grid.instances == old, np.uint16(new), grid.instances)
    return dataclasses.replace(grid, instances=instances)


def _cut_pixels(
    T_world_camera: Float64,
    grid: DepthGrid | None,
    points: Float32,
    parts: list[Int64],
    values: list[int],
) -> DepthGrid | None:
    """The grid with the pixels of an object as those of the parts that are nearest to them."""
    if grid is None or grid.instances is None or values[-1] > MAX_INSTANCE:
        return grid
    rows, columns = np.nonzero((grid.instances == values[0]) & (grid.depth_mm > 0))
    camera, depths_m = grid.intrinsics, grid.depth_mm[rows, columns] * 0.001
    first = grid.stride_px // 2
    x = (first + columns * grid.stride_px - camera.cx) / camera.fx
    y = (first + rows * grid.stride_px - camera.cy) / camera.fy
    seen = np.stack([x, y, np.ones(len(x))], axis=1) * depths_m[:, None]
    seen = seen @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    part_of = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    from scipy.spatial import cKDTree  # slow to import, and only for edits

    nearest = part_of[cKDTree(points[np.concatenate(parts)]).query(seen)[1]]
    instances = grid.instances.copy()
    instances[rows, columns] = np.array(values, np.uint16)[nearest]
    return dataclasses.replace(grid, instances=instances)


def _with_objects(local: LocalGraph, objects: list[_Object], grid: DepthGrid | None) -> LocalGraph:
    """The frame with other objects; merging needs no relations and colours.

    Their boxes are empty: none lies within another one.
    """
    return derived(
        local,
        instance_ids=np.array([item.value for item in objects]),
        boxes_xyxy=np.zeros((len(objects), 4)),
        class_probabilities=np.array([item.class_probabilities for item in objects]),
        scores=np.array([item.score for item in objects]),
        means_world=np.array([item.mean for item in objects]),
        covariances_world=np.array([item.covariance for item in objects]),
        pixel_counts=np.array([item.pixels for item in objects]),
        surface_points_world=tuple([item.points for item in objects]),
        relations=Relations.none(len(local.vocabulary.predicates)),
        depth_grid=grid,
        colours_lab=None,
        embeddings=None,
    )


# --- The edits of an operator: each changes the graph, and adds to its log what holds from now
# on.

# Either part of a split has at least this many surface points.
MIN_PART_POINTS = 8

# Before the names of the arrays of replaced nodes.
_ASIDE = "aside_"

# Which points (n, 3) belong to a part of a node.
Belongs = Callable[[Float32], Bool]


class EditReply(msgspec.Struct, frozen=True):
    """The result of an edit.

    Attributes:
        kind: as the request: set_label, merge, split, delete or undo.
        nodes: the objects that there are now in place of those that were edited.
        text: a sentence.
    """

    kind: str
    nodes: list[int]
    text: str


class Editor:
    """The edits that need nothing but the graph."""

    def apply(self, graph: GlobalGraph, request: EditRequest, stamp_ns: int) -> EditReply:
        """Make an edit, or undo one.

        Args:
            graph: changed.
            request: names published nodes.
            stamp_ns: of the newest frame.

        Raises:
            RefusedInput: ``invalid_request``, with the reason; nothing is changed then.
        """
        if isinstance(request, Undo):
            return self._undo(graph)
        if len(graph.edits) >= MAX_EDITS:
            raise refused(f"{MAX_EDITS} edits hold: expected fewer, undo some")
        for node_id in request.nodes if isinstance(request, MergeNodes) else [request.node]:
            _check_published(graph, node_id)
        if isinstance(request, SetLabel):
            return self._set_label(graph, request, stamp_ns)
        if isinstance(request, DeleteNode):
            graph.add_edit(Edit(0, "delete", stamp_ns, [request.node]))
            return EditReply("delete", [], f"object {request.node} is deleted")
        if isinstance(request, MergeNodes):
            return self._merge(graph, request, stamp_ns)
        return self._split(graph, request, stamp_ns)

    def _set_label(self, graph: GlobalGraph, request: SetLabel, stamp_ns: int) -> EditReply:
        if not request.label.strip():
            raise refused(f"label {request.label!r} is blank: expected a name, e.g. 'cup'")
        try:
            check_labels([request.label])
        except ValueError as error:
            raise refused(str(error)) from error
        graph.add_edit(Edit(0, "set_label", stamp_ns, [request.node], label=request.label))
        text = f"object {request.node} is a '{request.label}'"
        if request.label not in graph.vocabulary.classes:
            text += "; the detector does not know this class, so relations take that of the frames"
        return EditReply("set_label", [request.node], text)

    def _merge(self, graph: GlobalGraph, request: MergeNodes, stamp_ns: int) -> EditReply:
        raise refused("the paper's rule cannot merge by hand: use merging.association surface")

    def _split(self, graph: GlobalGraph, request: SplitNode, stamp_ns: int) -> EditReply:
        raise refused("the paper's rule cannot split by hand: use merging.association surface")

    def _undo(self, graph: GlobalGraph) -> EditReply:
        if not graph.edits:
            raise refused("there is nothing to undo: no edit holds")
        edit = graph.edits.pop()
        said = f"undone: {edit.kind} of {_names(edit.replaced or edit.nodes)}"
        if edit.replaced:
            self._bring_back(graph, edit)
            return EditReply("undo", edit.replaced, said)
        if edit.kind == "delete":
            self._publish(graph, edit.nodes)
        # Their messages say another label now.
        slots = graph.nodes.slots_of(edit.nodes)
        graph.set_classes(edit.nodes, graph.nodes.class_probabilities[slots])
        if edit.kind in ("merge", "split"):
            said += " does not hold any more, but the objects before it are forgotten"
        return EditReply("undo", edit.nodes, said)

    def _bring_back(self, graph: GlobalGraph, edit: Edit) -> None:
        raise AssertionError("a rule without merges and splits has no replaced nodes")

    def _publish(self, graph: GlobalGraph, node_ids: list[int]) -> None:
        """Publish nodes that an edit has hidden: all, with a rule that hides none."""
        existence = graph.nodes.existence[graph.nodes.slots_of(node_ids)]
        graph.set_existence(node_ids, existence, minimum=-1.0)


class SurfaceEditor(Editor):
    """All edits, for the surface rule.

    Args:
        records: of the rule.
        life_cycle: of its nodes.

    Attributes:
        aside: records of nodes that an edit replaced, for undo. No frame is compared with them.
    """

    def __init__(self, records: NodeRecords, life_cycle: LifeCycle) -> None:
        self._records = records
        self._life_cycle = life_cycle
        self.aside = NodeRecords()

    def apply(self, graph: GlobalGraph, request: EditRequest, stamp_ns: int) -> EditReply:
        """See `Editor.apply`."""
        reply = super().apply(graph, request, stamp_ns)
        for slot, node_id in zip(self.aside.slots.tolist(), self.aside.ids):
            if node_id not in graph.edits.replaced:
                self.aside.remove(slot)
        return reply

    def _merge(self, graph: GlobalGraph, request: MergeNodes, stamp_ns: int) -> EditReply:
        old_ids = sorted(request.nodes)
        if old_ids[0] == old_ids[1]:
            raise refused(f"object {old_ids[0]} cannot be merged with itself: expected two ids")
        labels = [graph.edits.labels.get(node_id, "") for node_id in old_ids]
        new_ids = [copy_node(graph, node_id, without=old_ids) for node_id in old_ids]
        for old_id, new_id in zip(old_ids, new_ids):
            self._replace(graph, old_id, {new_id: None})
        kept, removed = graph.nodes.slots_of(new_ids).tolist()
        kept_id = graph.merge_nodes(*new_ids)
        self._records.merge(graph, kept, removed)
        graph.add_edit(Edit(0, "merge", stamp_ns, [kept_id], old_ids, labels[0] or labels[1]))
        return EditReply("merge", [kept_id], f"objects {_names(old_ids)} are object {kept_id} now")

    def _split(self, graph: GlobalGraph, request: SplitNode, stamp_ns: int) -> EditReply:
        old_id = request.node
        points = graph.nodes.surface(graph.nodes.slot(old_id)).copy()
        parts = _parts(points, request.near_m)
        if len(parts) < 2:
            raise refused(
                f"object {old_id} with {len(points)} surface points has no two parts of at least "
                f"{MIN_PART_POINTS} there"
            )
        label = graph.edits.labels.get(old_id, "")
        new_ids = [copy_node(graph, old_id, part=part) for part in parts]
        from scipy.spatial import cKDTree  # slow to import, and only for edits

        tree = cKDTree(np.concatenate([points[part] for part in parts]))
        sides = np.repeat([0, 1], [np.count_nonzero(part) for part in parts])

        def on_side(side: int) -> Belongs:
            return lambda centres: sides[tree.query(centres)[1]] == side

        belongs = {new_id: on_side(side) for side, new_id in enumerate(new_ids)}
        self._replace(graph, old_id, dict(belongs))
        graph.add_edit(Edit(0, "split", stamp_ns, new_ids, [old_id], label))
        text = f"object {old_id} is the objects {_names(new_ids)} now"
        return EditReply("split", new_ids, text)

    def _replace(self, graph: GlobalGraph, old_id: int, new: dict[int, Belongs | None]) -> None:
        """Put the record of a node aside, and give copies of it, or of parts, to new nodes."""
        balances, old = self._balances(graph, [old_id]), graph.nodes.slot(old_id)
        _transfer(graph, self._records, self.aside, old, old)
        self._records.remove(old)
        for new_id, belongs in new.items():
            slot = graph.nodes.slot(new_id)
            _transfer(graph, self.aside, self._records, old, slot, belongs)
            self._add_balances(graph, slot, balances)

    def _bring_back(self, graph: GlobalGraph, edit: Edit) -> None:
        balances = self._balances(graph, edit.nodes)
        for node_id in edit.nodes:
            self._life_cycle.remove(graph, node_id)
        for slot in graph.nodes.slots_of(edit.replaced).tolist():
            _transfer(graph, self.aside, self._records, slot, slot)
            self.aside.remove(slot)
            self._add_balances(graph, slot, balances)
        self._publish(graph, edit.replaced)

    def _publish(self, graph: GlobalGraph, node_ids: list[int]) -> None:
        self._life_cycle.publish_again(graph, node_ids)

    def memory(self) -> Arrays:
        """The records of replaced nodes, for `restore`; empty without any."""
        memory = self.aside.memory() if len(self.aside.slots) else {}
        return {_ASIDE + name: values for name, values in memory.items()}

    def restore(self, graph: GlobalGraph, memory: Arrays) -> None:
        """Continue with a graph of an earlier run."""
        own = {
            name.removeprefix(_ASIDE): values
            for name, values in memory.items()
            if name.startswith(_ASIDE)
        }
        self.aside.restore(graph, own, sorted(graph.edits.replaced))

    def _balances(self, graph: GlobalGraph, node_ids: Sequence[int]) -> dict[int, int]:
        """Evidence that other nodes are one object with one of these, by the id of the other."""
        records = self._records
        slots = set(graph.nodes.slots_of(node_ids).tolist())
        return {
            records.node(other): balance
            for pair, balance in records.joint.balances.items()
            for slot, other in (pair, pair[::-1])
            if slot in slots and other not in slots
        }

    def _add_balances(self, graph: GlobalGraph, slot: int, balances: dict[int, int]) -> None:
        records, slot_of = self._records, graph.nodes.slot_of
        known = {slot_of[other]: n for other, n in balances.items() if other in slot_of}
        records.joint.restore({(slot, at): n for at, n in known.items() if records.has(at)})


def refused(message: str) -> RefusedInput:
    """The error of an edit that cannot be made."""
    return RefusedInput("invalid_request", message)


def _check_published(graph: GlobalGraph, node_id: int) -> None:
    if node_id not in graph:
        new_id = graph.resolve(node_id)
        now = f"it is object {new_id} now" if new_id else "it is gone, or never was"
        raise refused(f"object {node_id} is not in the graph: {now}")
    if not graph.nodes.confirmed[graph.nodes.slot(node_id)]:
        replaced = graph.edits.replaced.get(node_id)
        reason = f"it was merged into object {replaced}" if replaced else "it is hidden"
        raise refused(f"object {node_id} is not in the graph: {reason}")


def _names(node_ids: Sequence[int]) -> str:
    return " and ".join(map(str, node_ids))


def _parts(points: Float32, near_m: list[Any] | None) -> list[Bool]:
    """Which points (k, 3) are nearer to either of two places; without places, the two halves.

    The larger part is the first one. Parts of fewer than MIN_PART_POINTS are left out.
    """
    if len(points) < 2 * MIN_PART_POINTS:
        return []
    places = np.array(near_m, np.float64) if near_m else _ends(points)
    from scipy.spatial import cKDTree  # slow to import, and only for edits

    sides = cKDTree(places).query(points)[1]
    parts = sorted((sides == side for side in (0, 1)), key=np.count_nonzero, reverse=True)
    return [part for part in parts if np.count_nonzero(part) >= MIN_PART_POINTS]


def _ends(points: Float32) -> Any:
    """The centres (2, 3) of two clusters, which start at the ends of the longest axis."""
    from scipy.cluster.vq import kmeans2  # slow to import, and only for edits

    along = (points - points.mean(axis=0)) @ np.linalg.svd(np.cov(points.T))[0][:, 0]
    ends = points[[along.argmin(), along.argmax()]].astype(np.float64)
    return kmeans2(points.astype(np.float64), ends, minit="matrix")[0]


def _transfer(
    graph: GlobalGraph,
    source: NodeRecords,
    target: NodeRecords,
    slot: int,
    to: int,
    belongs: Belongs | None = None,
) -> None:
    """Copy the record and the cells of a node to another table, or those that belong to a part.

    They become those of the node in the slot `to`.
    """
    cells, scores = source.map.cells(slot), source.map.scores(slot)
    if belongs is not None:
        centres, rows = source.map.centres(slot), {}
        rows = {block: row for row, block in enumerate(cells.blocks.tolist())}
        cells = target.map.cells_of([centres[belongs(centres)]])
        scores = scores[[rows[block] for block in cells.blocks.tolist()]]
        scores *= cell_bits(cells.masks)[:, None].astype(np.int8)
    node_id = int(graph.nodes.ids[to])
    target.add(to, node_id, graph.nodes.class_probabilities[to])
    target.rows[to] = source.rows[slot]
    target.rows["node_id"][to] = node_id
    target.map.add([to], cells)
    target.map.add_scores([to], cells, scores)
    target.place(graph, [to])
