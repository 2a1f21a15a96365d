"""Distributions as messages list them: the best labels, the rest, and the entropy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64, Int64

# Decimals of probabilities and entropies: more than their calibration.
DECIMALS = 4
_SCALE = 10.0**DECIMALS


class Listed(NamedTuple):
    """One distribution.

    Attributes:
        beliefs: the labels with the highest probabilities, the best first. Labels of equal
            probability stay in the order of the vocabulary.
        remainder: probability of all labels that are not listed.
        entropy_nats: of the whole distribution.
    """

    beliefs: list[wire.Belief]
    remainder: float
    entropy_nats: float


def listed(probabilities: Float64, names: Sequence[str], top_k: int) -> list[Listed]:
    """Distributions (n, R) over names, each with its best `top_k` labels."""
    probabilities = np.ascontiguousarray(probabilities, np.float64)
    found = _best(probabilities, probabilities.sum(axis=1), min(top_k, len(names)))
    order, shares, rests, entropies = (array.tolist() for array in found)
    return [
        Listed(list(map(wire.Belief, map(names.__getitem__, best), values)), rest, entropy)
        for best, values, rest, entropy in zip(order, shares, rests, entropies)
    ]


@kernel
def _rounded(value: float) -> float:
    """As `round(value, DECIMALS)`, for positive values.

    Means of rounded numbers often lie half-way between two numbers. The product alone does not tell
    on which side.
    """
    scaled = value * _SCALE
    whole = math.floor(scaled)
    over = scaled - whole - 0.5
    if over == 0.0:
        # What the product lost, by parts of the value that have exact products (Dekker).
        high = value * (2.0**27 + 1.0)
        high -= high - value
        over = high * _SCALE - scaled + (value - high) * _SCALE
    if over == 0.0:
        over = -0.5 + whole % 2
    return (whole + (over > 0.0)) / _SCALE


@kernel
def _best(
    probabilities: Float64, totals: Float64, top_k: int
) -> tuple[Int64, Float64, Float64, Float64]:
    """The best labels (n, k), their shares, the rests (n,) and the entropies (n,); rounded."""
    count, width = probabilities.shape
    order, shares = np.empty((count, top_k), np.int64), np.empty((count, top_k))
    rests, entropies = np.zeros(count), np.zeros(count)
    for row in range(count):
        kept = 0
        for label in range(width):
            value = probabilities[row, label]
            if value > 0.0:
                entropies[row] -= value * math.log(value)
            place = kept
            while place > 0 and probabilities[row, order[row, place - 1]] < value:
                if place < top_k:
                    order[row, place] = order[row, place - 1]
                place -= 1
            if place < top_k:
                order[row, place] = label
                kept = min(kept + 1, top_k)
        for place in range(top_k):
            shares[row, place] = _rounded(probabilities[row, order[row, place]])
            rests[row] += shares[row, place]
        rests[row] = _rounded(max(totals[row] - rests[row], 0.0))
        entropies[row] = _rounded(max(entropies[row], 0.0))
    return order, shares, rests, entropies
