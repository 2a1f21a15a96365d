"""Shapes, features of pairs, and what is in reach, against slow and obvious references."""

import itertools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from deworldsg_ros.relations import geometry
from deworldsg_ros.relations.geometry import REACH_M
from deworldsg_ros.relations.states import SHAPE

seeds = st.integers(0, 10_000)
up_components = st.floats(-1, 1, allow_subnormal=False)


class Clouds(NamedTuple):
    """Clouds of points, in the upright frame, with their shapes."""

    shapes: np.ndarray
    points: np.ndarray

    def of(self, place: int) -> np.ndarray:
        return self.points[place, : self.shapes["count"][place]].astype(float)


def clouds_of(*clouds: np.ndarray, R: np.ndarray | None = None) -> Clouds:
    R = np.eye(3) if R is None else R
    counts = np.array([len(points) for points in clouds], np.int64)
    shapes = np.zeros(len(clouds), SHAPE)
    points = np.zeros((len(clouds), max(counts, default=0), 3), np.float32)
    for place, cloud in enumerate(clouds):
        points[place, : len(cloud)] = cloud
    geometry.measure(shapes, np.arange(len(clouds)), points, counts, R)
    return Clouds(shapes, geometry.upright(points, R))


def features_of(clouds: Clouds, pairs: np.ndarray, floor_m: float = 0.0) -> np.ndarray:
    """Features (m, F) of ordered pairs; those of the opposite direction are compared as well."""
    first, second = np.ascontiguousarray(pairs.T)
    there, back = geometry.pair_features(first, second, *clouds, floor_m)
    again, reverse = geometry.pair_features(second, first, *clouds, floor_m)
    np.testing.assert_allclose(back, again, atol=1e-12)
    np.testing.assert_allclose(there, reverse, atol=1e-12)
    return there


def every_pair(count: int) -> np.ndarray:
    return np.array(list(itertools.permutations(range(count), 2)), np.int64).reshape(-1, 2)


def random_clouds(seed: int, count: int = 4) -> list[np.ndarray]:
    """Boxes of points on, in and beside one another, on a grid of 1/1024 m."""
    rng = np.random.default_rng(seed)
    clouds = []
    for _ in range(count):
        size = np.exp(rng.uniform(np.log(0.05), np.log(0.8), 3))
        middle = rng.uniform(-0.4, 0.4, 3)
        points = rng.uniform(-0.5, 0.5, (int(rng.integers(10, 45)), 3)) * size + middle
        clouds.append(np.round(points * 1024) / 1024)
    # The bottom of the second one is near the top of the first one.
    clouds[1][:, 2] += clouds[0][:, 2].max() - clouds[1][:, 2].min() + rng.uniform(-0.02, 0.02)
    clouds[1] = np.round(clouds[1] * 1024) / 1024
    return clouds


# --- the reference -------------------------------------------------------------------------------


