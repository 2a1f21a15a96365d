"""Eq. 5 and 6: the compiled search against np.linalg."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.merging import random_classes, random_covariances, random_pose, seeds
from support.reference_merging import class_distance, may_merge

from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.merging.paper_rule import (
    _nearest,
    bhattacharyya_bound,
    nearest_slot,
    observed,
    warm_up,
)
from deworldsg_ros.scene.gaussian import (
    bhattacharyya_distance,
    eigenvalue_bound,
    hellinger_distance,
)


def table_of(means, covariances, classes, ids=None) -> NodeTable:
    nodes = NodeTable(classes.shape[1])
    for index in range(len(means)):
        row = nodes.add(index + 1 if ids is None else int(ids[index]))
        nodes.put(row, means[index], covariances[index], classes[index], 1.0, 1)
    return nodes


def search(mean, covariance, classes, nodes, delta_g=0.7, delta_c=0.8, skipped_row=-1) -> int:
    item = observed(mean, covariance, classes)
    return nearest_slot(item, nodes, bhattacharyya_bound(delta_g), delta_c, skipped_row)


@given(seeds, st.sampled_from([0.05, 0.3, 0.7, 0.95]), st.sampled_from([0.2, 0.8, 1.0]))
def test_the_kernel_equals_linalg(seed: int, delta_g: float, delta_c: float) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 60))
    spread_m = 10 ** rng.uniform(-3, 1)
    means = rng.normal(0, spread_m, (count, 3))
    covariances = random_covariances(rng, count)
    classes = random_classes(rng, count)
    # Some stand very near the observation, so that there is something to find.
    mean = rng.normal(0, spread_m, 3)
    covariance = random_covariances(rng, 1)[0]
    near = rng.random(count) < 0.3
    means[near] = mean + rng.normal(0, 0.01, (near.sum(), 3))
    covariances[near] = covariance * np.exp(rng.normal(0, 0.5, (near.sum(), 1, 1)))
    probabilities = random_classes(rng, 1)[0]
    skipped_row = int(rng.integers(-1, max(count, 1)))

    distances = hellinger_distance(mean, covariance, means, covariances)
    passing = may_merge(distances, class_distance(probabilities, classes), delta_g, delta_c)
    passing &= np.arange(count) != skipped_row
    expected = int(np.where(passing, distances, np.inf).argmin()) if passing.any() else -1

    nodes = table_of(means, covariances, classes)
    found = search(mean, covariance, probabilities, nodes, delta_g, delta_c, skipped_row)
    if found != expected:
        # Only where rounding decides: at the threshold, or between two equally near.
        values = [distances[row] for row in (found, expected) if row >= 0]
        assert abs(values[0] - (values[1] if len(values) == 2 else delta_g)) < 1e-9


@given(seeds)
def test_rigid_motion_of_everything_finds_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    means, covariances = rng.normal(0, 0.2, (30, 3)), random_covariances(rng, 30, 0.05)
    classes = random_classes(rng, 30)
    T = random_pose(rng)
    rotation = T[:3, :3]
    turned = rotation @ covariances @ rotation.T
    turned = (turned + turned.swapaxes(1, 2)) / 2
    here = table_of(means[1:], covariances[1:], classes[1:])
    there = table_of((means @ rotation.T + T[:3, 3])[1:], turned[1:], classes[1:])
    assert search(means[0], covariances[0], classes[0], here) == search(
        rotation @ means[0] + T[:3, 3], turned[0], classes[0], there
    )


@given(seeds)
def test_an_equal_gaussian_is_at_distance_zero_so_the_smallest_id_wins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    covariance, mean = random_covariances(rng, 1)[0], rng.normal(size=3)
    ids = rng.permutation(np.arange(1, 11))
    nodes = table_of(np.tile(mean, (10, 1)), np.tile(covariance, (10, 1, 1)), np.ones((10, 1)), ids)
    assert nodes.ids[search(mean, covariance, np.ones(1), nodes, delta_g=1e-7)] == 1


def test_the_warm_up_compiles_the_only_signature() -> None:
    warm_up()
    compiled = list(_nearest.signatures)
    rng = np.random.default_rng(0)
    nodes = table_of(rng.normal(size=(3, 3)), random_covariances(rng, 3), random_classes(rng, 3))
    search(
        rng.normal(size=(2, 3))[1],
        random_covariances(rng, 2)[1],
        nodes.class_probabilities[1],
        nodes,
    )
    assert list(_nearest.signatures) == compiled


def test_an_empty_graph_has_no_nearest_node() -> None:
    assert search(np.zeros(3), np.eye(3), np.ones(1), NodeTable(1)) == -1


@given(seeds)
def test_the_bounds_of_the_prefilter_hold(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_covariances(rng, 2)
    d = rng.normal(0, 1, 3)
    distance = bhattacharyya_distance(d, a, np.zeros(3), b)
    bound = d @ d / (4 * (eigenvalue_bound(a) + eigenvalue_bound(b)))
    assert bound <= distance * (1 + 1e-9) + 1e-12
    assert d @ np.linalg.solve((a + b) / 2, d) / 8 <= distance + 1e-9


def test_the_bound_equals_the_threshold() -> None:
    assert bhattacharyya_bound(0.7) == pytest.approx(0.67334455, abs=1e-8)
    for threshold in (0.1, 0.5, 0.99):
        assert np.sqrt(1 - np.exp(-bhattacharyya_bound(threshold))) == pytest.approx(threshold)


def test_the_gates_are_strict() -> None:
    hellinger = np.array([0.69, 0.7, 0.69, 0.71])
    classes = np.array([0.79, 0.79, 0.8, 0.1])
    assert may_merge(hellinger, classes, 0.7, 0.8).tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("p", "q", "expected"),
    [
        (np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)),
        ([1.0, 0.0], [1.0, 0.0], 0.0),
        ([1.0, 0.0], [0.0, 1.0], 1.0),
        ([0.5, 0.5], [0.5, 0.5], 0.5),
        ([0.2, 0.8], [[0.5, 0.5], [0.0, 1.0]], [0.5, 0.2]),
    ],
)
def test_class_distance(p, q, expected) -> None:
    np.testing.assert_allclose(class_distance(np.array(p), np.array(q)), expected, atol=1e-15)
