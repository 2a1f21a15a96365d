"""Independent sigmoid scores → one calibrated class distribution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.scene.frame_graph import Float64

# Keeps the logit finite; far below the scores that the network gives to absent classes.
SCORE_FLOOR = 1e-6


@dataclass(frozen=True)
class SoftmaxCalibration:
    """p = (1 - uniform) softmax(logit(scores) / temperature) + uniform / C.

    The network's sigmoids are independent: 80 classes at 0.01 each outweigh one at 0.5 when they
    are merely normalised. The softmax of their logits with a fitted temperature is the one-
    parameter family that keeps their order (Guo et al. 2017); the uniform share bounds the loss
    where the network is surely wrong. bench/calibrate_detector.py fits both.

    Attributes:
        temperature: > 0; below 1 sharpens.
        uniform: in [0, 1), share of the uniform distribution.
    """

    temperature: float
    uniform: float

    def __post_init__(self) -> None:
        if self.temperature <= 0 or not 0 <= self.uniform < 1:
            raise ValueError(f"{self}: wanted temperature > 0 and 0 <= uniform < 1")

    def __call__(self, scores: Float64) -> Float64:
        """Distributions (n, C), rows sum to one, of sigmoid scores (n, C)."""
        clipped = np.clip(np.asarray(scores, dtype=np.float64), SCORE_FLOOR, 1 - SCORE_FLOOR)
        logits = np.log(clipped / (1 - clipped)) / self.temperature
        if logits.size == 0:
            return logits
        weights = np.exp(logits - logits.max(axis=1, keepdims=True))
        softmax = weights / weights.sum(axis=1, keepdims=True)
        return np.asarray((1 - self.uniform) * softmax + self.uniform / softmax.shape[1])