def reference(clouds: Clouds, a: int, b: int, floor_m: float) -> dict[str, float]:
    """The features by name, a definition a line."""
    shapes = clouds.shapes[[a, b]]
    (low_a, low_b), (high_a, high_b) = shapes["low"], shapes["high"]
    points_a, points_b = clouds.of(a), clouds.of(b)
    overlap = np.minimum(high_a, high_b) - np.maximum(low_a, low_b)
    footprints = [np.prod(np.maximum((high - low)[:2], 0.01)) for low, high in
                  ((low_a, high_a), (low_b, high_b))]  # fmt: skip
    shared = np.prod(np.maximum(overlap[:2], 0))
    offset = shapes["mean"][0] - shapes["mean"][1]
    spread = shapes["covariance"].sum(axis=0) + 1e-4 * np.eye(3)
    sizes_a, sizes_b = log_sizes(low_a, high_a), log_sizes(low_b, high_b)
    return {
        "gap_m": float(np.hypot(*np.maximum(-overlap[:2], 0))),
        "overlap_small_m": overlap[:2].min(),
        "overlap_large_m": overlap[:2].max(),
        "overlap_up_m": overlap[2],
        "covered": min(1.0, shared / footprints[0]),
        "covers": min(1.0, shared / footprints[1]),
        **contact(low_a, high_a, low_b, high_b, points_b),
        "enclosed": enclosure(low_a, high_a, points_b),
        "encloses": enclosure(low_b, high_b, points_a),
        "inside": within(points_a, low_b, high_b, 0.01).mean(),
        "around": within(points_b, low_a, high_a, 0.01).mean(),
        "distance_m": distance(
            points_a[within(points_a, low_b, high_b, 0.15)],
            points_b[within(points_b, low_a, high_a, 0.15)],
        ),
        "mahalanobis": float(np.sqrt(offset @ np.linalg.inv(spread) @ offset)),
        "bottom_over_bottom_m": low_a[2] - low_b[2],
        "top_over_top_m": high_a[2] - high_b[2],
        "bottom_over_top_m": low_a[2] - high_b[2],
        "top_over_bottom_m": high_a[2] - low_b[2],
        "bottom_over_floor_m": low_a[2] - floor_m,
        "object_bottom_over_floor_m": low_b[2] - floor_m,
        **dict(zip(("log_length", "log_width", "log_height"), sizes_a)),
        **dict(zip(("object_log_length", "object_log_width", "object_log_height"), sizes_b)),
        "log_length_ratio": sizes_a[0] - sizes_b[0],
        "log_points": np.log(len(points_a)),
        "object_log_points": np.log(len(points_b)),
    }


def log_sizes(low, high) -> list[float]:
    length, width = sorted((high - low)[:2], reverse=True)
    return [np.log(max(size, 0.01)) for size in (length, width, (high - low)[2])]


def contact(low, high, low_b, high_b, points) -> dict[str, float]:
    """The points of an object around the bottom of a subject (low, high)."""
    corner, size = low[:2] - geometry.MARGIN_M, (high - low)[:2] + 2 * geometry.MARGIN_M
    z, bottom = points[:, 2], low[2]
    off = np.maximum(np.maximum(corner - points[:, :2], points[:, :2] - corner - size), 0)
    radii = (off**2).sum(axis=1) / geometry.SOFT_RADIUS_M**2
    weights = np.where(radii < 9.0, np.exp(-radii), 0.0)
    weights *= (bottom - z > -0.05) & (bottom - z < 0.3)
    around = (off == 0).all(axis=1)
    layer = around & (np.abs(z - bottom) < geometry.LAYER_M)
    below = z[around & (z < bottom + 0.025)]
    cells = np.minimum(7, (8 * (points[layer, :2] - corner) / size).astype(int))
    area_b = np.prod(np.maximum((high_b - low_b)[:2], 0.01))
    possible = np.clip(len(points) * np.prod(size) / area_b, 8, 64)
    return {
        "bottom_to_surface_m": min(1.0, bottom - below.max()) if len(below) else 1.0,
        "ring": min(1.0, len({tuple(cell) for cell in cells}) / possible),
        "ring_points": np.log(1 + layer.sum()),
        "higher": (around & ~layer & (z > bottom)).sum() / max(1, around.sum()),
        "lower": (around & ~layer & (z <= bottom)).sum() / max(1, around.sum()),
        "surface_spread_m": z[layer].std() if layer.sum() > 1 else 0.0,
        "soft_bottom_to_surface_m": (
            (weights * (bottom - z)).sum() / weights.sum() if weights.sum() > 1e-3 else 0.3
        ),
        "soft_points": np.log(1 + weights.sum()),
        "level_fraction": (np.abs(z - bottom) < geometry.LAYER_M).mean(),
    }


def enclosure(low, high, points) -> float:
    middle = (low + high)[:2] / 2
    beside = points[(points[:, 2] >= low[2] + 0.02) & (points[:, 2] <= high[2] + 0.1), :2] - middle
    reach = REACH_M / 2 + (high - low)[:2].max() / 2
    beside = beside[(beside**2).sum(axis=1) < reach**2]
    x, y = beside.T
    return len(set(zip(x >= 0, y >= 0, np.abs(y) >= np.abs(x)))) / 8


