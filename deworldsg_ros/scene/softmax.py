"""Softmax. scipy.special has it, too, but takes a third of the start of a node to import."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.arrays import Float64


def softmax(logits: Float64) -> Float64:
    """The distributions of logits (..., C) float64; each sums to 1."""
    exponentials = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return np.asarray(exponentials / exponentials.sum(axis=-1, keepdims=True))
