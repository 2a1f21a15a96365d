"""Merges two graphs into one message: objects of both at one place become one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from deworldsg_ros.client.align import align
from deworldsg_ros.client.changes import Pairing, matched_by_place
from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import Point, SceneObject, scene_object
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import check_pose, pose_from_quaternion, quaternion_from_rotation
from deworldsg_ros.scene.extent import rounded, surface_bytes, surface_points
from deworldsg_ros.scene.gaussian import fuse, transform
from deworldsg_ros.scene.limits import MAX_INT
from deworldsg_ros.words import counted

# A transform with less confidence is not used unless it is given. Of graphs of one room it was
# 0.28 and more, of graphs of two rooms 0.006 and less.
MIN_CONFIDENCE = 0.1
# The up directions of both graphs have to agree within this angle after the transform.
MAX_TILT_RAD = np.radians(5.0)
# Surface points of a merged object: as many as graph_node keeps, one for each cell.
MOST_POINTS, CELL_M = 512, 0.005


@dataclass(frozen=True)
class Combined:
    """Two graphs as one.

    Attributes:
        message: the graph, in the world frame of the first one.
        T_a_b: (4, 4), from the world frame of the second graph to that of the first.
        confidence: of the transform; 1 if it was given.
        pairs: the objects of both that became one, before the merge.
        ids: the id of each object of the second graph in the message.
    """

    message: wire.SceneGraphMessage
    T_a_b: Float64
    confidence: float
    pairs: tuple[Pairing, ...]
    ids: dict[int, int]


class Known:
    """What was computed of the objects of one graph, for those that are the same the next time."""

    def __init__(self) -> None:
        self._where: tuple[object, ...] = ()
        # By id: the object, and the moved one.
        self._moved: dict[int, tuple[SceneObject, SceneObject]] = {}
        # By the id of the object of B: both objects, and the message of both as one.
        self._fused: dict[int, tuple[SceneObject, SceneObject, wire.NodeState]] = {}

    def moved(
        self, items: Iterable[SceneObject], T: Float64, frame_id: str, up: Point
    ) -> dict[int, SceneObject]:
        """Objects by id, as `moved_object` moves them."""
        where = T.tobytes(), frame_id, up
        known, self._moved = self._moved if where == self._where else {}, {}
        self._where = where
        for item in items:
            before, moved = known.get(item.id, (None, item))
            if before is None or not _equal(before, item):
                moved = moved_object(item, T, frame_id, up)
            self._moved[item.id] = item, moved
        return {node_id: moved for node_id, (_, moved) in self._moved.items()}

    def fused(self, pairs: Iterable[Pairing]) -> dict[int, wire.NodeState]:
        """The messages of pairs of objects as one, by the id of the first."""
        known, self._fused = self._fused, {}
        for a, b in ((pair.before, pair.after) for pair in pairs):
            first, second, state = known.get(b.id, (None, None, a.state))
            if first is None or second is None or not (_equal(first, a) and _equal(second, b)):
                state = _fused(a, b)
            self._fused[b.id] = a, b, msgspec.structs.replace(state, id=a.id)
        return {state.id: state for _, _, state in self._fused.values()}


def combine(
    a: SceneGraph, b: SceneGraph, T_a_b: Float64 | None = None, known: Known | None = None
) -> Combined:
    """Merge a graph into another one.

    Objects keep the ids of A. Other objects of B get new ids. Of two edges between the same
    objects, the one with more observations stays.

    Args:
        a: gives the world frame, and the ids.
        b: to be merged into it.
        T_a_b: (4, 4) rigid transform, B to A; None = find it from the objects.
        known: of the last combination with an earlier B; it is brought up to date.

    Raises:
        ClientError: if no transform is found with enough confidence, the given one tilts, or the
            ids of A leave none for the objects of B.
        RefusedInput: if it is no rigid transform.
    """
    confidence = 1.0
    if T_a_b is None:
        found = align(list(a), list(b))
        T_a_b, confidence = found.T_a_b, found.confidence
        if confidence < MIN_CONFIDENCE:
            raise ClientError(
                f"the transform has the confidence {confidence:.3f} with {found.matched} objects "
                f"in common: expected {MIN_CONFIDENCE:g} or more; give the transform"
            )
    check_pose(T_a_b)
    if np.dot(T_a_b[:3, :3] @ b.up, a.up) < np.cos(MAX_TILT_RAD):
        raise ClientError(f"the transform turns up {b.up} away from {a.up}: expected the same up")
    known = known or Known()
    moved = known.moved(b, T_a_b, a.frame_id, a.up)
    pairs = matched_by_place(list(a), list(moved.values()))
    merged = {pair.after.id: pair.before.id for pair in pairs}
    first_free = max([*(item.id for item in a), 0]) + 1
    others = [node_id for node_id in moved if node_id not in merged]
    if others and first_free + len(others) - 1 > MAX_INT:
        raise ClientError(
            f"the largest id of the first graph is {first_free - 1}: expected at most "
            f"{MAX_INT - len(others)}, because {counted(len(others), 'object')} need new ids"
        )
    ids = {**merged, **{node_id: first_free + i for i, node_id in enumerate(others)}}
    nodes = {item.id: item.state for item in a} | known.fused(pairs)
    for node_id in others:
        state = moved[node_id].state
        nodes[ids[node_id]] = msgspec.structs.replace(state, id=ids[node_id])
    message = msgspec.structs.replace(
        a.message,
        schema=wire.schema_of(wire.SceneGraphMessage),
        stamp=wire.stamp_from_ns(max(a.stamp_ns, b.stamp_ns)),
        nodes=[nodes[node_id] for node_id in sorted(nodes)],
        edges=_edges(a.message.edges, b.message.edges, ids),
        up=list(a.up),
    )
    return Combined(message, T_a_b, confidence, tuple(pairs), ids)


def moved_object(item: SceneObject, T: Float64, frame_id: str, up: Point) -> SceneObject:
    """An object in another world frame.

    Args:
        item: the object.
        T: (4, 4), from its world frame to the other one.
        frame_id: of the other frame.
        up: against gravity in the other frame.
    """
    state = item.state
    mean, covariance = np.array(state.mean_m), np.array(item.covariance_m2)
    means, covariances = transform(mean[None], covariance[None], T)
    points = surface_points(state) @ T[:3, :3].T + T[:3, 3]
    turn = pose_from_quaternion(np.zeros(3), np.array(item.orientation_xyzw))[:3, :3]
    place = rounded(T[:3, :3] @ item.position_m + T[:3, 3], 3)
    turned = rounded(quaternion_from_rotation(T[:3, :3] @ turn), 4)
    new = msgspec.structs.replace(
        state,
        **_geometry(means[0], covariances[0], points),
        box=wire.GravityBox(place, list(item.size_m), turned),
    )
    return scene_object(new, frame_id, up)


def _equal(one: SceneObject, other: SceneObject) -> bool:
    """Whether two objects differ in their ids at most."""
    same_id = msgspec.structs.replace(other.state, id=one.id)
    return one.state == same_id and (one.frame_id, one.up) == (other.frame_id, other.up)


def _fused(a: SceneObject, b: SceneObject) -> wire.NodeState:
    """One object of two, with the observations of both (Eq. 7)."""
    count, more = a.observations, b.observations
    mean, covariance = fuse(
        float(count), np.array(a.mean_m), np.array(a.covariance_m2),
        float(more), np.array(b.mean_m), np.array(b.covariance_m2),
    )  # fmt: skip
    share = count / (count + more)
    classes = {belief.label: share * belief.probability for belief in a.classes}
    for belief in b.classes:
        new = (1 - share) * belief.probability
        classes[belief.label] = classes.get(belief.label, 0.0) + new
    best = sorted(classes.items(), key=lambda item: (-item[1], item[0]))
    best = best[: max(len(a.classes), len(b.classes))]
    points = _thinned(np.concatenate([a.surface_m, b.surface_m]))
    # A box of all points would depend on how well the two frames agree.
    seen_more = a if count >= more else b
    known = [item for item in (a.existence, b.existence) if item is not None]
    first, last = min(a.first_seen_ns, b.first_seen_ns), max(a.last_seen_ns, b.last_seen_ns)
    return msgspec.structs.replace(
        a.state,
        label=best[0][0],
        classes=[wire.Belief(label, round(value, 4)) for label, value in best],
        remainder=round(max(0.0, 1.0 - sum(value for _, value in best)), 4),
        **_geometry(mean, covariance, points),
        box=_box(seen_more),
        observations=min(count + more, MAX_INT),
        first_seen=wire.stamp_from_ns(first),
        last_seen=wire.stamp_from_ns(last),
        existence=max(known) if known else msgspec.UNSET,
        entropy_nats=None,
    )


def _box(item: SceneObject) -> wire.GravityBox:
    return wire.GravityBox(list(item.position_m), list(item.size_m), list(item.orientation_xyzw))


def _thinned(points: Float64) -> Float64:
    """One point (k, 3) of each cell; both graphs may have seen the same surface."""
    _, rows = np.unique(np.floor(points / CELL_M), axis=0, return_index=True)
    rows = np.sort(rows)
    return points[rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_POINTS)).astype(int)]]


def _geometry(mean: Float64, covariance: Float64, points: Float64) -> dict[str, object]:
    """The fields of a message that say where an object is."""
    mean_m = rounded(mean, 3)
    surface = surface_bytes(points.astype(np.float32), mean_m) if len(points) else msgspec.UNSET
    return {
        "mean_m": mean_m,
        "covariance_m2": rounded(covariance, 7),
        "surface_points_m": [],
        "surface_mm": surface,
    }


def _edges(
    first: Sequence[wire.EdgeState], second: Sequence[wire.EdgeState], ids: dict[int, int]
) -> list[wire.EdgeState]:
    edges = {(edge.subject, edge.object): edge for edge in first}
    for edge in second:
        if edge.subject not in ids or edge.object not in ids:
            continue
        pair = ids[edge.subject], ids[edge.object]
        known = edges.get(pair)
        if pair[0] != pair[1] and (known is None or known.observations < edge.observations):
            edges[pair] = msgspec.structs.replace(edge, subject=pair[0], object=pair[1])
    return [edges[pair] for pair in sorted(edges)]
