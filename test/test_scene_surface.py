"""The bounded sample of surface points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from merging_support import seeds

from deworldsg_ros.scene.surface import (
    EMPTY_SAMPLE,
    HashedPoints,
    SurfaceReservoir,
    content_hashes,
    even_moments,
    hash_each,
    merge_samples,
)


def hashed(points: np.ndarray) -> HashedPoints:
    return hash_each((points.astype(np.float32),))[0]


def sample_of(points: np.ndarray, capacity: int) -> HashedPoints:
    return merge_samples(EMPTY_SAMPLE, hashed(points), capacity)


def same(a: HashedPoints, b: HashedPoints) -> bool:
    return np.array_equal(a.hashes, b.hashes) and np.array_equal(a.points_world, b.points_world)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_few_points_are_all_kept(count: int) -> None:
    points = np.random.default_rng(0).normal(size=(count, 3))
    sample = sample_of(points, 3)
    assert sample.points_world.shape == (count, 3)
    assert sample.points_world.dtype == np.float32
    assert sorted(sample.points_world.tolist()) == sorted(points.astype(np.float32).tolist())


@given(seeds, st.integers(0, 20), st.integers(0, 60))
def test_it_is_bounded_and_depends_on_the_set_alone(seed: int, capacity: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    # A coarse grid: many points come more than once.
    points = rng.integers(0, 3, (count, 3)).astype(np.float32) / 7
    whole = sample_of(points, capacity)
    assert len(whole.hashes) == min(capacity, len(np.unique(points, axis=0)))
    assert (np.diff(whole.hashes.astype(object)) > 0).all()
    np.testing.assert_array_equal(content_hashes(whole.points_world), whole.hashes)
    # In any order, in parts, and by way of merged parts.
    shuffled = points[rng.permutation(count)]
    cuts = np.sort(rng.integers(0, count + 1, 2))
    parts = np.split(shuffled, cuts)
    frame_by_frame = SurfaceReservoir(capacity)
    for part in parts:
        frame_by_frame.add(hashed(part))
        if rng.random() < 0.5:  # looking at it changes nothing
            assert len(frame_by_frame.points_world) <= capacity
    assert same(frame_by_frame.sample, whole)
    first, second, third = (sample_of(part, capacity) for part in parts)
    assert same(merge_samples(merge_samples(third, first, capacity), second, capacity), whole)
    assert same(merge_samples(third, merge_samples(second, first, capacity), capacity), whole)
    assert same(merge_samples(whole, whole, capacity), whole)


def test_hashes_depend_on_values_and_axes() -> None:
    points = np.array([[1, 2, 3], [3, 2, 1], [0, 0, 0], [1, 2, 3]], np.float32)
    hashes = content_hashes(points)
    assert hashes[0] == hashes[3]
    assert len(set(hashes.tolist())) == 3
    assert content_hashes(-np.zeros((1, 3), np.float32)) == hashes[2]
    assert len(content_hashes(np.zeros((0, 3), np.float32))) == 0


def test_the_draw_is_uniform_over_the_surface() -> None:
    grid = np.stack(np.meshgrid(np.arange(100), np.arange(100), [0]), -1).reshape(-1, 3)
    kept = sample_of(grid.astype(np.float32) * np.float32(0.01), 1000).points_world
    quarters = np.histogram2d(kept[:, 0], kept[:, 1], bins=2)[0]
    assert (np.abs(quarters - 250) < 60).all()


def test_each_set_of_a_frame_is_hashed_alike() -> None:
    rng = np.random.default_rng(1)
    sets = tuple(rng.normal(size=(count, 3)).astype(np.float32) for count in (4, 0, 7))
    for points, together in zip(sets, hash_each(sets)):
        assert same(together, hashed(points))
    assert hash_each(()) == []


def test_some_points_are_points_of_the_surface() -> None:
    rng = np.random.default_rng(5)
    reservoir = SurfaceReservoir(20)
    assert reservoir.some_points(8).shape == (0, 3)
    known: set[tuple[float, ...]] = set()
    for count in (3, 30, 10):
        points = rng.normal(size=(count, 3)).astype(np.float32)
        known |= set(map(tuple, points.tolist()))
        reservoir.add(hash_each((points,))[0])
        some = reservoir.some_points(8)
        assert len(some) == min(8, len(known))
        assert set(map(tuple, some.tolist())) <= known
    assert len(reservoir.points_world) == 20


def test_even_moments_lean_less_to_where_points_are_dense() -> None:
    rng = np.random.default_rng(8)
    plate = rng.uniform((-0.3, -0.2, 0.0), (0.3, 0.2, 0.001), (4000, 3))
    looked_at_long = rng.uniform((0.2, -0.2, 0.0), (0.3, 0.2, 0.001), (20_000, 3))
    points = np.concatenate((plate, looked_at_long)).astype(np.float32)
    assert points.mean(axis=0)[0] > 0.15
    mean, covariance = even_moments(points)
    assert 0.0 < mean[0] < 0.75 * points.mean(axis=0)[0]
    assert np.abs(mean[1:]).max() < 0.005
    assert np.sqrt(covariance[1, 1]) == pytest.approx(0.4 / 12**0.5, rel=0.1)
    assert np.array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_even_moments_of_one_point() -> None:
    mean, covariance = even_moments(np.full((1, 3), 1.005, np.float32))
    assert np.allclose(mean, 1.005)
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_even_moments_move_with_the_world_frame() -> None:
    rng = np.random.default_rng(9)
    points = rng.uniform(-0.2, 0.2, (300, 3)) * (1, 1, 0.1)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    mean, covariance = even_moments(points.astype(np.float32))
    moved = even_moments((points @ rotation.T + (1, 2, 3)).astype(np.float32))
    assert np.allclose(moved[0], rotation @ mean + (1, 2, 3), atol=1e-3)
    assert np.allclose(moved[1], rotation @ covariance @ rotation.T, atol=1e-4)
