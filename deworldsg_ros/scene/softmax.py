"""Softmax. scipy.special has it, too, but takes a third of the start of a node to import."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from deworldsg_ros.scene.arrays import Float64


class SoftmaxWeights(NamedTuple):
    """What the softmax of logits (..., C) is made from.

    Attributes:
        best: (..., 1) the greatest logits.
        exponentials: (..., C) of the logits without the greatest one.
        totals: (..., 1) sums of the exponentials.
    """

    best: Float64
    exponentials: Float64
    totals: Float64


def softmax_weights(logits: Float64) -> SoftmaxWeights:
    """See `SoftmaxWeights`; logits (..., C) float64, C > 0."""
    best = logits.max(axis=-1, keepdims=True)
    exponentials = np.exp(logits - best)
    return SoftmaxWeights(best, exponentials, exponentials.sum(axis=-1, keepdims=True))


def softmax(logits: Float64) -> Float64:
    """The distributions of logits (..., C) float64; each sums to 1."""
    _, exponentials, totals = softmax_weights(logits)
    return np.asarray(exponentials / totals)
