"""One graph of two: the transform between their worlds, and objects of both that are one."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np

from deworldsg_ros.base.words import counted
from deworldsg_ros.client.changes import Pairing, matched_by_place
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import Point, SceneObject, scene_object
from deworldsg_ros.graph.extent import horizontal_axes, rounded, surface_bytes, surface_points
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.camera import check_pose, pose_from_quaternion, quaternion_from_rotation
from deworldsg_ros.scene.errors import ClientError
from deworldsg_ros.scene.gaussian import fuse, transform
from deworldsg_ros.scene.limits import MAX_GRAPH_COORDINATE_M, MAX_INT
from deworldsg_ros.wire import messages as wire

# --- Finds how the world frame of one graph lies in that of another, from the objects of both.
#
# Gravity is known in both, so a heading and a translation are unknown. Two objects in each graph,
# of equal classes and at equal distances, give a hypothesis. The one that puts most objects onto
# objects of their class wins; a rare class counts more than a frequent one.

# Centres of one object in two sessions differ by less.
REACH_M = 0.3
# Objects farther apart than this have no part in a score.
LIMIT_M = 2.001 * REACH_M
# Two objects this close give no heading.
MIN_BASE_M = 0.5
# Hypotheses that are tried; those of the rarest classes first.
MOST_HYPOTHESES = 4000
# Places of objects that are looked up at once: more take more memory than caches have.
PLACES_AT_ONCE = 1 << 14
# Two hypotheses are different if they differ by one of these.
OTHER_M, OTHER_RAD = 2 * REACH_M, np.radians(15.0)


@dataclass(frozen=True)
class Alignment:
    """The world frame of graph B in that of graph A.

    Attributes:
        T_a_b: (4, 4) rigid transform, B to A.
        confidence: from 0 to 1: the matched share of the smaller graph, times the lead over the
            best other transform. A score, not a probability.
        matched: number of objects that lie on an object of their class.
    """

    T_a_b: Float64
    confidence: float
    matched: int


def align(a: Sequence[SceneObject], b: Sequence[SceneObject]) -> Alignment:
    """The transform from B to A.

    Raises:
        ClientError: if no two objects of B can be two objects of A.
    """
    places_a, places_b = _places(a), _places(b)
    # Motions are around the middle of B. Around a far origin, two motions that put the objects to
    # the same places would differ by the translation.
    middle = places_b.mean(axis=0) if len(b) else np.zeros(3)
    places_b = places_b - middle
    rarity = _rarity(a, b)
    numbers: defaultdict[str, int] = defaultdict(itertools.count().__next__)
    scene = _Scene(places_a, np.array([numbers[item.label] for item in a], np.int64))
    labels = np.array([numbers[item.label] for item in b], np.int64)
    objects = _Objects(places_b, labels, rarity)
    tried = _hypotheses(scene, objects)
    if not tried:
        raise ClientError(
            f"no transform found: graphs of {len(a)} and {len(b)} objects have no two objects of "
            "equal classes at equal distances; give the transform"
        )
    scores = _scores(tried, scene, objects)
    order = np.argsort(-scores, kind="stable")
    best = _refined(tried[order[0]], scene, objects)
    (score,) = _scores([best], scene, objects)
    second = next((float(scores[i]) for i in order if _differs(tried[i], best)), 0.0)
    most = rarity[np.isin(labels, scene.labels)].sum()
    lead = max(0.0, 1.0 - second / max(score, 1e-9))
    T_a_b = np.eye(4)
    axes_a, axes_b = horizontal_axes(a[0].up), horizontal_axes(b[0].up)
    turn = _turn(best)
    T_a_b[:3, :3] = axes_a.T @ turn @ axes_b
    T_a_b[:3, 3] = axes_a.T @ (best[1:] - turn @ middle)
    confidence = float(min(1.0, score / max(float(most), 1e-9))) * lead
    return Alignment(T_a_b, confidence, len(_matches(best, scene, objects)))


def _places(items: Sequence[SceneObject]) -> Float64:
    """Centres (n, 3): two horizontal coordinates and the height."""
    axes = horizontal_axes(items[0].up) if items else np.eye(3)
    return np.array([item.position_m for item in items], np.float64).reshape(-1, 3) @ axes.T


def _rarity(a: Sequence[SceneObject], b: Sequence[SceneObject]) -> Float64:
    """Weight (n,) of each object of B."""
    counts_a = Counter(item.label for item in a)
    counts_b = Counter(item.label for item in b)
    return np.array([(max(counts_a[i.label], 1) * counts_b[i.label]) ** -0.5 for i in b])


class _Objects(NamedTuple):
    """The objects of B: places (n, 3), numbers of their classes (n,), and weights (n,)."""

    places: Float64
    labels: Int64
    rarity: Float64

    def moved(self, motion: Float64) -> Float64:
        """The places after a motion."""
        moved: Float64 = self.places @ _turn(motion).T + motion[1:]
        return moved


class _Scene:
    """The objects of A, found by place and class.

    Args:
        places: (n, 3).
        labels: (n,) numbers of their classes.
    """

    def __init__(self, places: Float64, labels: Int64) -> None:
        from scipy.spatial import cKDTree  # slow to import, and only for transforms

        self.places, self.labels = places, labels
        self._tree = cKDTree(_apart(places, labels))
        self._rows = {label: np.flatnonzero(labels == label) for label in np.unique(labels)}
        # Marks at the cells on and around the objects of each class. Few of the places of a wrong
        # motion have one. Cells with equal hashes share a mark: it tells only where to search.
        self._marks = np.zeros(1 << (27 * 16 * len(places)).bit_length(), np.bool_)
        for step in np.ndindex(3, 3, 3):
            self._marks[self._slots(_cells(places) + step - 1, labels)] = True

    def of_class(self, label: int) -> Int64:
        """Rows of a class."""
        return self._rows.get(label, np.zeros(0, np.int64))

    def gaps_m(self, places: Float64, labels: Int64) -> Float64:
        """Distance (n,) to the nearest object of the same class; infinite beyond 2 `REACH_M`."""
        gaps = np.full(len(places), np.inf)
        near = np.flatnonzero(self._marks[self._slots(_cells(places), labels)])
        of_near = _apart(places[near], labels[near])
        rows = self._tree.query(of_near, distance_upper_bound=LIMIT_M)[1]
        known = rows < len(self.places)
        rows, near = rows[known], near[known]
        gaps[near] = np.linalg.norm(self.places[rows] - places[near], axis=1)
        return gaps

    def _slots(self, cells: Int64, labels: Int64) -> Int64:
        """The mark (n,) of each cell (n, 3) and class."""
        hashes = cells @ np.array([73856093, 19349663, 83492791]) + labels * 2654435761
        slots: Int64 = (hashes ^ hashes >> 17) & (len(self._marks) - 1)
        return slots

    def near(self, places: Float64, labels: Int64) -> Int64:
        """Pairs (m, 2) of rows, of A and of others, of one class and within about `REACH_M`."""
        found = self._tree.query_ball_point(_apart(places, labels), 1.001 * REACH_M)
        pairs = [(row, other) for other, rows in enumerate(found) for row in rows]
        return np.array(pairs, np.int64).reshape(-1, 2)


def _cells(places: Float64) -> Int64:
    """The cell (n, 3) of each place."""
    return np.floor(places / LIMIT_M).astype(np.int64)


def _apart(places: Float64, labels: Int64) -> Float64:
    """Places (n, 4) at which objects of different classes are far from each other."""
    return np.column_stack([places, 1e6 * labels])


def _hypotheses(scene: _Scene, objects: _Objects) -> list[Float64]:
    """Heading and translation (4,) of pairs of objects, those of rare classes first."""
    a, b, order = scene.places, objects.places, np.argsort(-objects.rarity, kind="stable")
    found: list[Float64] = []
    # A class that only B has is rare, too.
    known = np.isin(objects.labels[order], scene.labels).tolist()
    for i, j in _pairs(len(order)):
        if not (known[i] and known[j]):
            continue
        p, q = b[order[i]], b[order[j]]
        step = q - p
        base = float(np.hypot(step[0], step[1]))
        if base < MIN_BASE_M:
            continue
        sides = (scene.of_class(int(objects.labels[order[x]])) for x in (i, j))
        firsts, seconds = (side.ravel() for side in np.meshgrid(*sides, indexing="ij"))
        others = a[seconds] - a[firsts]
        fits = np.abs(np.hypot(others[:, 0], others[:, 1]) - base) <= REACH_M
        fits &= (firsts != seconds) & (np.abs(others[:, 2] - step[2]) <= REACH_M)
        for k, m, other in zip(firsts[fits], seconds[fits], others[fits]):
            heading = np.arctan2(other[1], other[0]) - np.arctan2(step[1], step[0])
            start = np.array([heading, 0.0, 0.0, 0.0])
            middle = (p + q) / 2 @ _turn(start).T
            found.append(np.array([heading, *((a[k] + a[m]) / 2 - middle)]))
        if len(found) >= MOST_HYPOTHESES:
            break
    return found


def _pairs(count: int) -> Iterator[tuple[int, int]]:
    """All pairs of numbers below a count, smaller first, by their sum."""
    for total in range(1, 2 * count - 2):
        for first in range(max(0, total - count + 1), (total + 1) // 2):
            yield first, total - first


def _turn(motion: Float64) -> Float64:
    cos, sin = np.cos(motion[0]), np.sin(motion[0])
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _matches(motion: Float64, scene: _Scene, objects: _Objects) -> list[tuple[int, int]]:
    """Nearest pairs of one class within reach, each object once: (row of A, row of B)."""
    moved = objects.moved(motion)
    near = scene.near(moved, objects.labels)
    gaps_m = np.linalg.norm(scene.places[near[:, 0]] - moved[near[:, 1]], axis=1)
    rows, columns, pairs = set[int](), set[int](), []
    for at in np.lexsort((near[:, 1], near[:, 0], gaps_m)):
        row, column = near[at].tolist()
        if gaps_m[at] <= REACH_M and row not in rows and column not in columns:
            rows.add(row)
            columns.add(column)
            pairs.append((row, column))
    return pairs


def _scores(motions: Sequence[Float64], scene: _Scene, objects: _Objects) -> Float64:
    """Of each of n motions, the sum of the weights of the objects of B near one of A, (n,)."""
    scores: list[float] = []
    at_once = max(1, PLACES_AT_ONCE // len(objects.places))
    for start in range(0, len(motions), at_once):
        places = np.stack([objects.moved(motion) for motion in motions[start : start + at_once]])
        labels = np.tile(objects.labels, len(places))
        gaps_m = scene.gaps_m(places.reshape(-1, 3), labels).reshape(len(places), -1)
        near = np.clip(1.0 - gaps_m / (2 * REACH_M), 0.0, 1.0)
        scores += [float(objects.rarity @ row) for row in near]
    return np.array(scores)


def _refined(motion: Float64, scene: _Scene, objects: _Objects) -> Float64:
    """The motion of least squares over the matches, twice."""
    for _ in range(2):
        pairs = np.array(_matches(motion, scene, objects), np.int64).reshape(-1, 2)
        if len(pairs) < 2:
            return motion
        p, q = objects.places[pairs[:, 1]], scene.places[pairs[:, 0]]
        p0, q0 = p.mean(axis=0), q.mean(axis=0)
        x, y = p - p0, q - q0
        cross = (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum()
        heading = np.arctan2(cross, (x[:, :2] * y[:, :2]).sum())
        start = np.array([heading, 0.0, 0.0, 0.0])
        motion = np.array([heading, *(q0 - p0 @ _turn(start).T)])
    return motion


def _differs(a: Float64, b: Float64) -> bool:
    turn = abs((a[0] - b[0] + np.pi) % (2 * np.pi) - np.pi)
    return bool(turn > OTHER_RAD or np.linalg.norm(a[1:] - b[1:]) > OTHER_M)


# --- Merges two graphs into one message: objects of both at one place become one.

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
    """Results for the objects of one graph, for those that are the same the next time."""

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
        # Those of one graph say nothing of the other.
        rooms=msgspec.UNSET,
        storeys_m=msgspec.UNSET,
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
    if not max(np.abs(means).max(), np.abs(place).max()) <= MAX_GRAPH_COORDINATE_M:
        raise ClientError(
            f"{item.name} would be at {place}: expected at most {MAX_GRAPH_COORDINATE_M:g} m"
        )
    turned = rounded(quaternion_from_rotation(T[:3, :3] @ turn), 4)
    new = msgspec.structs.replace(
        state,
        **_geometry(means[0], covariances[0], points),
        box=msgspec.structs.replace(_box(item), center_m=place, orientation_xyzw=turned),
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
    # A name of one graph alone is the name.
    named = [item.label for item in (a, b) if item.is_named]
    return msgspec.structs.replace(
        a.state,
        label=best[0][0] if best and len(named) == 2 else (*named, a.label)[0],
        named=bool(named),
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
    return wire.GravityBox(
        list(item.position_m),
        list(item.size_m),
        list(item.orientation_xyzw),
        list(item.at_least) if item.is_partly_seen else msgspec.UNSET,
    )


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
