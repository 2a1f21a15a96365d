"""Intrinsics, poses, the up direction and RGB-D frames: round trips and refusals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.merging import random_pose, seeds

from deworldsg_ros.scene import camera
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput

GOOD = {"fx": 500.0, "fy": 510.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}
NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("shape", [(0,), (5,), (2, 3)])
def test_projection_is_the_inverse_of_back_projection(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    pinhole = camera.Intrinsics(**GOOD)
    assert pinhole.matrix.tolist() == [[500, 0, 319.5], [0, 510, 239.5], [0, 0, 1]]
    u, v, z = rng.uniform(0, 640, shape), rng.uniform(0, 480, shape), rng.uniform(0.1, 9, shape)
    points = pinhole.back_project(u, v, z)
    assert points.shape == (*shape, 3)
    homogeneous = np.stack([u, v, np.ones(shape)], axis=-1)
    expected = z[..., None] * (homogeneous @ np.linalg.inv(pinhole.matrix).T)
    np.testing.assert_allclose(points, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(pinhole.project(points), np.stack([u, v], axis=-1), rtol=1e-12)


@given(seeds, st.floats(0, 1))
def test_poses_there_and_back(seed: int, fraction: float) -> None:
    rng = np.random.default_rng(seed)
    T, T_b = random_pose(rng), random_pose(rng)
    camera.check_pose(T)
    np.testing.assert_allclose(camera.invert_pose(T) @ T, np.eye(4), atol=1e-12)
    quat = camera.quaternion_from_rotation(T[:3, :3])
    assert quat[3] >= 0 and np.linalg.norm(quat) == pytest.approx(1)
    # A quaternion and its negative are one rotation; a little off unit is forgiven.
    for same in (quat, -1.004 * quat):
        np.testing.assert_allclose(camera.pose_from_quaternion(T[:3, 3], same), T, atol=1e-12)
    np.testing.assert_allclose(camera.interpolate_pose(T, T_b, 0.0), T, atol=1e-9)
    np.testing.assert_allclose(camera.interpolate_pose(T, T_b, 1.0), T_b, atol=1e-9)
    np.testing.assert_allclose(camera.interpolate_pose(T, T, fraction), T, atol=1e-9)
    between = camera.interpolate_pose(T, T_b, fraction)
    camera.check_pose(between)
    np.testing.assert_allclose(between, camera.interpolate_pose(T_b, T, 1.0 - fraction), atol=1e-7)


@pytest.mark.parametrize("axis", [None, 0, 1, 2])
def test_half_turns(axis: int | None) -> None:
    quat = np.eye(4)[3 if axis is None else axis]
    diagonal = np.ones(3) if axis is None else np.where(np.arange(3) == axis, 1.0, -1.0)
    T = camera.pose_from_quaternion(np.zeros(3), quat)
    np.testing.assert_allclose(T[:3, :3], np.diag(diagonal), atol=1e-15)
    assert abs(camera.quaternion_from_rotation(np.diag(diagonal)) @ quat) == pytest.approx(1)


def quaternion(*values: float, x: float = 0.0) -> None:
    camera.pose_from_quaternion(np.array([x, 0.0, 0.0]), np.array(values))


def rgbd(**changes: object) -> camera.RgbdFrame:
    parts = {
        "stamp_ns": 1,
        "rgb": np.zeros((480, 640, 3), np.uint8),
        "depth_m": np.zeros((480, 640), np.float32),
        "intrinsics": camera.Intrinsics(**GOOD),
        "T_world_camera": np.eye(4),
    }
    return camera.RgbdFrame(**{**parts, **changes})


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: camera.Intrinsics(**{**GOOD, "fx": 0.0}), "invalid_intrinsics"),
        (lambda: camera.Intrinsics(**{**GOOD, "fy": -1.0}), "invalid_intrinsics"),
        (lambda: camera.Intrinsics(**{**GOOD, "fx": NAN}), "invalid_intrinsics"),
        (lambda: camera.Intrinsics(**{**GOOD, "cx": INF}), "invalid_intrinsics"),
        (lambda: camera.Intrinsics(**{**GOOD, "width": 0}), "invalid_intrinsics"),
        (lambda: camera.Intrinsics(**{**GOOD, "height": -3}), "invalid_intrinsics"),
        (lambda: quaternion(0, 0, 0, 0), "invalid_pose"),
        (lambda: quaternion(0, 0, 0, 1.1), "invalid_pose"),
        (lambda: quaternion(0, 0, NAN, 1), "invalid_pose"),
        (lambda: quaternion(0, 0, 0, 1, x=INF), "invalid_pose"),
        (lambda: camera.check_pose(np.eye(3)), "invalid_pose"),
        (lambda: camera.check_pose(np.full((4, 4), NAN)), "invalid_pose"),
        (lambda: camera.check_pose(np.diag([2.0, 1, 1, 1])), "invalid_pose"),
        (lambda: camera.check_pose(np.diag([-1.0, 1, 1, 1])), "invalid_pose"),
        (lambda: rgbd(rgb=np.zeros((240, 320, 3), np.uint8)), "grid_mismatch"),
        (lambda: rgbd(rgb=np.zeros((480, 640), np.uint8)), "grid_mismatch"),
        (lambda: rgbd(depth_m=np.zeros((480, 320), np.float32)), "grid_mismatch"),
        (lambda: rgbd(depth_m=np.zeros(7, np.float32)), "grid_mismatch"),
        (lambda: rgbd(T_world_camera=np.zeros((4, 4))), "invalid_pose"),
    ],
)
def test_what_is_refused(make, reason: str) -> None:
    assert rgbd().frame_id == "world"
    with pytest.raises(RefusedInput) as refused:
        make()
    assert refused.value.reason == reason


# --- the up direction ----------------------------------------------------------------------------


def level_pose(up: np.ndarray, yaw: float, pitch: float) -> np.ndarray:
    """A camera whose image rows are orthogonal to `up`, without roll; it looks at `pitch`."""
    seed = np.eye(3)[np.abs(up).argmin()]
    east = np.cross(seed, up) / np.linalg.norm(np.cross(seed, up))
    north = np.cross(up, east)
    ahead = np.cos(yaw) * east + np.sin(yaw) * north
    pose = np.eye(4)
    pose[:3, 0] = np.cross(ahead, up)
    pose[:3, 2] = np.cos(pitch) * ahead + np.sin(pitch) * up
    pose[:3, 1] = np.cross(pose[:3, 2], pose[:3, 0])
    return pose


def poses(seed: int, count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    up = rng.normal(size=3)
    up /= np.linalg.norm(up)
    return [level_pose(up, rng.uniform(0, 6), rng.uniform(-0.6, 0.3)) for _ in range(count)]


@given(seed=seeds, before=st.integers(0, 6), after=st.integers(0, 6))
def test_a_restored_estimator_continues_equally(seed: int, before: int, after: int) -> None:
    seen = poses(seed, before + after)
    whole, again = camera.UpEstimator(), camera.UpEstimator()
    for pose in seen[:before]:
        whole.observe(pose)
    for pose in poses(seed + 1, 3):  # this is forgotten
        again.observe(pose)
    state = whole.state()
    kept = state.copy()
    again.restore(state)
    for pose in [None, *seen[before:]]:
        if pose is not None:
            whole.observe(pose)
            again.observe(pose)
        np.testing.assert_array_equal(again.up_world(), whole.up_world())
        np.testing.assert_array_equal(again.state(), whole.state())
    np.testing.assert_array_equal(state, kept)  # the state itself is not changed
    if not seen:
        np.testing.assert_array_equal(whole.up_world(), [0, 0, 1])


def test_up_is_found_from_level_cameras() -> None:
    up = np.array([0.6, -0.8, 0.0])
    estimator = camera.UpEstimator()
    for yaw in np.linspace(0, 5, 9):
        estimator.observe(level_pose(up, yaw, -0.3))
    np.testing.assert_allclose(estimator.up_world(), up, atol=0.02)


@pytest.mark.parametrize(
    "state",
    [
        np.zeros(0),
        np.zeros(12),
        np.zeros((13, 1)),
        np.zeros(15),
        np.full(14, 0.5),
        np.full(13, np.nan),
        np.array([-1.0] + [0] * 12),
    ],
)
def test_another_state_is_refused(state: np.ndarray) -> None:
    estimator = camera.UpEstimator()
    estimator.observe(np.eye(4))
    before = estimator.state()
    with pytest.raises(ValueError, match="up direction"):
        estimator.restore(state)
    np.testing.assert_array_equal(estimator.state(), before)


@pytest.mark.parametrize(
    ("axis", "up"), [("x", [1, 0, 0]), ("-x", [-1, 0, 0]), ("-y", [0, -1, 0]), ("-z", [0, 0, -1])]
)
def test_a_named_axis_is_used_as_given(axis: str, up: list[int]) -> None:
    estimator = camera.UpEstimator(axis)
    for pose in poses(2, 4):
        estimator.observe(pose)
    np.testing.assert_array_equal(estimator.up_world(), up)


def test_an_unknown_axis_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="world_up 'up'"):
        camera.UpEstimator("up")
