"""Ranks of scores in the official order: the last of equal scores first, NaN above all numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Rank of an item without a match or an edge, as in the official program.
NO_RANK = 99999


def rank(scores: NDArray[Any], index: int) -> int:
    """Number of scores (n,) that rank before the one at `index`; 0 = the top.

    An index outside the scores has the rank `NO_RANK`, or n if that is larger.
    """
    if not 0 <= index < len(scores):
        return max(NO_RANK, len(scores))
    value = scores[index]
    later = scores[index + 1 :]
    if scores.dtype.kind != "f":
        return int((scores > value).sum() + (later == value).sum())
    if np.isnan(value):
        return int(np.isnan(later).sum())
    # NaN compares as not less or equal.
    return int((~(scores <= value)).sum() + (later == value).sum())


def triple_rank(
    subject_scores: NDArray[Any],
    object_scores: NDArray[Any],
    predicate_scores: NDArray[Any],
    triple: tuple[int, int, int],
) -> int:
    """Rank of (subject class, object class, predicate) among all triples.

    The score of a triple is (subject * object) * predicate, multiplied in this order and in the
    number type of the arrays. Ties follow the row-major order of triples, the predicate fastest.
    """
    sizes = (len(subject_scores), len(object_scores), len(predicate_scores))
    if not all(0 <= index < size for index, size in zip(triple, sizes)):
        return max(NO_RANK, sizes[0] * sizes[1] * sizes[2])
    # Predictions may overflow or contain NaN: the ranking defines both.
    with np.errstate(all="ignore"):
        ends = subject_scores[:, None] * object_scores[None, :]
        table = ends[:, :, None] * predicate_scores[None, None, :]
    index = (triple[0] * sizes[1] + triple[1]) * sizes[2] + triple[2]
    return rank(table.ravel(), index)
