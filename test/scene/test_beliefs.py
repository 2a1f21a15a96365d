"""Distributions as messages list them."""

from __future__ import annotations

import numpy as np
import pytest

from deworldsg_ros.graph.messages import listed

NAMES = tuple("abcdefgh")


@pytest.mark.parametrize("frames", [1, 2, 4, 10, 64])
def test_the_best_labels_the_rest_and_the_entropy(frames: int) -> None:
    rng = np.random.default_rng(frames)
    # Means of rounded numbers: many lie half-way between two rounded ones.
    seen = np.round(rng.dirichlet(np.full(len(NAMES), 0.3), (2000, frames)), 4)
    rows = np.concatenate([seen.mean(axis=1), np.eye(len(NAMES)), np.full((1, 8), 0.125)])
    for row, told in zip(rows, listed(rows, NAMES, 3)):
        best = (-row).argsort(kind="stable")[:3].tolist()
        expected = [(NAMES[index], round(float(row[index]), 4)) for index in best]
        assert [(item.label, item.probability) for item in told.beliefs] == expected
        listed_sum = sum(share for _, share in expected)
        assert told.remainder == round(max(float(row.sum()) - listed_sum, 0.0), 4)
        positive = row[row > 0]
        assert told.entropy_nats == pytest.approx(-(positive @ np.log(positive)), abs=5.1e-5)


def test_no_distributions() -> None:
    assert listed(np.zeros((0, 8)), NAMES, 3) == []


def test_fewer_labels_than_are_listed() -> None:
    (told,) = listed(np.array([[0.25, 0.75]]), ("a", "b"), 5)
    assert [(item.label, item.probability) for item in told.beliefs] == [("b", 0.75), ("a", 0.25)]
    assert told.remainder == 0.0
