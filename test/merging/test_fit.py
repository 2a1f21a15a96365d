"""How well objects fit nodes: the compiled comparison against the formulas, and who is whom."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import ArrayLike
from support.merging import local_graph, random_classes, random_covariances, seeds

from deworldsg_ros.merging.fit import (
    CLASS_AGREEMENT,
    CLASS_BONUS,
    GAUSSIAN_BONUS,
    MAX_DEVIATIONS,
    OVERLAP_THRESHOLD_OTHER_CLASS,
    SIZE_RATIO_OTHER_CLASS,
    fit,
    one_to_one,
)
from deworldsg_ros.merging.joint import APART, JointEvidence
from deworldsg_ros.scene.gaussian import bhattacharyya_distance
from deworldsg_ros.scene.nodes import NodeTable

OVERLAP_THRESHOLD = 0.3
CELL_M = 0.03


def deviations(difference: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.sqrt(difference @ np.linalg.solve(covariance, difference)))


@given(seeds)
@settings(max_examples=25)
def test_values_equal_the_formulas(seed: int) -> None:
    rng = np.random.default_rng(seed)
    local = local_graph(
        1, rng.normal(0, 0.3, (4, 3)), random_covariances(rng, 4, 0.01), random_classes(rng, 4)
    )
    nodes = NodeTable(4)
    for index in range(5):
        covariance, classes = random_covariances(rng, 1, 0.01)[0], random_classes(rng, 1)[0]
        nodes.put(nodes.append(index + 1), rng.normal(0, 0.3, 3), covariance, classes, 1.0, 1)
    rows = rng.permutation(5)[:3]
    shares = rng.uniform(0, 1, (4, 3))
    values, touching = fit(local, nodes, rows, shares, OVERLAP_THRESHOLD, CELL_M)
    blur = CELL_M**2 / 12 * np.eye(3)
    for (index, column), share in np.ndenumerate(shares):
        row = rows[column]
        agreement = local.class_probabilities[index] @ nodes.class_probabilities[row]
        same = agreement > CLASS_AGREEMENT
        wanted = OVERLAP_THRESHOLD if same else OVERLAP_THRESHOLD_OTHER_CLASS
        ours, theirs = local.covariances_world[index] + blur, nodes.covariances[row] + blur
        difference = local.means_world[index] - nodes.means[row]
        apart = min(deviations(difference, ours), deviations(difference, theirs))
        distance = bhattacharyya_distance(local.means_world[index], ours, nodes.means[row], theirs)
        value = share + CLASS_BONUS * agreement + GAUSSIAN_BONUS * np.exp(-distance)
        sizes = np.sqrt([np.trace(ours), np.trace(theirs)])
        alike = same or sizes.max() <= SIZE_RATIO_OTHER_CLASS * sizes.min()
        fits = share >= wanted and alike and apart <= MAX_DEVIATIONS
        assert values[index, column] == pytest.approx(value if fits else 0.0, abs=1e-9)
        assert touching[index, column] == same


def test_nothing_to_compare() -> None:
    empty = local_graph(1, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 4)))
    values, touching = fit(
        empty, NodeTable(4), np.zeros(0, np.int64), np.zeros((0, 0)), OVERLAP_THRESHOLD, CELL_M
    )
    assert values.shape == touching.shape == (0, 0)
    assert one_to_one(values) == []
    assert one_to_one(np.zeros((2, 0))) == [-1, -1]


@given(seeds)
@settings(max_examples=25)
def test_the_assignment_has_the_greatest_total(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.uniform(0, 2, (3, 4)) * (rng.random((3, 4)) < 0.6)
    matched = one_to_one(values)
    taken = [column for column in matched if column >= 0]
    assert len(taken) == len(set(taken))
    total = sum(values[row, column] for row, column in enumerate(matched) if column >= 0)
    assert all(values[row, column] > 0 for row, column in enumerate(matched) if column >= 0)
    best = max(
        values[range(3), list(columns)].sum() for columns in itertools.permutations(range(4), 3)
    )
    assert total == pytest.approx(best)


def note(evidence: JointEvidence, seen: list[int], known: list[int], values: ArrayLike) -> None:
    """One frame; the first objects seen are those known, and what fits touches."""
    fits = np.array(values).reshape(len(seen), len(known))
    matched = [known.index(owner) if owner in known else -1 for owner in seen]
    evidence.note(seen, known, fits, fits > 0, matched)


def test_a_frame_that_shows_two_outweighs_ten_that_show_one_on_both() -> None:
    evidence = JointEvidence()
    for _ in range(2):
        note(evidence, [4], [4, 7], [[1, 1]])
        assert evidence.take() is None
    note(evidence, [4], [4, 7], [[1, 1]])
    assert evidence.take() == (4, 7)
    evidence.forget(7)

    # Side by side in one frame, wherever in it: they need not touch.
    note(evidence, [4, 7], [4, 7], [[1, 0], [0, 1]])
    for _ in range(12):
        note(evidence, [4], [4, 7], [[1, 1]])
    assert evidence.take() is None
    note(evidence, [4], [4, 7], [[1, 1]])
    assert evidence.take() == (4, 7)
    evidence.forget(7)
    assert evidence.take() is None
    assert evidence.counts == {}


def test_what_touches_for_long_and_is_never_seen_apart_is_one() -> None:
    evidence = JointEvidence()
    fits, touching = np.array([[1.0, 0.0]]), np.ones((1, 2), bool)
    for _ in range(8):
        evidence.note([4], [4, 7], fits, touching, [0])
    assert evidence.take() is None
    evidence.note([4], [4, 7], fits, touching, [0])
    assert evidence.take() == (4, 7)


def test_a_new_node_is_another_than_those_of_its_frame() -> None:
    evidence = JointEvidence()
    note(evidence, [2, 5], [2], [[1], [0.5]])
    assert evidence.counts == {(2, 5): -APART}


def test_what_two_parts_were_seen_beside_their_whole_was() -> None:
    evidence = JointEvidence()
    note(evidence, [1, 3], [], [[], []])
    note(evidence, [2, 3], [3], [[0], [1]])
    evidence.merge(1, 2)
    assert evidence.counts == {(1, 3): -2 * APART}


def test_what_lies_on_two_that_are_known_apart_becomes_one_of_them_only() -> None:
    evidence = JointEvidence()
    note(evidence, [2, 3], [], [[], []])
    for _ in range(3):
        note(evidence, [1], [1, 2, 3], [[1, 1, 1]])
    pair = evidence.take()
    assert pair in {(1, 2), (1, 3)}
    evidence.merge(*pair)
    assert evidence.take() is None


@given(seeds)
@settings(max_examples=20)
def test_evidence_goes_on_from_its_counts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    evidence, restored = JointEvidence(), JointEvidence()
    for _ in range(30):
        owners = rng.permutation(6)[: rng.integers(1, 5)].tolist()
        note(evidence, owners, [*owners, 6], rng.integers(0, 2, (len(owners), len(owners) + 1)))
    restored.restore(evidence.counts)
    assert restored.counts == evidence.counts
