"""One graph of two: the transform between their worlds, and objects of both that are one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from deworldsg_ros.base.words import counted
from deworldsg_ros.client.changes import Pairing, matched_by_place
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import Point, SceneObject, scene_object
from deworldsg_ros.graph.extent import horizontal_axes, rounded, surface_bytes, surface_points
from deworldsg_ros.scene.arrays import Bool, Float64, Int64
from deworldsg_ros.scene.camera import check_pose, pose_from_quaternion, quaternion_from_rotation
from deworldsg_ros.scene.errors import ClientError
from deworldsg_ros.scene.gaussian import fuse, transform
from deworldsg_ros.scene.limits import MAX_GRAPH_COORDINATE_M, MAX_INT
from deworldsg_ros.wire import messages as wire

# --- Finds how the world frame of one graph lies in that of another, from the objects of both.
#
# Gravity is known in both, so a heading and a translation are unknown. Two objects in each graph,
# whose classes agree, at equal distances, give a hypothesis. Each is judged by a sum of log
# likelihood ratios over the objects of B: how much better an object of A explains what is found at
# this place, with these class probabilities, than chance does. A rare class so counts more than a
# frequent one, and an unsure name less than a sure one. An object may be absent: it was moved, or
# A has never seen that part. The best are fitted to the centres, then to the surfaces.

# Standard deviation of the centre of a box in two sessions, horizontal and vertical, and the part
# of the difference of two sizes that it grows by: of a part of an object, the centre is elsewhere.
CENTRE_M, HEIGHT_M, PARTLY = 0.1, 0.12, 0.35
# Probability that an object of B has no counterpart. Half of a room may be new, or moved.
ABSENT = 0.5
# A pair of objects counts if its classes agree by more than chance; a wrong name is no proof
# against it.
LEAST_AGREEMENT, WRONG_NAME = 1.0, 0.05
# Objects of one class this near to each other are one piece of evidence: books stand in rows.
ROW_M = 0.6
# Two objects this close give no heading; distances differ by less than REACH_M.
MIN_BASE_M, REACH_M = 0.5, 0.3
# Hypotheses and pairs of objects that are tried; those of the rarest classes first.
MOST_HYPOTHESES, MOST_PAIRS, MOST_OBJECTS = 4000, 4000, 400
# Likelihoods that are computed at once: more take more memory than caches have.
AT_ONCE = 1 << 18
# The best hypotheses are judged with centres that are so much less exact, and then fitted.
COARSE_M, FITTED = 0.15, 12
# Two hypotheses are different if they differ by one of these.
OTHER_M, OTHER_RAD = 0.6, math.radians(15.0)
# What the best of many wrong hypotheses may reach by chance, in nats. In graphs of other rooms it
# was 4 (200 pairs of synthetic rooms of the same furniture, `bench.relocalisation`).
CHANCE_NATS = 12.0
# Transforms that are fitted to surfaces and returned: those not much less likely than the best.
SHOWN, LIKELY_NATS = 5, 12.0
# Steps onto surfaces, each with the distance that still counts, and points of an object.
SURFACE_REACHES_M, SURFACE_POINTS = (0.25, 0.15, 0.1, 0.06, 0.05), 64


@dataclass(frozen=True)
class Alignment:
    """The world frame of graph B in that of graph A.

    Attributes:
        T_a_b: (4, 4) rigid transform, B to A.
        confidence: from 0 to 1, the share of this transform in the likelihood of all that were
            found and of `CHANCE_NATS`. A probability only as far as the model holds.
        matched: number of objects, of the `MOST_OBJECTS` rarest, that lie on one that agrees.
        evidence_nats: sum of the log likelihood ratios.
    """

    T_a_b: Float64
    confidence: float
    matched: int
    evidence_nats: float


def align(a: Sequence[SceneObject], b: Sequence[SceneObject]) -> Alignment:
    """The most likely transform from B to A.

    Raises:
        ClientError: if no two objects of B can be two objects of A.
    """
    found = alignments(a, b)
    if not found:
        raise ClientError(
            f"no transform found: graphs of {len(a)} and {len(b)} objects have no two objects of "
            "equal classes at equal distances; give the transform"
        )
    return found[0]


def alignments(a: Sequence[SceneObject], b: Sequence[SceneObject]) -> list[Alignment]:
    """The transforms from B to A that are likely, at most `SHOWN`, the most likely first."""
    if not (a and b):
        return []
    evidence = _Evidence(a, b)
    tried = evidence.hypotheses()
    if not len(tried):
        return []
    best = _different(tried, evidence.screened(tried), FITTED)
    fitted = np.array([evidence.fitted(motion) for motion in best])
    fitted = _different(fitted, evidence.scores(fitted), FITTED)
    scores = evidence.scores(fitted)
    for row in np.flatnonzero(scores > scores[0] - LIKELY_NATS)[:SHOWN]:
        motion = evidence.on_surfaces(fitted[row], a, b)
        score = evidence.scores(motion[None])[0]
        # Surfaces that are seen from two sides may not fit better than the centres.
        if score > scores[row] - 1.0:
            fitted[row], scores[row] = motion, score
    found = []
    for row in np.argsort(-scores, kind="stable")[:SHOWN]:
        others = np.append(np.delete(scores, row), CHANCE_NATS)
        confidence = 1.0 / (1.0 + np.exp(np.minimum(others - scores[row], 700.0)).sum())
        matched = int(evidence.is_matched(fitted[row]).sum())
        T_a_b, score = evidence.transform(fitted[row]), float(scores[row])
        found.append(Alignment(T_a_b, float(confidence), matched, score))
    return found


class _Evidence:
    """What pairs of objects of A and B tell about a motion: heading, and translation (4,).

    Motions are around the middle of B. Around a far origin, two motions that put the objects to
    the same places would differ by the translation.
    """

    def __init__(self, a: Sequence[SceneObject], b: Sequence[SceneObject]) -> None:
        self._axes_a, self._axes_b = horizontal_axes(a[0].up), horizontal_axes(b[0].up)
        self.places_a, sizes_a = _places(a, self._axes_a)
        places_b, sizes_b = _places(b, self._axes_b)
        self._middle = places_b.mean(axis=0)
        self.places_b = places_b - self._middle
        names = {name.label: 0 for item in (*a, *b) for name in item.classes}
        columns = {name: column for column, name in enumerate(names)}
        classes_a, classes_b = _classes(a, columns), _classes(b, columns)
        shares = (classes_a.sum(axis=0) + classes_b.sum(axis=0)) / (len(a) + len(b))
        classes_a = classes_a / np.maximum(shares, 1e-9)
        rarest = np.argsort(classes_b @ classes_a.sum(axis=0), kind="stable")[:MOST_OBJECTS]
        agreement = np.full((len(b), len(a)), 0.0)
        agreement[rarest] = classes_b[rarest] @ classes_a.T + WRONG_NAME
        self.of_b, self.of_a = np.nonzero(agreement >= LEAST_AGREEMENT)
        extent_m = np.ptp(self.places_a[:, :2], axis=0) + 1.0
        differences = PARTLY * np.abs(sizes_a[self.of_a] - sizes_b[self.of_b])
        # (P,) of each pair: what the classes tell, over the density of A's objects in a square
        # metre, and the variances of the horizontal and vertical distance of the centres.
        self._gains = agreement[self.of_b, self.of_a] / (len(a) / extent_m.prod())
        self._variances = np.array([[CENTRE_M], [HEIGHT_M]]) ** 2 + differences.T**2
        self._known, self._starts = np.unique(self.of_b, return_index=True)
        # The others of many objects tell nothing, for or against.
        self._weights = np.zeros(len(b))
        self._weights[rarest] = _weights(self.places_b, classes_b.argmax(axis=1))[rarest]

    def transform(self, motion: Float64) -> Float64:
        """T_a_b (4, 4) of a motion."""
        T, turn = np.eye(4), _turn(motion[0])
        T[:3, :3] = self._axes_a.T @ turn @ self._axes_b
        T[:3, 3] = self._axes_a.T @ (motion[1:] - turn @ self._middle)
        return T

    def hypotheses(self) -> Float64:
        """Motions (n, 4) of pairs of objects that agree, those with the fewest others first."""
        ends = np.append(self._starts[1:], len(self.of_b))
        order = np.argsort(ends - self._starts, kind="stable")
        found, count = [np.zeros((0, 4))], 0
        for first, second in _pairs(len(order)):
            i, j = order[first], order[second]
            p, q = self.places_b[self._known[i]], self.places_b[self._known[j]]
            step = q - p
            base = float(np.hypot(step[0], step[1]))
            if base < MIN_BASE_M:
                continue
            sides = (self.of_a[self._starts[x] : ends[x]] for x in (i, j))
            firsts, seconds = (side.ravel() for side in np.meshgrid(*sides, indexing="ij"))
            others = self.places_a[seconds] - self.places_a[firsts]
            fits = np.abs(np.hypot(others[:, 0], others[:, 1]) - base) <= REACH_M
            fits &= (firsts != seconds) & (np.abs(others[:, 2] - step[2]) <= REACH_M)
            if not fits.any():
                continue
            others, firsts, seconds = others[fits], firsts[fits], seconds[fits]
            headings = np.arctan2(others[:, 1], others[:, 0]) - np.arctan2(step[1], step[0])
            middles = (self.places_a[firsts] + self.places_a[seconds]) / 2
            found.append(_motions(headings, np.broadcast_to((p + q) / 2, middles.shape), middles))
            count += len(headings)
            if count >= MOST_HYPOTHESES:
                break
        return np.concatenate(found)

    def screened(self, motions: Float64) -> Float64:
        """The scores (n,) of hypotheses, with inexact centres; of many pairs only the rarest."""
        ends = np.append(self._starts[1:], len(self.of_b))
        sizes = ends - self._starts
        order = np.argsort(sizes, kind="stable")
        rare = order[np.cumsum(sizes[order]) <= max(MOST_PAIRS, sizes[order[0]])]
        return self.scores(motions, COARSE_M, np.sort(rare))

    def scores(self, motions: Float64, broad_m: float = 0.0, some: Int64 | None = None) -> Float64:
        """The sum (n,) of the log likelihood ratios of n motions; `some` of the known objects."""
        ends = np.append(self._starts[1:], len(self.of_b))
        known = np.arange(len(self._known)) if some is None else some
        pairs = np.concatenate([np.arange(self._starts[k], ends[k]) for k in known])
        starts = np.append(0, np.cumsum((ends - self._starts)[known])[:-1])
        weights = self._weights[self._known[known]]
        rest = self._weights.sum() - self._weights[self._known].sum() if some is None else 0.0
        scores = []
        at_once = max(1, AT_ONCE // len(pairs))
        for start in range(0, len(motions), at_once):
            likelihoods = self._ratios(motions[start : start + at_once], pairs, broad_m)
            sums = np.add.reduceat(likelihoods, starts, axis=1)
            scores.append(np.log(ABSENT + (1.0 - ABSENT) * sums) @ weights)
        return np.concatenate(scores) + rest * math.log(ABSENT)

    def _ratios(self, motions: Float64, pairs: Int64, broad_m: float = 0.0) -> Float64:
        """Likelihood ratio (n, m) of each pair of objects under each motion."""
        x, y, z = self.places_b[self.of_b[pairs]].T
        u, v, w = self.places_a[self.of_a[pairs]].T
        cos, sin = np.cos(motions[:, :1]), np.sin(motions[:, :1])
        right, ahead = (
            cos * x - sin * y + motions[:, 1:2] - u,
            sin * x + cos * y + motions[:, 2:3] - v,
        )
        rise = z + motions[:, 3:] - w
        flat, high = self._variances[:, pairs] + broad_m**2
        # A height is no evidence: rooms have floors, and tables one height. It can only disagree.
        exponents = (right**2 + ahead**2) / flat + rise**2 / high
        ratios: Float64 = self._gains[pairs] / (2 * math.pi * flat) * np.exp(-0.5 * exponents)
        return ratios

    def _shares(self, motion: Float64) -> Float64:
        """Probability (P,) of each pair that both are one object."""
        pairs = np.arange(len(self.of_b))
        ratios = (1.0 - ABSENT) * self._ratios(motion[None], pairs)[0]
        sums = np.bincount(self.of_b, ratios, len(self.places_b))
        shares: Float64 = ratios / (ABSENT + sums[self.of_b])
        return shares

    def is_matched(self, motion: Float64) -> Bool:
        """Whether (n,) each object of B lies on one of A rather than on none."""
        matched: Bool = np.bincount(self.of_b, self._shares(motion), len(self.places_b)) > 0.5
        return matched

    def fitted(self, motion: Float64) -> Float64:
        """The motion of least squares over the centres, each pair with its probability."""
        for _ in range(4):
            weights = self._shares(motion) / self._variances[0]
            if weights.sum() * CENTRE_M**2 < 1e-3:
                return motion
            motion = _fit(self.places_b[self.of_b], self.places_a[self.of_a], weights)
        return motion

    def on_surfaces(
        self, motion: Float64, a: Sequence[SceneObject], b: Sequence[SceneObject]
    ) -> Float64:
        """The motion that puts the surfaces of matched objects onto each other.

        Steps of least squares on the distances of nearest points; far ones count less (Cauchy).
        Objects that have moved, and sides that one graph alone has seen, have no near points.
        """
        from scipy.spatial import cKDTree  # slow to import, and only for transforms

        shares = self._shares(motion)
        likely = shares > 0.5
        of_a, of_b = np.unique(self.of_a[likely]), np.unique(self.of_b[likely])
        points_a = _sampled([a[row] for row in of_a], self._axes_a, 4 * SURFACE_POINTS)
        points_b = _sampled([b[row] for row in of_b], self._axes_b, SURFACE_POINTS) - self._middle
        if min(len(points_a), len(points_b)) < SURFACE_POINTS:
            return motion
        tree = cKDTree(points_a)
        for reach_m in SURFACE_REACHES_M:
            moved = points_b @ _turn(motion[0]).T + motion[1:]
            gaps_m, rows = tree.query(moved, distance_upper_bound=reach_m)
            near = np.isfinite(gaps_m)
            if near.sum() < SURFACE_POINTS:
                return motion
            weights = 1.0 / (1.0 + (gaps_m[near] / (reach_m / 3)) ** 2)
            motion = _fit(points_b[near], points_a[rows[near]], weights)
        return motion


def _places(items: Sequence[SceneObject], axes: Float64) -> tuple[Float64, Float64]:
    """Centres (n, 3), two horizontal coordinates and the height; length and height (n, 2)."""
    places = np.array([item.position_m for item in items], np.float64) @ axes.T
    sizes = [[math.hypot(*item.size_m[:2]), item.size_m[2]] for item in items]
    return places, np.array(sizes, np.float64)


def _classes(items: Sequence[SceneObject], columns: dict[str, int]) -> Float64:
    """Probability (n, C) of each class that the messages list; also of objects without a name."""
    classes = np.zeros((len(items), len(columns)))
    for row, item in enumerate(items):
        for belief in item.classes:
            classes[row, columns[belief.label]] += belief.probability
    return classes


def _weights(places: Float64, labels: Int64) -> Float64:
    """Weight (n,) of each object: one over the number of those of its class beside it."""
    from scipy.spatial import cKDTree  # slow to import, and only for transforms

    # Objects of different classes are far from each other in a fourth direction.
    apart = np.column_stack([places, 1e6 * labels])
    counts = cKDTree(apart).query_ball_point(apart, ROW_M, return_length=True)
    weights: Float64 = 1.0 / counts
    return weights


def _sampled(items: Sequence[SceneObject], axes: Float64, count: int) -> Float64:
    """Surface points (n, 3) of objects, at most `count` of each, evenly from its sample."""
    points = [item.surface_m for item in items]
    kept = [p[np.linspace(0, len(p) - 1, min(len(p), count)).astype(int)] for p in points]
    return np.concatenate([np.zeros((0, 3)), *kept]) @ axes.T


def _pairs(count: int) -> Iterator[tuple[int, int]]:
    """All pairs of numbers below a count, smaller first, by their sum."""
    for total in range(1, 2 * count - 2):
        for first in range(max(0, total - count + 1), (total + 1) // 2):
            yield first, total - first


def _turn(heading: float) -> Float64:
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _motions(headings: Float64, places: Float64, onto: Float64) -> Float64:
    """Motions (n, 4) with headings (n,) that put places (n, 3) onto others (n, 3)."""
    cos, sin = np.cos(headings), np.sin(headings)
    x, y, z = places.T
    turned = np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)
    return np.column_stack([headings, onto - turned])


def _fit(places: Float64, onto: Float64, weights: Float64) -> Float64:
    """The motion (4,) of weighted least squares that puts places (n, 3) onto others (n, 3)."""
    share = weights[:, None] / weights.sum()
    p0, q0 = (share * places).sum(axis=0), (share * onto).sum(axis=0)
    x, y = places - p0, onto - q0
    cross = (share[:, 0] * (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0])).sum()
    heading = np.arctan2(cross, (share * x[:, :2] * y[:, :2]).sum())
    return _motions(np.array([heading]), p0[None], q0[None])[0]


def _different(motions: Float64, scores: Float64, count: int) -> Float64:
    """The best motions, at most `count`, that differ from each other, the best first."""
    kept: list[Float64] = []
    for motion in motions[np.argsort(-scores, kind="stable")[: 40 * count]]:
        if all(_differs(motion, other) for other in kept):
            kept.append(motion)
        if len(kept) == count:
            break
    return np.array(kept)


def _differs(a: Float64, b: Float64) -> bool:
    turn = abs((a[0] - b[0] + np.pi) % (2 * np.pi) - np.pi)
    return bool(turn > OTHER_RAD or np.linalg.norm(a[1:] - b[1:]) > OTHER_M)


# --- Merges two graphs into one message: objects of both at one place become one.

# A transform with less confidence is not used unless it is given. Two chairs of a ring have a half.
MIN_CONFIDENCE = 0.9
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
