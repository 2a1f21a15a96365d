"""Finds how the world frame of one graph lies in that of another, from the objects of both.

Gravity is known in both, so a heading and a translation are unknown. Two objects in each graph, of
equal classes and at equal distances, give a hypothesis. The one that puts most objects onto objects
of their class wins; a rare class counts more than a frequent one.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.scene.arrays import Bool, Float64
from deworldsg_ros.scene.extent import horizontal_axes

# Centres of one object in two sessions differ by less.
REACH_M = 0.3
# Two objects this close give no heading.
MIN_BASE_M = 0.5
# Hypotheses that are tried; those of the rarest classes first.
MOST_HYPOTHESES = 4000
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
    same = np.array([[i.label == j.label for j in b] for i in a], np.bool_).reshape(len(a), len(b))
    tried = _hypotheses(places_a, places_b, same, rarity)
    if not tried:
        raise ClientError(
            f"no transform found: graphs of {len(a)} and {len(b)} objects have no two objects of "
            "equal classes at equal distances; give the transform"
        )
    scores = np.array([_score(T, places_a, places_b, same, rarity) for T in tried])
    order = np.argsort(-scores, kind="stable")
    best = _refined(tried[order[0]], places_a, places_b, same)
    score = _score(best, places_a, places_b, same, rarity)
    others = [scores[i] for i in order if _differs(tried[i], best)]
    second = float(others[0]) if others else 0.0
    most = min(rarity[same.any(axis=0)].sum(), rarity.sum())
    lead = max(0.0, 1.0 - second / max(score, 1e-9))
    T_a_b = np.eye(4)
    axes_a, axes_b = horizontal_axes(a[0].up), horizontal_axes(b[0].up)
    turn = _turn(best)
    T_a_b[:3, :3] = axes_a.T @ turn @ axes_b
    T_a_b[:3, 3] = axes_a.T @ (best[1:] - turn @ middle)
    confidence = float(min(1.0, score / max(float(most), 1e-9))) * lead
    return Alignment(T_a_b, confidence, len(_matches(best, places_a, places_b, same)))


def _places(items: Sequence[SceneObject]) -> Float64:
    """Centres (n, 3): two horizontal coordinates and the height."""
    axes = horizontal_axes(items[0].up) if items else np.eye(3)
    return np.array([item.position_m for item in items], np.float64).reshape(-1, 3) @ axes.T


def _rarity(a: Sequence[SceneObject], b: Sequence[SceneObject]) -> Float64:
    """Weight (n,) of each object of B."""
    counts_a = Counter(item.label for item in a)
    counts_b = Counter(item.label for item in b)
    return np.array([(max(counts_a[i.label], 1) * counts_b[i.label]) ** -0.5 for i in b])


def _hypotheses(a: Float64, b: Float64, same: Bool, rarity: Float64) -> list[Float64]:
    """Heading and translation (4,) of pairs of objects, those of rare classes first."""
    order = np.argsort(-rarity, kind="stable")
    found: list[Float64] = []
    for i, j in sorted(itertools.combinations(range(len(order)), 2), key=sum):
        p, q = b[order[i]], b[order[j]]
        step = q - p
        base = float(np.hypot(step[0], step[1]))
        if base < MIN_BASE_M:
            continue
        for k, m in itertools.product(*(np.flatnonzero(same[:, order[x]]) for x in (i, j))):
            other = a[m] - a[k]
            apart = abs(float(np.hypot(other[0], other[1])) - base)
            if k == m or apart > REACH_M or abs(other[2] - step[2]) > REACH_M:
                continue
            heading = np.arctan2(other[1], other[0]) - np.arctan2(step[1], step[0])
            start = np.array([heading, 0.0, 0.0, 0.0])
            middle = (p + q) / 2 @ _turn(start).T
            found.append(np.array([heading, *((a[k] + a[m]) / 2 - middle)]))
        if len(found) >= MOST_HYPOTHESES:
            break
    return found


def _turn(motion: Float64) -> Float64:
    cos, sin = np.cos(motion[0]), np.sin(motion[0])
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _matches(motion: Float64, a: Float64, b: Float64, same: Bool) -> list[tuple[int, int]]:
    """Nearest pairs of one class within reach, each object once: (row of A, row of B)."""
    moved = b @ _turn(motion).T + motion[1:]
    gaps = np.linalg.norm(a[:, None] - moved[None], axis=2)
    gaps = np.where(same & (gaps <= REACH_M), gaps, np.inf)
    pairs = []
    while gaps.size and np.isfinite(gaps.min()):
        row, column = np.unravel_index(int(gaps.argmin()), gaps.shape)
        pairs.append((int(row), int(column)))
        gaps[row], gaps[:, column] = np.inf, np.inf
    return pairs


def _score(motion: Float64, a: Float64, b: Float64, same: Bool, rarity: Float64) -> float:
    """Sum of the weights of the objects of B near an object of A of their class."""
    moved = b @ _turn(motion).T + motion[1:]
    gaps = np.where(same, np.linalg.norm(a[:, None] - moved[None], axis=2), np.inf)
    near = np.clip(1.0 - gaps.min(axis=0, initial=np.inf) / (2 * REACH_M), 0.0, 1.0)
    return float(rarity @ near)


def _refined(motion: Float64, a: Float64, b: Float64, same: Bool) -> Float64:
    """The motion of least squares over the matches, twice."""
    for _ in range(2):
        pairs = np.array(_matches(motion, a, b, same)).reshape(-1, 2)
        if len(pairs) < 2:
            return motion
        p, q = b[pairs[:, 1]], a[pairs[:, 0]]
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
