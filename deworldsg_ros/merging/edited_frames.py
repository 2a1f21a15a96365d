"""A frame's objects as an operator has said they are: joined, and cut, before they are matched.

The detector goes on to see two objects where the operator has merged them, and one where the
operator has split it. So its objects are joined or cut like the nodes on which they lie.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from deworldsg_ros.merging.matching import CLASS_AGREEMENT
from deworldsg_ros.merging.node_records import NodeRecords
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph, Relations, derived
from deworldsg_ros.scene.gaussian import fuse
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.limits import MAX_INSTANCE

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
    graph: SceneGraph, local: LocalGraph, records: NodeRecords
) -> tuple[LocalGraph, list[int]]:
    """A frame with joined and cut objects.

    Returns:
        The frame, without relations, and the row in it of each object; of one that was cut, the row
        of the largest part.
    """
    if not len(local):
        return local, []
    owners, on_nodes, _ = records.map.overlaps(records.map.cells_of(local.surface_points_world))
    ids = [records.node(owner) for owner in owners]
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
        parts = _parts(graph, item.points, known)
        values = [item.value, *range(value + 1, value + len(parts))]
        value = max(value, values[-1])
        if len(parts) > 1:
            grid = _cut_pixels(local.T_world_camera, grid, item.points, parts, values)
        objects += [_part(item, part, new) for part, new in zip(parts, values)]
    return _with_objects(local, objects, grid), row_of


def reject_deleted(
    graph: SceneGraph, local: LocalGraph, node_ids: list[int], on_nodes: Float64
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
            classes = graph.nodes.class_probabilities[graph.nodes.row(node_id)]
            on_nodes[local.class_probabilities @ classes <= CLASS_AGREEMENT, column] = 0.0


def may_merge(graph: SceneGraph, a_id: int, b_id: int) -> bool:
    """Whether the operator's edits allow that two nodes become one."""
    edits, nodes = graph.edits, graph.nodes
    if (min(a_id, b_id), max(a_id, b_id)) in edits.separate:
        return False
    # A fragment of a deleted object becomes a part of it. A published object is something else.
    others = [node_id for node_id in (a_id, b_id) if node_id not in edits.deleted]
    return len(others) != 1 or not nodes.confirmed[nodes.row(others[0])]


def _agrees(graph: SceneGraph, local: LocalGraph, node_id: int) -> Bool:
    """Whether (n,) the class of each object is that of a node, or of one that it was made of."""
    nodes = graph.nodes
    rows = [nodes.row(known) for known in (node_id, *graph.edits.origins(node_id))]
    agreement = local.class_probabilities @ nodes.class_probabilities[rows].T
    return np.asarray((agreement > CLASS_AGREEMENT).any(axis=1))


def _merged_below(graph: SceneGraph, on_nodes: dict[int, float]) -> int:
    """The node on which most of an object lies, if the operator has merged it; 0 = none."""
    best = max(on_nodes, key=lambda node_id: on_nodes[node_id], default=0)
    is_merged = best in graph.edits.merged and on_nodes[best] >= JOINED_FRACTION
    return best if is_merged else 0


def _parts(graph: SceneGraph, points: Float32, on_nodes: dict[int, float]) -> list[Int64]:
    """Indices of the points of an object on each part of a node that the operator has split.

    The largest part is the first one. All points, if the object lies on one part only.
    """
    whole = [np.arange(len(points))]
    touched = [node_id for node_id, fraction in on_nodes.items() if fraction > 0]
    best = max(touched, key=lambda node_id: on_nodes[node_id], default=0)
    sides = [best, *(i for i in touched if (min(i, best), max(i, best)) in graph.edits.separate)]
    if len(sides) == 1:
        return whole
    surfaces = [graph.nodes.surface(graph.nodes.row(node_id)) for node_id in sides]
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
    """The frame with other objects; merging needs neither their boxes nor their relations."""
    return derived(
        local,
        instance_ids=np.array([item.value for item in objects]),
        class_probabilities=np.array([item.class_probabilities for item in objects]),
        scores=np.array([item.score for item in objects]),
        means_world=np.array([item.mean for item in objects]),
        covariances_world=np.array([item.covariance for item in objects]),
        pixel_counts=np.array([item.pixels for item in objects]),
        surface_points_world=tuple([item.points for item in objects]),
        relations=Relations.none(len(local.vocabulary.predicates)),
        depth_grid=grid,
    )
