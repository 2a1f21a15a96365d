"""Matching of predictions to annotated objects by the official vote of nearest points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from deworldsg_ros.scene.arrays import Float64, Int64

# The limits of the official program (FROSS, Merging/evaluate.py): distance to the nearest annotated
# point, fraction of votes of the best object, and ratio of the second best to the best.
OVERLAP_THRESHOLD_M = 0.1
MIN_VOTE_FRACTION = 0.5
MAX_SECOND_TO_BEST = 0.75


@dataclass(frozen=True)
class Support:
    """The object that a prediction supports, and its number of votes."""

    object_id: int
    points: int


@dataclass(frozen=True)
class Matching:
    """Result of the vote.

    Attributes:
        supports: the object that each prediction supports; None = void prediction.
        prediction_of: row of the prediction by id of the object, for each object that is found.
        skipped_points: number of points with NaN or infinity, which have no vote.
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
    """Match predictions to objects (docs/dev/evaluation/protocol.md, "Matching").

    Args:
        object_ids: ids of the annotated objects; annotated points of other ids are ignored.
        points_world: (n, 3) float64, metres, annotated surface points.
        point_objects: (n,) int64, object id of each annotated point.
        segments: points (n_i, 3) of each prediction, metres.
        threshold_m: a point votes for the object of its nearest annotated point if the distance is
            strictly less.
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
    return Matching(tuple(supports), _best_predictions(supports), skipped)


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
    # The distances of the tree went through a square root, whose rounding can change a vote.
    squared = delta[:, 0] * delta[:, 0] + delta[:, 1] * delta[:, 1] + delta[:, 2] * delta[:, 2]
    inside = squared < threshold_m * threshold_m
    return np.bincount(rows[nearest[inside]], minlength=object_count).astype(np.int64)


def _supported(votes: Int64, point_count: int) -> int | None:
    """Index of the object that the votes support; None = void prediction."""
    if point_count == 0 or not votes.any():
        return None
    best = int(votes.argmax())
    others = np.delete(votes, best)
    # A ratio of rounded fractions, as in the official program: 9/22 over 12/22 exceeds 0.75.
    fraction = int(votes[best]) / point_count
    second = (int(others.max()) if len(others) else 0) / point_count
    if fraction < MIN_VOTE_FRACTION or second / fraction > MAX_SECOND_TO_BEST:
        return None
    return best


def _best_predictions(supports: Sequence[Support | None]) -> dict[int, int]:
    """Row of the prediction with most votes for each object; of equal ones the first."""
    taken: dict[int, int] = {}
    for row, support in enumerate(supports):
        if support is None:
            continue
        current = taken.get(support.object_id)
        rival = supports[current] if current is not None else None
        if rival is None or support.points > rival.points:
            taken[support.object_id] = row
    return taken
