"""Which prediction stands for which annotated object: the official vote of nearest points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from deworldsg_ros.scene.arrays import Float64, Int64

OVERLAP_THRESHOLD_M = 0.1
MIN_SHARE = 0.5
MAX_SECOND_SHARE = 0.75


@dataclass(frozen=True)
class Support:
    """The object that a prediction supports, and with how many points."""

    object_id: int
    points: int


@dataclass(frozen=True)
class Matching:
    """Result of the vote.

    Attributes:
        supports: of each prediction; None for a void one.
        prediction_of: prediction that was taken for each object that was found.
        skipped_points: predicted or annotated points with NaN or infinity, which cannot vote.
    """

    supports: tuple[Support | None, ...]
    prediction_of: dict[int, int]
    skipped_points: int


def match(
    object_ids: Sequence[int],
    points_world: Float64,
    point_objects: Int64,
    segments: Sequence[NDArray[np.floating[Any]]],
    threshold_m: float = OVERLAP_THRESHOLD_M,
) -> Matching:
    """Match predictions to objects (docs/evaluation/protocol.md, "Matching").

    Args:
        object_ids: the annotated objects; points of no other id are looked at.
        points_world: (n, 3) float64, metres, annotated surface points.
        point_objects: (n,) object id of each.
        segments: points (n_i, 3) of each prediction.
        threshold_m: a point votes for the object of its nearest neighbour if that is strictly
            nearer than this.
    """
    ids = np.array(sorted(set(object_ids)), np.int64)
    kept = np.isin(point_objects, ids)
    usable = kept & np.isfinite(points_world).all(axis=1)
    skipped = int((kept & ~usable).sum())
    surface = np.ascontiguousarray(points_world[usable])
    rows = np.searchsorted(ids, point_objects[usable])
    tree = cKDTree(surface) if len(surface) else None

    supports: list[Support | None] = []
    for segment in segments:
        points = np.asarray(segment, np.float64).reshape(-1, 3)
        finite = points[np.isfinite(points).all(axis=1)]
        skipped += len(points) - len(finite)
        votes = np.zeros(len(ids), np.int64)
        if tree is not None and len(finite):
            votes = _votes(tree, surface, rows, finite, len(ids), threshold_m)
        best = _supported(votes, len(points))
        supports.append(None if best is None else Support(int(ids[best]), int(votes[best])))
    return Matching(tuple(supports), _take(supports), skipped)


def _votes(
    tree: Any,
    surface: Float64,
    rows: Int64,
    points: Float64,
    object_count: int,
    threshold_m: float,
) -> Int64:
    _, nearest = tree.query(points)
    delta = points - surface[nearest]
    # The tree's own distances went through a square root: 1 nm decides, and so does one rounding.
    squared = delta[:, 0] * delta[:, 0] + delta[:, 1] * delta[:, 1] + delta[:, 2] * delta[:, 2]
    inside = squared < threshold_m * threshold_m
    return np.bincount(rows[nearest[inside]], minlength=object_count).astype(np.int64)


def _supported(votes: Int64, point_count: int) -> int | None:
    """Place of the object that these votes support; None for a void prediction."""
    if point_count == 0 or not votes.any():
        return None
    best = int(votes.argmax())
    others = np.delete(votes, best)
    # Quotients of rounded quotients, in this form: 9/22 over 12/22 is a little above 0.75.
    share = int(votes[best]) / point_count
    second_share = (int(others.max()) if len(others) else 0) / point_count
    if share < MIN_SHARE or second_share / share > MAX_SECOND_SHARE:
        return None
    return best


def _take(supports: Sequence[Support | None]) -> dict[int, int]:
    """Each object takes the prediction with most points; of equals the first."""
    taken: dict[int, int] = {}
    for row, support in enumerate(supports):
        if support is None:
            continue
        current = taken.get(support.object_id)
        rival = supports[current] if current is not None else None
        if rival is None or support.points > rival.points:
            taken[support.object_id] = row
    return taken
