"""The evidence of frame votes: how much the votes of many frames speak for each relation.

Of the n frames that showed both objects, a fraction x voted for a relation. Its evidence, in nats
against "not related", is

    n / (n + n_half) · slope · log((x + floor) / (even + floor)).

It grows with the fraction, and saturates with the number of frames, because the frames of one pair
are not independent. A relation with fewer votes than the fraction `even` is less likely than
without votes. The four numbers are fitted to simulated rooms (tools/physics_model).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.relations.physical_states import (
    NEAR,
    NONE,
    RELATIONS,
    RELATIONS_OF_STATE,
    STATE_COUNT,
)
from deworldsg_ros.scene.arrays import Float64, Int64

# Relations of each state in both directions, and how many of them have a name.
_STATES = RELATIONS_OF_STATE
_NAMED = (_STATES != NONE).sum(axis=1).astype(np.float64)


class VoteScales(NamedTuple):
    """The numbers of the formula above.

    Attributes:
        slope: nats for each factor e of the fraction.
        n_half: frames that give half of the evidence of infinitely many.
        floor: fraction below which fewer votes hardly matter.
        even: fraction without evidence.
    """

    slope: float
    n_half: float
    floor: float
    even: float


def relation_counts(votes: Float64, relation_of: Int64) -> Float64:
    """Votes by relation.

    Args:
        votes: (..., R) sums of the votes.
        relation_of: (R,) relation of each predicate, -1 = it names none.

    Returns:
        (..., NONE) float64.
    """
    flat = np.ascontiguousarray(votes, np.float64).reshape(-1, 1, len(relation_of))
    counts, others = np.empty((len(flat), 1, NONE)), np.empty(len(flat))
    count_votes(np.arange(len(flat)), flat, relation_of, counts, others)
    return counts.reshape(*votes.shape[:-1], NONE)


@kernel
def count_votes(
    rows: Int64, votes: Float64, relation_of: Int64, counts: Float64, others: Float64
) -> None:
    """Write what votes are on.

    Args:
        rows: (k,) where to write.
        votes: (k, ends, R) sums of the votes, in some directions.
        relation_of: (R,) relation of each predicate, -1 = it names none.
        counts: (m, ends, NONE) votes by relation; written.
        others: (m,) most votes on a predicate that names no physical relation; written.
    """
    for index in range(len(rows)):
        row, most = rows[index], 0.0
        for end in range(votes.shape[1]):
            for relation in range(NONE):
                counts[row, end, relation] = 0.0
            for name in range(len(relation_of)):
                if relation_of[name] >= 0:
                    counts[row, end, relation_of[name]] += votes[index, end, name]
                else:
                    most = max(most, votes[index, end, name])
        others[row] = most


def vote_logits(counts: Float64, frames: Float64, scales: VoteScales) -> Float64:
    """Logits (m, STATE_COUNT) of the states of pairs.

    A relation that has a converse has the votes of both.

    Args:
        counts: (m, 2, NONE) of `relation_counts` in both directions.
        frames: (m,) number of frames that showed both objects.
        scales: of the evidence.
    """
    return _vote_logits(counts, frames, *scales)


def near_logits(counts: Float64, frames: Float64, scales: VoteScales) -> Float64:
    """Logits (m,) of near against "not related"; arguments as in `vote_logits`."""
    return _near_logits(counts, frames, *scales)


@kernel
def _vote_logits(
    counts: Float64, frames: Float64, slope: float, n_half: float, floor: float, even: float
) -> Float64:
    logits = np.zeros((len(counts), STATE_COUNT), np.float64)
    for row in range(len(counts)):
        for state in range(1, STATE_COUNT):
            votes = 0.0
            for end in range(2):
                relation = _STATES[state, end]
                if relation != NONE:
                    votes += counts[row, end, relation] / _NAMED[state]
            logits[row, state] = evidence(votes, frames[row], slope, n_half, floor, even)
    return logits


@kernel
def _near_logits(
    counts: Float64, frames: Float64, slope: float, n_half: float, floor: float, even: float
) -> Float64:
    logits = np.empty(len(counts), np.float64)
    for row in range(len(counts)):
        votes = (counts[row, 0, NEAR] + counts[row, 1, NEAR]) / 2.0
        logits[row] = evidence(votes, frames[row], slope, n_half, floor, even)
    return logits


@kernel
def evidence(
    votes: float, frames: float, slope: float, n_half: float, floor: float, even: float
) -> float:
    """Evidence in nats of votes among frames, 0 without frames: the formula above."""
    fraction = votes / max(frames, 1e-9)
    ratio = math.log((fraction + floor) / (even + floor))
    return float(frames / (frames + n_half) * slope * ratio)


assert len(RELATIONS) == NONE + 1
