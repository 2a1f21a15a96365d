"""Shapes of nodes and features of pairs, against slow and obvious references."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.room_nodes import bowl, box, surface, table, thing

from deworldsg_ros.relations.geometry import (
    FEATURES,
    LAYER_M,
    MARGIN_M,
    SHAPE_POINTS,
    SOFT_RADIUS_M,
    TRIM_FRACTION,
    NodeShapes,
    pair_features,
    rotation_to_upright,
    upright,
)
from deworldsg_ros.relations.reach import REACH_M

seeds = st.integers(0, 10_000)
up_components = st.floats(-1, 1, allow_subnormal=False)
# Features of heights over the floor alone.
OVER_FLOOR = ("bottom_over_floor_m", "object_bottom_over_floor_m")


class Clouds(NodeShapes):
    """Shapes of clouds of points, with the ids 1, 2, … and the points (n, K, 3)."""

    points: np.ndarray


def shapes_of(*clouds: np.ndarray, R: np.ndarray | None = None) -> Clouds:
    shapes = Clouds()
    shapes.extend(range(1, len(clouds) + 1))
    counts = np.array([len(points) for points in clouds], np.int64)
    shapes.points = np.zeros((len(clouds), max(counts, default=0), 3), np.float32)
    for row, points in enumerate(clouds):
        shapes.points[row, : len(points)] = points
    R = np.eye(3) if R is None else R
    rows = np.arange(len(clouds))
    shapes.put(rows, shapes.points, counts, rows, R)
    shapes.points = upright(shapes.points, R)
    return shapes


def features_of(shapes: Clouds, pairs: np.ndarray, floor_m: float = 0.0) -> np.ndarray:
    """Features (m, F) of ordered pairs; those of the opposite direction are compared as well."""
    columns = (shapes.low, shapes.high, shapes.means, shapes.covariances, shapes.counts)
    first, second = np.ascontiguousarray(pairs.T)
    there, back = pair_features(first, second, *columns, shapes.points, floor_m)
    again, reverse = pair_features(second, first, *columns, shapes.points, floor_m)
    np.testing.assert_allclose(back, again, atol=1e-12)
    np.testing.assert_allclose(there, reverse, atol=1e-12)
    return there


def named(shapes: Clouds, floor_m: float = 0.0) -> dict[str, float]:
    """Features of the first two shapes by name."""
    row = features_of(shapes, np.array([[0, 1]]), floor_m)[0]
    return dict(zip(FEATURES, row.tolist()))


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


def reference(shapes: Clouds, a: int, b: int, floor_m: float) -> dict[str, float]:
    """The features by name, a definition a line."""
    (low_a, low_b), (high_a, high_b) = shapes.low[[a, b]], shapes.high[[a, b]]
    points_a, points_b = (shapes.points[r, : shapes.counts[r]].astype(float) for r in (a, b))
    overlap = np.minimum(high_a, high_b) - np.maximum(low_a, low_b)
    footprints = [np.prod(np.maximum((high - low)[:2], 0.01)) for low, high in
                  ((low_a, high_a), (low_b, high_b))]  # fmt: skip
    shared = np.prod(np.maximum(overlap[:2], 0))
    offset = shapes.means[a] - shapes.means[b]
    spread = shapes.covariances[a] + shapes.covariances[b] + 1e-4 * np.eye(3)
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
    corner, size = low[:2] - MARGIN_M, (high - low)[:2] + 2 * MARGIN_M
    z, bottom = points[:, 2], low[2]
    off = np.maximum(np.maximum(corner - points[:, :2], points[:, :2] - corner - size), 0)
    radii = (off**2).sum(axis=1) / SOFT_RADIUS_M**2
    weights = np.where(radii < 9.0, np.exp(-radii), 0.0)
    weights *= (bottom - z > -0.05) & (bottom - z < 0.3)
    around = (off == 0).all(axis=1)
    layer = around & (np.abs(z - bottom) < LAYER_M)
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
        "level_fraction": (np.abs(z - bottom) < LAYER_M).mean(),
    }


def enclosure(low, high, points) -> float:
    middle = (low + high)[:2] / 2
    beside = points[(points[:, 2] >= low[2] + 0.02) & (points[:, 2] <= high[2] + 0.1), :2] - middle
    reach = REACH_M / 2 + (high - low)[:2].max() / 2
    beside = beside[(beside**2).sum(axis=1) < reach**2]
    turns = np.arctan2(beside[:, 1], beside[:, 0]) / (2 * np.pi) + 0.5
    return len(set(np.minimum(8 - 1, (8 * turns).astype(int)).tolist())) / 8


def within(points, low, high, margin_m) -> np.ndarray:
    return ((points > low - margin_m) & (points < high + margin_m)).all(axis=1)


def distance(points_a, points_b) -> float:
    distances = np.linalg.norm(points_a[:, None] - points_b[None], axis=2)
    return float(distances.min(initial=1.0))


# --- features ------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_features_equal_those_of_the_reference(seed: int) -> None:
    shapes = shapes_of(*random_clouds(seed))
    pairs = every_pair(len(shapes))
    found = features_of(shapes, pairs, -0.7)
    assert found.shape == (len(pairs), len(FEATURES))
    for (a, b), row in zip(pairs.tolist(), found):
        expected = reference(shapes, a, b, -0.7)
        assert tuple(expected) == FEATURES
        for name, value in zip(FEATURES, row.tolist()):
            assert value == pytest.approx(expected[name], rel=1e-6, abs=1e-6), name


def test_no_pairs() -> None:
    shapes = shapes_of(*random_clouds(0))
    assert features_of(shapes, every_pair(0)).shape == (0, len(FEATURES))


@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_features_do_not_depend_on_where_the_room_is(seed: int) -> None:
    clouds = random_clouds(seed)
    offset = np.random.default_rng(seed).integers(-3, 4, 3).astype(float)
    pairs = every_pair(len(clouds))
    here = features_of(shapes_of(*clouds), pairs)
    there = features_of(shapes_of(*(points + offset for points in clouds)), pairs, offset[2])
    np.testing.assert_allclose(here, there, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(seed=seeds, quarters=st.integers(1, 3))
def test_features_do_not_depend_on_where_north_is(seed: int, quarters: int) -> None:
    clouds = random_clouds(seed)
    turn = np.linalg.matrix_power(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), quarters)
    pairs = every_pair(len(clouds))
    here = features_of(shapes_of(*clouds), pairs)
    there = features_of(shapes_of(*(points @ turn.T for points in clouds)), pairs)
    np.testing.assert_allclose(here, there, atol=1e-6)


@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_features_do_not_depend_on_which_axis_of_the_world_is_up(seed: int) -> None:
    clouds = random_clouds(seed)
    R = rotation_to_upright(np.array([0.0, 1.0, 0.0]))
    pairs = every_pair(len(clouds))
    here = features_of(shapes_of(*clouds), pairs)
    there = features_of(shapes_of(*(points @ R for points in clouds), R=R), pairs)
    np.testing.assert_allclose(here, there, atol=1e-5)


def cloud(*parts, seed: int = 0) -> np.ndarray:
    return surface(parts, np.random.default_rng(seed))


def test_a_cup_on_a_table() -> None:
    shapes = shapes_of(cloud(box(0.3, 0.1, 0.74, 0.09, 0.09, 0.1)), cloud(*table(0, 0).parts))
    seen = named(shapes)
    assert seen["gap_m"] == 0 and seen["covered"] == 1 and seen["covers"] < 0.02
    assert seen["overlap_small_m"] == pytest.approx(0.09, abs=0.02)
    assert abs(seen["bottom_to_surface_m"]) < 0.02
    assert abs(seen["soft_bottom_to_surface_m"]) < 0.02
    assert seen["higher"] == 0 and seen["ring_points"] > np.log(3)
    assert seen["bottom_over_floor_m"] == pytest.approx(0.74, abs=0.02)
    assert seen["bottom_over_top_m"] == pytest.approx(0, abs=0.02)
    assert seen["inside"] < 0.3 and seen["enclosed"] == 0
    assert seen["distance_m"] < 0.05


def test_an_orange_in_a_bowl() -> None:
    shapes = shapes_of(
        cloud(box(0.0, 0.0, 0.02, 0.07, 0.07, 0.07)), cloud(*bowl(0.0, 0.0, 0.0).parts)
    )
    seen = named(shapes)
    assert seen["enclosed"] == 1
    assert seen["inside"] > 0.6 and seen["around"] < 0.1 and seen["covered"] == 1


def test_a_bottle_far_from_a_refrigerator() -> None:
    bottle = thing("bottle", 0.3, 0.25, 0.74, 0.075, 0.075, 0.3)
    fridge = thing("refrigerator", 3.4, 0.0, 0.0, 0.66, 0.7, 1.76)
    seen = named(shapes_of(cloud(*bottle.parts), cloud(*fridge.parts)))
    assert seen["gap_m"] == pytest.approx(2.73, abs=0.03) and seen["distance_m"] == 1.0
    assert seen["covered"] == seen["ring"] == seen["inside"] == seen["enclosed"] == 0
    assert seen["bottom_to_surface_m"] == 1.0 and seen["soft_bottom_to_surface_m"] == 0.3


# --- shapes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 7, 300, 700])
def test_the_shape_of_points(count: int) -> None:
    points = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    shapes = shapes_of(points)
    used = points[:SHAPE_POINTS]
    assert shapes.counts[0] == len(used)
    np.testing.assert_array_equal(shapes.points[0, : len(used)], used)
    if not count:
        return
    np.testing.assert_allclose(shapes.means[0], used.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(
        shapes.covariances[0],
        np.cov(used.T, bias=True).reshape(3, 3) if count > 1 else 0,
        atol=1e-6,
    )
    assert (shapes.low[0] <= shapes.high[0]).all()


@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_bounds_of_an_even_surface_are_those_of_the_object(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.1, 1.0, 3)
    points = rng.uniform(-0.5, 0.5, (512, 3)) * size
    shapes = shapes_of(points)
    np.testing.assert_allclose(shapes.high[0, :2], size[:2] / 2, atol=0.03)
    np.testing.assert_allclose(shapes.low[0, :2], -size[:2] / 2, atol=0.03)
    assert -size[2] / 2 <= shapes.low[0, 2] <= shapes.high[0, 2] <= size[2] / 2


def test_a_few_points_off_the_object_do_not_change_its_bounds() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.2, 0.2, (500, 3))
    flying = points.copy()
    flying[: int(TRIM_FRACTION * 500) - 2] += [3.0, -2.0, 2.5]
    clean, dirty = shapes_of(points), shapes_of(flying)
    np.testing.assert_allclose(dirty.low, clean.low, atol=0.02)
    np.testing.assert_allclose(dirty.high, clean.high, atol=0.02)


def test_a_shape_that_is_put_again_forgets_the_old_one() -> None:
    clouds = random_clouds(3)
    shapes = shapes_of(clouds[0], clouds[1])
    points = clouds[2].astype(np.float32)
    row = np.array([0])
    shapes.put(row, points[None], np.array([len(points)]), row, np.eye(3))
    shapes.points = np.zeros((2, 50, 3), np.float32)
    for row, cloud in enumerate((points, clouds[1])):
        shapes.points[row, : len(cloud)] = cloud
    fresh = shapes_of(clouds[2], clouds[1])
    pairs = every_pair(2)
    np.testing.assert_array_equal(features_of(shapes, pairs), features_of(fresh, pairs))


# --- the upright frame ---------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.tuples(up_components, up_components, up_components))
def test_the_upright_frame_is_a_rotation_that_makes_up_z(up: tuple[float, float, float]) -> None:
    up_world = np.array(up)
    length = np.linalg.norm(up_world)
    if length < 1e-3:
        return
    R = rotation_to_upright(up_world)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R @ up_world / length, [0, 0, 1], atol=0.02)
    if up_world[2] / length > -0.9999:
        np.testing.assert_allclose(R @ up_world / length, [0, 0, 1], atol=1e-9)
        # It is the smallest one: its angle is that between up and z.
        assert (np.trace(R) - 1) / 2 == pytest.approx(up_world[2] / length, abs=1e-9)


@pytest.mark.parametrize("up", [(0, 0, -1), (1e-9, 0, -1), (0.01, -0.01, -1), (0, 0.1, -1)])
def test_a_world_whose_z_axis_points_down(up: tuple[float, float, float]) -> None:
    up_world = np.array(up) / np.linalg.norm(up)
    R = rotation_to_upright(up_world)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R @ up_world, [0, 0, 1], atol=0.02)


def test_a_world_whose_z_axis_points_up_is_upright() -> None:
    np.testing.assert_array_equal(rotation_to_upright(np.array([0.0, 0.0, 2.0])), np.eye(3))
