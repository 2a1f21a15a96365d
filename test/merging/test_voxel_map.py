"""The surface map against plain sets of cells, and its properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deworldsg_ros.merging.cell_kernels import MIN_OWNER_CELLS
from deworldsg_ros.merging.surface_map import VoxelMap

seeds = st.integers(0, 10**6)
CELL_M = 0.05


def cells_of(points: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(cell) for cell in np.floor(points.astype(np.float64) / CELL_M).astype(int)}


def neighbourhood(cell: tuple[int, ...]) -> list[tuple[int, ...]]:
    steps = [(0, 0, 0)] + [
        tuple(sign if axis == k else 0 for k in range(3)) for axis in range(3) for sign in (1, -1)
    ]
    return [tuple(c + s for c, s in zip(cell, step)) for step in steps]


def reference_overlaps(
    seen: set[tuple[int, ...]], known: set[tuple[int, ...]]
) -> tuple[float, float]:
    on_owner = sum(any(cell in known for cell in neighbourhood(c)) for c in seen)
    met = {cell for c in seen for cell in neighbourhood(c)} & known
    if not on_owner:
        return 0.0, 0.0
    return on_owner / len(seen), len(met) / len(known) if len(known) >= MIN_OWNER_CELLS else 0.0


def dense(owners: list[int], on: np.ndarray, of: np.ndarray, owner_count: int) -> np.ndarray:
    """Both overlap fractions (2, n, owner_count), including owners that no set meets."""
    assert (on > 0).any(axis=0).all()
    result = np.zeros((2, len(on), owner_count))
    result[:, :, owners] = on, of
    return result


def random_points(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(-0.3, 0.3, (count, 3)).astype(np.float32)


@given(seeds)
@settings(max_examples=30)
def test_overlaps_equal_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    surfaces = VoxelMap(CELL_M)
    known: list[set[tuple[int, ...]]] = [set() for _ in range(3)]  # a cell has room for four
    for _ in range(8):
        owner = int(rng.integers(3))
        points = random_points(rng, int(rng.integers(0, 20)))
        surfaces.add([owner], surfaces.cells_of([points]))
        known[owner] |= cells_of(points)
    sets = [random_points(rng, int(rng.integers(0, 30))) for _ in range(4)]
    overlaps = dense(*surfaces.overlaps(surfaces.cells_of(sets)), 3)
    for row, points in enumerate(sets):
        for owner in range(3):
            expected = reference_overlaps(cells_of(points), known[owner])
            assert overlaps[:, row, owner] == pytest.approx(expected, abs=1e-12)
    for owner in range(3):
        assert len(surfaces.centres(owner)) == len(known[owner])


def test_sets_without_points_overlap_nothing() -> None:
    surfaces = VoxelMap(CELL_M)
    surfaces.add([], surfaces.cells_of([]))
    assert surfaces.overlaps(surfaces.cells_of([]))[1].shape == (0, 0)
    empty = surfaces.cells_of([np.zeros((0, 3), np.float32)])
    surfaces.add([0], empty)
    assert surfaces.overlaps(empty)[1].shape == (1, 0)


def test_growing_keeps_all_cells_and_a_removed_owner_has_none() -> None:
    rng = np.random.default_rng(1)
    surfaces = VoxelMap(0.01, cells_per_owner=100_000)
    sets = surfaces.cells_of([rng.uniform(-5, 5, (30_000, 3)) for _ in range(2)])
    surfaces.add([0, 1], sets)
    assert surfaces.overlaps(sets)[1].diagonal().tolist() == [1.0, 1.0]
    count = len(surfaces.centres(0))
    removed = surfaces.remove(0)
    assert len(surfaces.centres(0)) == 0
    after = dense(*surfaces.overlaps(sets), 2)[0]
    assert after[0, 0] == after[1, 0] == 0.0
    assert after[1, 1] == 1.0
    surfaces.add([2], removed)
    assert len(surfaces.centres(2)) == count
    assert dense(*surfaces.overlaps(sets), 3)[0, 0].tolist() == [0.0, after[0, 1], 1.0]


def test_the_number_of_cells_of_an_owner_is_limited() -> None:
    surfaces = VoxelMap(0.01, cells_per_owner=50)
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    surfaces.add([0], surfaces.cells_of([points]))
    assert len(surfaces.centres(0)) == 50


def test_points_beyond_the_map_are_ignored() -> None:
    surfaces = VoxelMap(0.01)
    points = np.array([[1e9, 0, 0], [0, -1e9, 0], [0, 0, 0]], np.float32)
    surfaces.add([0], surfaces.cells_of([points]))
    assert surfaces.centres(0) == pytest.approx(np.full((1, 3), 0.005))


def test_removed_owners_take_no_room() -> None:
    rng = np.random.default_rng(0)
    surfaces = VoxelMap(CELL_M)
    capacity = surfaces.capacity
    for _ in range(1000):
        cells = surfaces.cells_of([random_points(rng, 20) + rng.uniform(-9, 9, 3).astype("f4")])
        surfaces.add([0], cells)
        surfaces.remove(0)
    assert surfaces.capacity == capacity
