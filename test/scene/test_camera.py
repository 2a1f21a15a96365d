"""Intrinsics, poses and RGB-D frames: round trips and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.merging import random_pose, seeds

from deworldsg_ros.scene.camera import (
    Intrinsics,
    RgbdFrame,
    check_pose,
    interpolate_pose,
    invert_pose,
    pose_from_quaternion,
    quaternion_from_rotation,
)
from deworldsg_ros.scene.errors import DeWorldSGError, RefusedInput

GOOD = {"fx": 500.0, "fy": 510.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}


def test_intrinsics_matrix() -> None:
    assert Intrinsics(**GOOD).matrix.tolist() == [[500, 0, 319.5], [0, 510, 239.5], [0, 0, 1]]


@pytest.mark.parametrize("shape", [(0,), (5,), (2, 3)])
def test_projection_is_the_inverse_of_back_projection(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    camera = Intrinsics(**GOOD)
    u, v, z = rng.uniform(0, 640, shape), rng.uniform(0, 480, shape), rng.uniform(0.1, 9, shape)
    points = camera.back_project(u, v, z)
    assert points.shape == (*shape, 3)
    homogeneous = np.stack([u, v, np.ones(shape)], axis=-1)
    expected = z[..., None] * (homogeneous @ np.linalg.inv(camera.matrix).T)
    np.testing.assert_allclose(points, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(camera.project(points), np.stack([u, v], axis=-1), rtol=1e-12)


@pytest.mark.parametrize(
    "bad",
    [
        {"fx": 0.0},
        {"fy": -1.0},
        {"fx": float("nan")},
        {"cx": float("inf")},
        {"width": 0},
        {"height": -3},
    ],
)
def test_bad_intrinsics_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(RefusedInput) as refused:
        Intrinsics(**{**GOOD, **bad})
    assert refused.value.reason == "invalid_intrinsics"
    assert isinstance(refused.value, DeWorldSGError)


@given(seeds)
def test_pose_and_inverse_cancel(seed: int) -> None:
    T = random_pose(np.random.default_rng(seed))
    check_pose(T)
    np.testing.assert_allclose(invert_pose(T) @ T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(invert_pose(invert_pose(T)), T, atol=1e-12)


@given(seeds)
def test_quaternion_round_trip(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = random_pose(rng)
    quat = quaternion_from_rotation(T[:3, :3])
    assert quat[3] >= 0
    assert np.linalg.norm(quat) == pytest.approx(1)
    np.testing.assert_allclose(pose_from_quaternion(T[:3, 3], quat), T, atol=1e-12)
    # A quaternion and its negative are one rotation; a little off unit is forgiven.
    np.testing.assert_allclose(pose_from_quaternion(T[:3, 3], -1.004 * quat), T, atol=1e-12)


@pytest.mark.parametrize(
    ("axis", "quat"),
    [
        (None, [0.0, 0, 0, 1]),
        (0, [1.0, 0, 0, 0]),
        (1, [0.0, 1, 0, 0]),
        (2, [0.0, 0, 1, 0]),
    ],
)
def test_half_turns(axis: int | None, quat: list[float]) -> None:
    diagonal = np.ones(3) if axis is None else np.where(np.arange(3) == axis, 1.0, -1.0)
    T = pose_from_quaternion(np.zeros(3), np.array(quat))
    np.testing.assert_allclose(T[:3, :3], np.diag(diagonal), atol=1e-15)
    back = quaternion_from_rotation(np.diag(diagonal))
    assert abs(back @ quat) == pytest.approx(1)


@pytest.mark.parametrize(
    ("translation", "quat"),
    [
        ([0.0, 0, 0], [0.0, 0, 0, 0]),
        ([0.0, 0, 0], [0.0, 0, 0, 1.1]),
        ([0.0, 0, 0], [0.0, 0, float("nan"), 1]),
        ([float("inf"), 0, 0], [0.0, 0, 0, 1]),
    ],
)
def test_bad_quaternions_are_refused(translation: list[float], quat: list[float]) -> None:
    with pytest.raises(RefusedInput) as refused:
        pose_from_quaternion(np.array(translation), np.array(quat))
    assert refused.value.reason == "invalid_pose"


@pytest.mark.parametrize(
    "T",
    [
        np.eye(3),
        np.full((4, 4), np.nan),
        np.diag([2.0, 1, 1, 1]),
        np.diag([-1.0, 1, 1, 1]),
    ],
)
def test_bad_poses_are_refused(T: np.ndarray) -> None:
    with pytest.raises(RefusedInput) as refused:
        check_pose(T)
    assert refused.value.reason == "invalid_pose"


@given(seeds, st.floats(0, 1))
def test_interpolation_is_rigid_and_meets_the_ends(seed: int, fraction: float) -> None:
    rng = np.random.default_rng(seed)
    T_a, T_b = random_pose(rng), random_pose(rng)
    np.testing.assert_allclose(interpolate_pose(T_a, T_b, 0.0), T_a, atol=1e-9)
    np.testing.assert_allclose(interpolate_pose(T_a, T_b, 1.0), T_b, atol=1e-9)
    np.testing.assert_allclose(interpolate_pose(T_a, T_a, fraction), T_a, atol=1e-9)
    between = interpolate_pose(T_a, T_b, fraction)
    check_pose(between)
    np.testing.assert_allclose(between, interpolate_pose(T_b, T_a, 1.0 - fraction), atol=1e-7)


def frame_parts() -> dict:
    return {
        "stamp_ns": 1,
        "rgb": np.zeros((480, 640, 3), np.uint8),
        "depth_m": np.zeros((480, 640), np.float32),
        "intrinsics": Intrinsics(**GOOD),
        "T_world_camera": np.eye(4),
    }


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ({"rgb": np.zeros((240, 320, 3), np.uint8)}, "grid_mismatch"),
        ({"rgb": np.zeros((480, 640), np.uint8)}, "grid_mismatch"),
        ({"depth_m": np.zeros((480, 320), np.float32)}, "grid_mismatch"),
        ({"depth_m": np.zeros(7, np.float32)}, "grid_mismatch"),
        ({"T_world_camera": np.zeros((4, 4))}, "invalid_pose"),
    ],
)
def test_frames_are_checked(bad: dict, reason: str) -> None:
    assert RgbdFrame(**frame_parts()).frame_id == "world"
    with pytest.raises(RefusedInput) as refused:
        RgbdFrame(**{**frame_parts(), **bad})
    assert refused.value.reason == reason
