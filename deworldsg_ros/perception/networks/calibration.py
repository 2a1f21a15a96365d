"""Independent sigmoid scores → one calibrated class distribution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.scene.arrays import Float64

# Keeps the logit finite; far below the scores that the network gives to absent classes.
SCORE_FLOOR = 1e-6


@dataclass(frozen=True)
class SoftmaxCalibration:
    """p = softmax(logit(scores) / temperature).

    The network's sigmoids are independent: 80 classes at 0.01 each outweigh one at 0.5 when they
    are merely normalised. The softmax of their logits keeps their order, and its one parameter is
    fitted by likelihood (temperature scaling, Guo et al. 2017):
    tools/calibration/calibrate_detector.py.

    Attributes:
        temperature: > 0; below 1 sharpens.
    """

    temperature: float

    def __post_init__(self) -> None:
        if not self.temperature > 0:
            raise ValueError(f"calibration temperature is {self.temperature}: wanted > 0")

    def __call__(self, scores: Float64) -> Float64:
        """Distributions (n, C), rows sum to one, of sigmoid scores (n, C)."""
        clipped = np.clip(np.asarray(scores, dtype=np.float64), SCORE_FLOOR, 1 - SCORE_FLOOR)
        logits = np.log(clipped / (1 - clipped)) / self.temperature
        if logits.size == 0:
            return np.asarray(logits)
        weights = np.exp(logits - logits.max(axis=1, keepdims=True))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))
