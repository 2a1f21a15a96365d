"""The bounded evidence of one frame: `bounded_logits`, against the mixture in plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import merging

from deworldsg_ros.config import Config, RelationsConfig
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.relations.paper import OUTLIER_RATE, bounded_logits

rates = st.sampled_from([0.01, 0.1, 0.5, 0.9])


@pytest.mark.parametrize("shape", [(0, 5), (3, 0), (3, 5)])
def test_shapes_stay(shape):
    logits = np.random.default_rng(0).normal(size=shape)
    assert bounded_logits(logits, 0.1).shape == shape


@pytest.mark.parametrize(("edge_belief", "rate"), [("paper", None), ("robust", OUTLIER_RATE)])
def test_the_option_chooses_the_logits_that_are_summed(edge_belief, rate):
    local = merging.local_graph(
        1,
        np.zeros((2, 3)),
        np.tile(np.eye(3), (2, 1, 1)),
        np.full((2, 4), 0.25),
        pairs=[(0, 1), (1, 0)],
        logits=np.random.default_rng(0).normal(0, 5, (2, 3)),
    )
    config = Config(relations=RelationsConfig(edge_belief=edge_belief))
    builder = GraphBuilder(config, merging.VOCABULARY, "world")
    (a, b) = builder.integrate(local)
    logits = local.relations.logits
    expected = logits if rate is None else bounded_logits(logits, rate)
    assert (builder.graph.edges[a, b].visual_logits == expected[0]).all()
    assert (builder.graph.edges[b, a].visual_logits == expected[1]).all()


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
def test_the_evidence_of_a_frame_is_bounded(rate, scale):
    values = bounded_logits(scale * np.array([[1.0, 0.0, -1.0, 0.5]]), rate)
    bound = math.log(1 + 4 * (1 - rate) / rate)
    assert np.isfinite(values).all() and np.ptp(values) <= bound * (1 + 1e-12)


def test_one_confident_wrong_frame_does_not_outweigh_two_right_ones():
    frames = np.array([[13.8, -13.8, -13.8], [-1.0, 2.0, -1.0], [-1.0, 2.0, -1.0]])
    assert frames.sum(axis=0).argmax() == 0
    assert bounded_logits(frames, 0.1).sum(axis=0).argmax() == 1
