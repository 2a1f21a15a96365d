"""Eq. 8 against an obvious reference."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deworldsg_ros.relations.paper import geometric_costs, neighbour_pairs

WIDTH, HEIGHT = 640, 480


def reference(boxes, depths, threshold):
    found = {}
    for i in range(len(boxes)):
        for j in range(len(boxes)):
            ci = ((boxes[i][0] + boxes[i][2]) / 2, (boxes[i][1] + boxes[i][3]) / 2)
            cj = ((boxes[j][0] + boxes[j][2]) / 2, (boxes[j][1] + boxes[j][3]) / 2)
            cost = 0.5 * math.dist(ci, cj) / math.sqrt(WIDTH**2 + HEIGHT**2)
            cost += abs(depths[i] - depths[j])
            if i != j and cost < threshold:
                found[i, j] = cost
    return found


def random_objects(count, seed):
    generator = np.random.default_rng(seed)
    corners = generator.uniform(0, (WIDTH, HEIGHT), (count, 2, 2))
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    return boxes, generator.uniform(0.5, 2.0, count)


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_objects_have_no_pairs(count):
    pairs, costs = neighbour_pairs(*random_objects(count, 0), WIDTH, HEIGHT, 0.45)
    assert pairs.shape == (0, 2) and pairs.dtype == np.int64
    assert costs.shape == (0,)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 12), st.integers(0, 10_000))
def test_equals_the_loop_over_all_pairs(count, seed):
    boxes, depths = random_objects(count, seed)
    pairs, costs = neighbour_pairs(boxes, depths, WIDTH, HEIGHT, 0.45)
    expected = reference(boxes, depths, 0.45)
    assert [tuple(pair) for pair in pairs.tolist()] == sorted(expected)
    np.testing.assert_allclose(costs, [expected[key] for key in sorted(expected)], rtol=1e-12)


def test_costs_are_symmetric_and_both_directions_are_given():
    boxes, depths = random_objects(9, 3)
    costs = geometric_costs(boxes, depths, WIDTH, HEIGHT)
    assert (costs == costs.T).all() and (np.diag(costs) == 0).all()
    pairs, _ = neighbour_pairs(boxes, depths, WIDTH, HEIGHT, 0.45)
    assert {tuple(pair) for pair in pairs} == {tuple(pair[::-1]) for pair in pairs}


def test_opposite_corners_at_one_depth_cost_one_half():
    boxes = np.array([[0.0, 0, 0, 0], [WIDTH, HEIGHT, WIDTH, HEIGHT]])
    costs = geometric_costs(boxes, np.array([1.0, 1.0]), WIDTH, HEIGHT)
    assert costs[0, 1] == 0.5


def test_threshold_is_strict():
    boxes = np.zeros((2, 4))
    depths = np.array([1.0, 1.5])
    assert len(neighbour_pairs(boxes, depths, WIDTH, HEIGHT, 0.5)[0]) == 0
    assert len(neighbour_pairs(boxes, depths, WIDTH, HEIGHT, np.nextafter(0.5, 1))[0]) == 2
