"""How much one frame weighs in an edge: `bounded_logits`, against the mixture in plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deworldsg_ros.relations.evidence import bounded_logits

rates = st.sampled_from([0.01, 0.1, 0.5, 0.9])


@pytest.mark.parametrize("shape", [(0, 5), (3, 0), (3, 5)])
def test_no_outliers_are_the_sum_of_the_paper(shape):
    logits = np.random.default_rng(0).normal(size=shape)
    assert bounded_logits(logits, 0.0) is logits
    assert bounded_logits(logits, 0.1).shape == shape


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), rates)
def test_equals_the_mixture_and_follows_a_permutation_of_predicates(seed, rate):
    generator = np.random.default_rng(seed)
    logits, order = generator.normal(0, 4, (3, 6)), generator.permutation(6)
    bounded = bounded_logits(logits, rate)
    for row, values in zip(logits.tolist(), bounded.tolist()):
        exponentials = [math.exp(value) for value in row]
        for value, exponential in zip(values, exponentials):
            told = (1 - rate) * exponential / sum(exponentials)
            assert value == pytest.approx(math.log(told + rate / 6), abs=1e-12)
    np.testing.assert_allclose(bounded_logits(logits[:, order], rate), bounded[:, order])


@settings(max_examples=20, deadline=None)
@given(rates, st.sampled_from([1.0, 1e3, 1e300]))
def test_no_frame_weighs_more_than_an_outlier_may(rate, scale):
    values = bounded_logits(scale * np.array([[1.0, 0.0, -1.0, 0.5]]), rate)
    bound = math.log(1 + 4 * (1 - rate) / rate)
    assert np.isfinite(values).all() and np.ptp(values) <= bound * (1 + 1e-12)


def test_one_frame_that_is_surely_wrong_does_not_outweigh_two_that_are_right():
    frames = np.array([[13.8, -13.8, -13.8], [-1.0, 2.0, -1.0], [-1.0, 2.0, -1.0]])
    assert frames.sum(axis=0).argmax() == 0
    assert bounded_logits(frames, 0.1).sum(axis=0).argmax() == 1