def within(points, low, high, margin_m) -> np.ndarray:
    return ((points > low - margin_m) & (points < high + margin_m)).all(axis=1)


def distance(points_a, points_b) -> float:
    distances = np.linalg.norm(points_a[:, None] - points_b[None], axis=2)
    return float(distances.min(initial=1.0))


# --- features ------------------------------------------------------------------------------------


@given(seed=seeds)
def test_features_equal_those_of_the_reference(seed: int) -> None:
    clouds = clouds_of(*random_clouds(seed))
    pairs = every_pair(len(clouds.shapes))
    found = features_of(clouds, pairs, -0.7)
    assert found.shape == (len(pairs), len(geometry.FEATURES))
    for (a, b), row in zip(pairs.tolist(), found):
        expected = reference(clouds, a, b, -0.7)
        assert tuple(expected) == geometry.FEATURES
        for name, value in zip(geometry.FEATURES, row.tolist()):
            assert value == pytest.approx(expected[name], rel=1e-6, abs=1e-6), name
    assert features_of(clouds, every_pair(0)).shape == (0, len(geometry.FEATURES))
    middle = (clouds.shapes["low"] + clouds.shapes["high"])[:, :2] / 2
    steps = np.linalg.norm(middle[pairs[:, 0]] - middle[pairs[:, 1]], axis=1)
    np.testing.assert_allclose(geometry.centre_steps(clouds.shapes, *pairs.T), steps, rtol=1e-12)


def outlines_of(points) -> np.ndarray:
    """The shapes of points (n, K, 3)."""
    shapes = np.zeros(len(points), SHAPE)
    counts = np.full(len(points), points.shape[1])
    geometry.measure(shapes, np.arange(len(points)), points, counts, np.eye(3))
    return shapes


@given(seed=seeds)
def test_the_gap_of_outlines_lies_between_those_of_bounds_and_of_convex_hulls(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(2, 20, 3)).astype(np.float32)  # so few that none is cut off
    points[1] += rng.uniform(-8, 8, 3)
    one, other = outlines_of(points)[:, None]
    found = geometry.plan_gaps(one, other).item()
    assert found == geometry.plan_gaps(other, one).item()
    angles = np.linspace(0, 2 * np.pi, 3600)
    along = points[..., :2] @ np.array([np.cos(angles), np.sin(angles)])
    hull = float((along[1].min(axis=0) - along[0].max(axis=0)).max())
    apart = np.maximum(one["low"] - other["high"], other["low"] - one["high"])[0, :2]
    least = np.linalg.norm(np.maximum(apart, 0)) if found > 0 else apart.max()
    assert least <= found <= hull + 1e-3


def test_squares_that_stand_askew_are_apart() -> None:
    steps = np.linspace(-0.5, 0.5, 11)
    square = np.stack([*np.meshgrid(steps, steps), np.zeros((11, 11))], axis=-1).reshape(-1, 3)
    turn = np.array([[1, -1, 0], [1, 1, 0], [0, 0, 2**0.5]]) / 2**0.5
    points = np.stack([square, square + [1.2, 0, 0]]) @ turn.T
    one, other = outlines_of(points.astype(np.float32))[:, None]
    assert (one["high"] > other["low"])[0, :2].all()
    assert geometry.plan_gaps(one, other).item() == pytest.approx(0.2, abs=0.05)


# --- shapes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 7, 300, 700])
def test_the_shape_of_points(count: int) -> None:
    points = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    (shape,) = clouds_of(points).shapes
    used = points[: geometry.SHAPE_POINTS]
    assert shape["count"] == len(used)
    if count:
        spread = np.cov(used.T, bias=True).reshape(3, 3) if count > 1 else 0
        np.testing.assert_allclose(shape["mean"], used.mean(axis=0), atol=1e-6)
        np.testing.assert_allclose(shape["covariance"], spread, atol=1e-6)
        assert (shape["low"] <= shape["high"]).all()


