"""What of the probabilities of pairs is said, against plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deworldsg_ros.relations.states import (
    DECIMALS,
    MIN_PROBABILITY,
    SAME_PROBABILITY,
    said_predicates,
)

SYMMETRIC = np.array([False, True, True, False])


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(0, 6))
def test_said_predicates(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    exact = rng.dirichlet(np.full(4, 0.3), (count, 2)) * rng.random((count, 2, 1))
    exact[::2, 1] = exact[::2, 0] + rng.uniform(-0.004, 0.004, exact[::2, 0].shape)
    exact = exact.clip(0.0)
    probabilities = exact.copy()
    said, mutual = said_predicates(probabilities, SYMMETRIC)
    np.testing.assert_array_equal(probabilities, exact.round(DECIMALS))
    most, best = probabilities.max(axis=2), probabilities.argmax(axis=2)
    both = (most >= MIN_PROBABILITY).all(axis=1) & (best[:, 0] == best[:, 1])
    both &= np.ptp(most, axis=1) <= SAME_PROBABILITY
    np.testing.assert_array_equal(mutual, both & SYMMETRIC[best[:, 0]])
    np.testing.assert_array_equal(said[:, 0], most[:, 0] >= MIN_PROBABILITY)
    np.testing.assert_array_equal(said[:, 1], (most[:, 1] >= MIN_PROBABILITY) & ~mutual)


@pytest.mark.parametrize(("there", "back", "is_mutual"), [(0.8, 0.8, True), (0.8, 0.7, False)])
def test_a_symmetric_predicate_is_said_once(there: float, back: float, is_mutual: bool) -> None:
    probabilities = np.array([[[0.0, there, 0.0, 0.0], [0.0, back, 0.0, 0.0]]])
    said, mutual = said_predicates(probabilities, SYMMETRIC)
    assert said.tolist() == [[True, not is_mutual]] and mutual.tolist() == [is_mutual]
