"""The grid that finds objects in reach, against brute force."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deworldsg_ros.relations.reach import (
    BESIDE_REACH_M,
    CELL_M,
    MAX_CELLS,
    MIN_SHAPE_POINTS,
    OVER_REACH_M,
    REACH_M,
    ReachGrid,
    pairs_in_reach,
)

seeds = st.integers(0, 10_000)


def in_reach(low_a, high_a, low_b, high_b) -> bool:
    gap = np.maximum(low_a, low_b) - np.minimum(high_a, high_b)
    over = (gap[:2] <= BESIDE_REACH_M).all()
    return bool((gap[:2] <= REACH_M).all() and gap[2] <= (OVER_REACH_M if over else BESIDE_REACH_M))


def brute_force(rows, changed, low, high) -> set[frozenset[int]]:
    return {
        frozenset((a, b))
        for a, b in itertools.combinations(rows, 2)
        if (a in changed or b in changed) and in_reach(low[a], high[a], low[b], high[b])
    }


@settings(max_examples=30, deadline=None)
@given(seed=seeds, count=st.integers(0, 9))
def test_pairs_in_reach_are_those_of_brute_force(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(-1.5, 1.5, (count, 3))
    high = low + rng.uniform(0, 0.6, (count, 3))
    counts = rng.integers(MIN_SHAPE_POINTS - 2, 3 * MIN_SHAPE_POINTS, count)
    found = pairs_in_reach(low, high, counts)
    assert found.shape == (len(found), 2)
    solid = np.flatnonzero(counts >= MIN_SHAPE_POINTS).tolist()
    assert len({tuple(pair) for pair in found.tolist()}) == len(found)
    assert {frozenset(pair) for pair in found.tolist()} == brute_force(solid, solid, low, high)


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_a_grid_that_follows_finds_all_pairs(seed: int) -> None:
    """Objects of all sizes come, move, go, and become other rows."""
    rng = np.random.default_rng(seed)
    count = 150
    low, high = np.zeros((count, 3)), np.zeros((count, 3))
    counts = np.full(count, MIN_SHAPE_POINTS)
    grid, rows = ReachGrid(), set()
    for _ in range(400):
        row = int(rng.integers(count))
        if row in rows and rng.integers(3) == 0:
            grid.remove(row)
            rows.remove(row)
        elif row in rows and rng.integers(3) == 0 and len(rows) < count:
            to = min(set(range(count)) - rows)
            grid.move(row, to)
            low[to], high[to] = low[row], high[row]
            rows.remove(row)
            rows.add(to)
        else:
            size = rng.choice([0.3, 3.0, 2.0 * CELL_M * MAX_CELLS**0.5], p=[0.8, 0.18, 0.02])
            low[row] = rng.uniform(-15, 15, 3)
            high[row] = low[row] + rng.uniform(0, size, 3)
            grid.put(row, low[row], high[row])
            rows.add(row)
    changed = rng.choice(sorted(rows), min(8, len(rows)), replace=False).astype(np.int64)
    found = grid.pairs(changed, low, high, counts)
    assert set(found[:, 0].tolist()) <= set(changed.tolist())
    assert {frozenset(pair) for pair in found.tolist()} == brute_force(rows, changed, low, high)


@pytest.mark.parametrize(
    ("offset", "reached"),
    [
        ((0.0, 0.0, 0.0), True),
        ((0.65, 0.0, 0.0), True),
        ((0.75, 0.0, 0.0), False),
        ((0.0, 0.0, 1.3), True),
        ((0.0, 0.0, 1.5), False),
        ((0.2, 0.0, 1.3), True),
        ((0.3, 0.0, 1.3), False),
    ],
)
def test_how_far_related_objects_may_be_apart(offset, reached: bool) -> None:
    """Two cubes of 0.1 m."""
    low = np.array([[0.0, 0, 0], offset])
    counts = np.array([100, 100])
    assert len(pairs_in_reach(low, low + 0.1, counts)) == int(reached)
