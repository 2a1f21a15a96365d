"""The grid that finds objects in reach, against brute force."""

import itertools
from collections.abc import Iterable

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from deworldsg_ros.relations import reach
from deworldsg_ros.relations.states import SHAPE

seeds = st.integers(0, 10_000)


def shapes_of(low: np.ndarray, high: np.ndarray, counts: np.ndarray | int = 99) -> np.ndarray:
    shapes = np.zeros(len(low), SHAPE)
    shapes["low"], shapes["high"], shapes["count"] = low, high, counts
    return shapes


def are_in_reach(a: np.void, b: np.void) -> bool:
    gap = np.maximum(a["low"], b["low"]) - np.minimum(a["high"], b["high"])
    over = (gap[:2] <= reach.BESIDE_REACH_M).all()
    solid = min(a["count"], b["count"]) >= reach.MIN_SHAPE_POINTS
    level_m = reach.OVER_REACH_M if over else reach.BESIDE_REACH_M
    return bool(solid and (gap[:2] <= reach.REACH_M).all() and gap[2] <= level_m)


def brute_force(items: Iterable[int], shapes: np.ndarray) -> set[frozenset[int]]:
    pairs = itertools.combinations(items, 2)
    return {frozenset((a, b)) for a, b in pairs if are_in_reach(shapes[a], shapes[b])}


@settings(max_examples=30, deadline=None)
@given(seed=seeds, count=st.integers(0, 9))
def test_pairs_in_reach_are_those_of_brute_force(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(-1.5, 1.5, (count, 3))
    counts = rng.integers(reach.MIN_SHAPE_POINTS - 2, 3 * reach.MIN_SHAPE_POINTS, count)
    shapes = shapes_of(low, low + rng.uniform(0, 0.6, (count, 3)), counts)
    found, expected = reach.pairs_in_reach(shapes), brute_force(range(count), shapes)
    assert found.shape == (len(expected), 2)
    assert {frozenset(pair) for pair in found.tolist()} == expected
    every = np.array(list(itertools.permutations(range(count), 2)), np.int64).reshape(-1, 2)
    assert reach.in_reach(every, shapes).tolist() == [are_in_reach(*shapes[pair]) for pair in every]


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_a_grid_that_follows_finds_all_pairs(seed: int) -> None:
    """Objects of all sizes come, move and go."""
    rng = np.random.default_rng(seed)
    count = 150
    shapes = shapes_of(np.zeros((count, 3)), np.zeros((count, 3)))
    grid, items = reach.ReachGrid(), set()
    grid.remove(7)  # not known: nothing happens
    for _ in range(400):
        item = int(rng.integers(count))
        if item in items and rng.integers(2) == 0:
            grid.remove(item)
            items.remove(item)
        else:
            size = rng.choice(
                [0.3, 3.0, 2.0 * reach.CELL_M * reach.MAX_CELLS**0.5], p=[0.8, 0.18, 0.02]
            )
            shapes["low"][item] = rng.uniform(-15, 15, 3)
            shapes["high"][item] = shapes["low"][item] + rng.uniform(0, size, 3)
            grid.put(item, shapes["low"][item], shapes["high"][item])
            items.add(item)
    changed = rng.choice(sorted(items), min(8, len(items)), replace=False).astype(np.int64)
    found = grid.pairs(changed, shapes)
    assert set(found[:, 0].tolist()) <= set(changed.tolist())
    expected = {pair for pair in brute_force(items, shapes) if pair & set(changed.tolist())}
    assert {frozenset(pair) for pair in found.tolist()} == expected
