"""Gravity-aligned boxes, and surface points as bytes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deworldsg_ros.graph.extent import (
    box_of,
    even_moments,
    horizontal_axes,
    rounded,
    surface_bytes,
    surface_points,
)
from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.messages import Stamp

UPS = ([0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.1, 0.2, 0.95])


def shell(rng: np.random.Generator, count: int, size: np.ndarray) -> np.ndarray:
    """Points (count, 3) on the faces of a box around the origin."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    return points * size


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("heading", [0.0, 0.3, 1.2])
def test_a_box_is_found_in_every_world(up, heading) -> None:
    rng = np.random.default_rng(1)
    size = np.array([0.6, 0.3, 0.9])
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ horizontal_axes(up)
    points = shell(rng, 512, size) @ turn + [1.0, 2.0, 3.0]
    box = box_of(points.astype(np.float32), up)
    assert sorted(box.size_m) == pytest.approx(sorted(size), abs=0.02)
    assert box.center_m == pytest.approx([1.0, 2.0, 3.0], abs=0.01)
    rotation = pose_from_quaternion(np.zeros(3), np.array(box.orientation_xyzw))[:3, :3]
    assert rotation[:, 2] == pytest.approx(np.array(up) / np.linalg.norm(up), abs=1e-3)
    inside = np.abs((points - box.center_m) @ rotation) <= np.array(box.size_m) / 2 + 2e-3
    assert inside.all(axis=1).mean() > 0.98


def test_stray_points_do_not_grow_a_box() -> None:
    rng = np.random.default_rng(2)
    points = shell(rng, 500, np.array([0.3, 0.3, 0.3]))
    stray = rng.uniform(-1, 1, (10, 3)) + [2.0, 0.0, 0.0]
    box = box_of(np.concatenate([points, stray]), (0.0, 0.0, 1.0))
    assert max(box.size_m) < 0.5


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_few_points_have_a_box(count: int) -> None:
    points = np.arange(3.0 * count).reshape(count, 3)
    box = box_of(points, (0.0, 0.0, 1.0))
    assert box.size_m[2] == pytest.approx(3.0 * (count - 1))


def node(mean: list[float], **fields: object) -> wire.NodeState:
    return wire.NodeState(1, "cup", [], mean, [0.0] * 9, 1, Stamp(0, 0), Stamp(0, 0), **fields)  # type: ignore[arg-type]


@given(st.integers(0, 50), st.integers(0, 2**32))
def test_points_survive_as_bytes_to_the_millimetre(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-50, 50, 3).round(3).tolist()
    points = (mean + rng.normal(0, 1, (count, 3))).astype(np.float32)
    state = node(mean, surface_mm=surface_bytes(points, mean))
    sent = wire.msgspec.json.decode(wire.msgspec.json.encode(state), type=wire.NodeState)
    assert surface_points(sent) == pytest.approx(points, abs=6e-4)


def test_points_of_version_1_and_broken_bytes() -> None:
    assert surface_points(node([0.0] * 3)).shape == (0, 3)
    assert surface_points(node([0.0] * 3, surface_points_m=[[1.0, 2.0, 3.0]])).tolist() == [
        [1.0, 2.0, 3.0]
    ]
    assert surface_points(node([0.0] * 3, surface_mm=b"12345")).shape == (0, 3)
    far = np.array([[40.0, 0.0, 0.0], [1.0, 0.0, 0.0]], np.float32)
    assert len(surface_points(node([0.0] * 3, surface_mm=surface_bytes(far, [0.0] * 3)))) == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_points_that_no_kernel_may_see_are_refused(bad: float) -> None:
    points = np.array([[0.0, 0.0, 0.0], [bad, 0.0, 0.0]])
    with pytest.raises(ValueError, match="points contain"):
        box_of(points, (0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="points contain"):
        even_moments(points)
    with pytest.raises(ValueError, match="without points"):
        box_of(np.zeros((0, 3)), (0.0, 0.0, 1.0))


def test_points_at_nearly_one_place_have_a_box() -> None:
    points = np.array([[0.0, 0.0, 0.0], [5e-324, 0.0, 0.0], [0.0, 5e-324, 0.0]])
    assert box_of(points, (0.0, 0.0, 1.0)).size_m == [0.0, 0.0, 0.0]
    assert even_moments(points)[0].tolist() == [0.0, 0.0, 0.0]


def test_rounding_has_no_negative_zero() -> None:
    assert str(rounded(np.array([-1e-9, 0.12345]), 3)) == "[0.0, 0.123]"
