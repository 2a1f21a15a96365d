"""Softmax gives the bits of scipy.special."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from deworldsg_ros.scene.arrays import softmax


@pytest.mark.parametrize("shape", [(0, 4), (1,), (50,), (7, 1), (300, 80), (2, 3, 5)])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 800.0])
def test_the_bits_are_those_of_scipy(shape: tuple[int, ...], scale: float) -> None:
    logits = np.random.default_rng(0).normal(0, scale, shape)
    np.testing.assert_array_equal(softmax(logits), special.softmax(logits, axis=-1))


def test_certain_and_impossible() -> None:
    logits = np.array([0.0, -np.inf, -1e4])
    assert softmax(logits).tolist() == [1.0, 0.0, 0.0]
