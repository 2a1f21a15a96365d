"""The class of a node: wrong names that last a while do not win against those that return."""

from __future__ import annotations

import numpy as np
import pytest

from deworldsg_ros.merging import beliefs
from deworldsg_ros.merging.records import NodeRecords

COUNT = 12


def distribution(label: int, certainty: float = 0.85) -> np.ndarray:
    """What a detector says: one label, and a little of each."""
    seen = np.full((1, COUNT), (1 - certainty) / (COUNT - 1))
    seen[0, label] = certainty
    return seen


def named(labels: list[int], frames_per_s: float = 10.0) -> np.ndarray:
    """Class distribution (COUNT,) after frames with these labels."""
    records = NodeRecords()
    records.add(0, 1, distribution(labels[0])[0], 0)
    classes = distribution(labels[0])
    for index, label in enumerate(labels[1:], 1):
        classes = records.name(
            np.array([0]), distribution(label), round(index * 1e9 / frames_per_s)
        )
    return classes[0]


def test_distributions_sum_to_one_and_grow_sharp() -> None:
    few, many = named([3] * 2), named([3] * 300)
    for classes in (few, many):
        assert np.isclose(classes.sum(), 1.0) and classes.argmax() == 3 and (classes > 0).all()
    assert many[3] > few[3] + 0.2 and many[3] > 0.85


def test_single_wrong_frames_do_not_matter() -> None:
    assert named(([3] * 4 + [5]) * 10).argmax() == 3


def test_a_long_wrong_spell_loses_against_shorter_right_ones() -> None:
    """The wrong name has more frames, but its single spell could be chance: three are not."""
    labels = [3] * 6 + [5] * 20 + [3] * 6 + [7] * 4 + [3] * 6
    assert labels.count(5) > labels.count(3)
    assert np.bincount(labels).argmax() == 5
    assert named(labels, frames_per_s=20.0).argmax() == 3


def test_two_equal_spells_leave_doubt() -> None:
    classes = named([3] * 10 + [5] * 10)
    assert 0.2 < classes[3] < 0.8 and 0.2 < classes[5] < 0.8


@pytest.mark.parametrize("seed", range(3))
def test_more_labels_than_places_keep_the_probable_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    labels = [3] * 5
    for _ in range(20):
        labels += [int(rng.integers(COUNT)), 3]
    classes = named(labels)
    assert classes.argmax() == 3 and np.isclose(classes.sum(), 1.0)


def reference(frames: list[np.ndarray], step_s: float) -> np.ndarray:
    """The same filter with all labels, by matrices; for few classes."""
    count = len(frames[0])
    drawn = np.full((count, count), beliefs.WRONG / (count - 1))
    np.fill_diagonal(drawn, 1 - beliefs.WRONG)
    joint = drawn * frames[0][None]
    for seen in frames[1:]:
        leave = 1 - np.exp(-step_s / beliefs.SPELL_S)
        joint = (1 - leave) * joint + leave * drawn * joint.sum(axis=1, keepdims=True)
        joint = joint * ((1 - beliefs.OUTLIERS) * seen + beliefs.OUTLIERS / count)[None]
        joint /= joint.sum()
    return beliefs.OTHERS / count + (1 - beliefs.OTHERS) * joint.sum(axis=1)


@pytest.mark.parametrize("seed", range(10))
def test_the_filter_is_that_of_the_definition(seed: int) -> None:
    """With no more classes than places, all labels are considered."""
    rng = np.random.default_rng(seed)
    frames = [rng.dirichlet(np.full(beliefs.LABELS, 0.5)) for _ in range(15)]
    records = NodeRecords()
    records.add(0, 1, frames[0], 0)
    for index, seen in enumerate(frames[1:], 1):
        classes = records.name(np.array([0]), seen[None], index * 10**8)
    np.testing.assert_allclose(classes[0], reference(frames, 0.1), rtol=1e-9)
