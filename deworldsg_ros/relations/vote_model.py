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
from dataclasses import dataclass

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


@dataclass(frozen=True)
class VoteScales:
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

    def evidence(self, votes: Float64, frames: Float64) -> Float64:
        """Evidence in nats of votes among frames; 0 without frames."""
        fraction = votes / np.maximum(frames, 1e-9)
        ratio = np.log((fraction + self.floor) / (self.even + self.floor))
        return np.asarray(frames / (frames + self.n_half) * self.slope * ratio)


def relation_counts(votes: Float64, relation_of: Int64) -> Float64:
    """Votes by relation.

    Args:
        votes: (..., R) sums of the votes.
        relation_of: (R,) relation of each predicate, -1 = it names none.

    Returns:
        (..., NONE) float64.
    """
    names = (relation_of[:, None] == np.arange(NONE)).astype(np.float64)
    return np.asarray(votes @ names)


def vote_logits(counts: Float64, frames: Float64, scales: VoteScales) -> Float64:
    """Logits (m, STATE_COUNT) of the states of pairs.

    A relation that has a converse has the votes of both.

    Args:
        counts: (m, 2, NONE) of `relation_counts` in both directions.
        frames: (m,) number of frames that showed both objects.
        scales: of the evidence.
    """
    slopes = (scales.slope, scales.n_half, scales.floor, scales.even)
    return _vote_logits(counts, frames, *slopes)


@kernel
def _vote_logits(
    counts: Float64, frames: Float64, slope: float, n_half: float, floor: float, even: float
) -> Float64:
    logits = np.zeros((len(counts), STATE_COUNT))
    for row in range(len(counts)):
        known = max(frames[row], 1e-9)
        worth = frames[row] / (frames[row] + n_half) * slope
        for state in range(1, STATE_COUNT):
            votes = 0.0
            for end in range(2):
                relation = _STATES[state, end]
                if relation != NONE:
                    votes += counts[row, end, relation] / _NAMED[state]
            logits[row, state] = worth * math.log((votes / known + floor) / (even + floor))
    return logits


def near_logits(counts: Float64, frames: Float64, scales: VoteScales) -> Float64:
    """Logits (m,) of near against "not related"; arguments as in `vote_logits`."""
    return scales.evidence(counts[..., NEAR].mean(axis=1), frames)


assert len(RELATIONS) == NONE + 1
