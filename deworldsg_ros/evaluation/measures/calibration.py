"""Predicted probabilities compared with how often the predictions are right."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

BINS = 10
# Probabilities are clipped this far from 0 and 1: one certain error must not decide the log loss.
LOG_LOSS_MARGIN = 1e-3


class Calibrated(NamedTuple):
    """A predicted probability and whether the prediction is right."""

    probability: float
    right: bool


class ReliabilityBin(NamedTuple):
    """The predictions of one interval of probabilities: number, mean probability, part right."""

    size: int
    probability: float
    right: float


def reliability(beliefs: Sequence[Calibrated]) -> list[ReliabilityBin]:
    """The bins [0, 0.1), [0.1, 0.2), …, [0.9, 1] that have predictions, in this order."""
    probabilities = np.array([item.probability for item in beliefs], np.float64)
    right = np.array([item.right for item in beliefs], np.float64)
    index = np.clip((probabilities * BINS).astype(int), 0, BINS - 1)
    rows = [np.flatnonzero(index == number) for number in range(BINS)]
    return [
        ReliabilityBin(len(row), float(probabilities[row].mean()), float(right[row].mean()))
        for row in rows
        if len(row)
    ]


def calibration_error(beliefs: Sequence[Calibrated]) -> float:
    """Expected calibration error, Σ n · |part right - mean probability| / Σ n over the bins.

    NaN without beliefs.
    """
    if not beliefs:
        return math.nan
    gaps = [bin_.size * abs(bin_.right - bin_.probability) for bin_ in reliability(beliefs)]
    return sum(gaps) / len(beliefs)


def total_log_loss(beliefs: Sequence[Calibrated]) -> float:
    """Sum of -ln(probability of what is true), nats.

    Probabilities are clipped to [`LOG_LOSS_MARGIN`, 1 - `LOG_LOSS_MARGIN`].
    """
    stated = np.array([item.probability for item in beliefs], np.float64)
    of_truth = np.where([item.right for item in beliefs], stated, 1.0 - stated)
    return float(-np.log(np.clip(of_truth, LOG_LOSS_MARGIN, 1.0 - LOG_LOSS_MARGIN)).sum())
