"""Finds how the world frame of one graph lies in that of another, from the objects of both.

Gravity is known in both, so a heading and a translation are unknown. Two objects in each graph, of
equal classes and at equal distances, give a hypothesis. The one that puts most objects onto objects
of their class wins; a rare class counts more than a frequent one.
"""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.extent import horizontal_axes

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