def test_a_few_points_off_the_object_do_not_change_its_bounds() -> None:
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (500, 3))
    flying = points.copy()
    flying[: int(geometry.TRIM_FRACTION * 500) - 2] += [3.0, -2.0, 2.5]
    clean, dirty = clouds_of(points, flying).shapes
    np.testing.assert_allclose(dirty["low"], clean["low"], atol=0.02)
    np.testing.assert_allclose(dirty["high"], clean["high"], atol=0.02)


# --- the upright frame ---------------------------------------------------------------------------


@given(st.tuples(up_components, up_components, up_components))
@example((0.0, 0.0, 2.0))
@example((0.0, 0.0, -1.0))
@example((1e-9, 0.0, -1.0))
@example((0.01, -0.01, -1.0))
def test_the_upright_frame_is_the_smallest_rotation_that_makes_up_z(up) -> None:
    up_world = np.array(up)
    length = np.linalg.norm(up_world)
    if length < 1e-3:
        return
    R = geometry.rotation_to_upright(up_world)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R @ up_world / length, [0, 0, 1], atol=0.02)
    if up_world[2] / length > -0.9999:
        np.testing.assert_allclose(R @ up_world / length, [0, 0, 1], atol=1e-9)
        # Its angle is that between up and z.
        assert (np.trace(R) - 1) / 2 == pytest.approx(up_world[2] / length, abs=1e-9)


# --- objects in reach ----------------------------------------------------------------------------


def shapes_of(low: np.ndarray, high: np.ndarray, counts: np.ndarray | int = 99) -> np.ndarray:
    shapes = np.zeros(len(low), SHAPE)
    shapes["low"], shapes["high"], shapes["count"] = low, high, counts
    return shapes


def are_in_reach(a: np.void, b: np.void) -> bool:
    gap = np.maximum(a["low"], b["low"]) - np.minimum(a["high"], b["high"])
    over = (gap[:2] <= geometry.BESIDE_REACH_M).all()
    solid = min(a["count"], b["count"]) >= geometry.MIN_SHAPE_POINTS
    level_m = geometry.OVER_REACH_M if over else geometry.BESIDE_REACH_M
    return bool(solid and (gap[:2] <= geometry.REACH_M).all() and gap[2] <= level_m)


def brute_force(items: Iterable[int], shapes: np.ndarray) -> set[frozenset[int]]:
    pairs = itertools.combinations(items, 2)
    return {frozenset((a, b)) for a, b in pairs if are_in_reach(shapes[a], shapes[b])}


@given(seed=seeds, count=st.integers(0, 9))
def test_pairs_in_reach_are_those_of_brute_force(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(-1.5, 1.5, (count, 3))
    counts = rng.integers(geometry.MIN_SHAPE_POINTS - 2, 3 * geometry.MIN_SHAPE_POINTS, count)
    shapes = shapes_of(low, low + rng.uniform(0, 0.6, (count, 3)), counts)
    found, expected = geometry.pairs_in_reach(shapes), brute_force(range(count), shapes)
    assert found.shape == (len(expected), 2)
    assert {frozenset(pair) for pair in found.tolist()} == expected
    every = np.array(list(itertools.permutations(range(count), 2)), np.int64).reshape(-1, 2)
    assert geometry.in_reach(every, shapes).tolist() == [
        are_in_reach(*shapes[pair]) for pair in every
    ]


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_a_grid_that_follows_finds_all_pairs(seed: int) -> None:
    """Objects of all sizes come, move and go."""
    rng = np.random.default_rng(seed)
    count = 150
    shapes = shapes_of(np.zeros((count, 3)), np.zeros((count, 3)))
    grid, items = geometry.ReachGrid(), set()
    grid.remove(7)  # not known: nothing happens
    for _ in range(400):
        item = int(rng.integers(count))
        if item in items and rng.integers(2) == 0:
            grid.remove(item)
            items.remove(item)
        else:
            size = rng.choice(
                [0.3, 3.0, 2.0 * geometry.CELL_M * geometry.MAX_CELLS**0.5], p=[0.8, 0.18, 0.02]
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
