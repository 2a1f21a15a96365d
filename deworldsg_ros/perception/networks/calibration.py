"""Independent sigmoid scores → one calibrated class distribution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.softmax import softmax

# Keeps the logit finite. The network's scores of absent classes are far higher.
SCORE_FLOOR = 1e-6


@dataclass(frozen=True)
class SoftmaxCalibration:
    """p = softmax(logit(scores) / temperature).

    Sigmoid scores are independent. If they were normalised, 80 classes at 0.01 would outweigh one
    at 0.5. The softmax of their logits keeps their order. The temperature is fitted by likelihood
    (temperature scaling, Guo et al. 2017) with tools/calibration/calibrate_detector.py.

    Attributes:
        temperature: above 0; below 1 sharpens.
    """

    temperature: float

    def __post_init__(self) -> None:
        if not self.temperature > 0:
            raise ValueError(f"calibration temperature is {self.temperature}, expected > 0")

    def __call__(self, scores: Float64) -> Float64:
        """Distributions (n, C), rows sum to one, of sigmoid scores (n, C)."""
        clipped = np.clip(np.asarray(scores, dtype=np.float64), SCORE_FLOOR, 1 - SCORE_FLOOR)
        logits = np.log(clipped / (1 - clipped)) / self.temperature
        return np.asarray(softmax(logits))
