"""RGB-D odometry on frames whose poses are known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.corner_room import INTRINSICS, LEVEL, corner_frame, turned, walk

from deworldsg_ros.config import OdometryConfig
from deworldsg_ros.poses import odometry as odometry_module
from deworldsg_ros.poses.depth_alignment import fit_share, points_of, refine, surface_of
from deworldsg_ros.poses.motion import rigid_motion, rotation_angle_deg
from deworldsg_ros.poses.odometry import LEVEL_CAMERA, RgbdOdometry
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame, check_pose, invert_pose
from deworldsg_ros.scene.errors import RefusedInput

CONFIG = OdometryConfig()


def track(odometry: RgbdOdometry, frame: RgbdFrame) -> np.ndarray:
    return odometry.track(frame.rgb, frame.depth_m, frame.intrinsics)


def lose(odometry: RgbdOdometry, frame: RgbdFrame) -> str:
    with pytest.raises(RefusedInput) as refused:
        track(odometry, frame)
    assert refused.value.reason == "odometry_lost"
    return str(refused.value)


def blind(frame: RgbdFrame) -> RgbdFrame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


@pytest.mark.parametrize("method", ["rgbd", "depth", "without OpenCV's"])
def test_a_walk_is_followed(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if method not in ("rgbd", "depth"):
        monkeypatch.setattr(odometry_module, "HAS_ODOMETRY", False)
        method = "rgbd"
    poses = walk(15)
    odometry = RgbdOdometry(OdometryConfig(method=method), poses[0])
    for T in poses:
        estimate = track(odometry, corner_frame(T))
        check_pose(estimate)
        error = invert_pose(T) @ estimate
        assert np.linalg.norm(error[:3, 3]) < 0.02
        assert rotation_angle_deg(error[:3, :3]) < 0.5
    assert (odometry.tracked, odometry.lost, odometry.restarts) == (15, 0, 0)


def test_a_camera_that_stands_still_does_not_drift() -> None:
    odometry = RgbdOdometry(CONFIG)
    rng = np.random.default_rng(0)
    frame = corner_frame(LEVEL)
    for _ in range(12):
        noise = rng.normal(0, 0.002, frame.depth_m.shape).astype(np.float32)
        estimate = track(odometry, replace(frame, depth_m=frame.depth_m + noise))
    assert np.linalg.norm(estimate[:3, 3]) < 0.005
    assert rotation_angle_deg(LEVEL_CAMERA[:3, :3].T @ estimate[:3, :3]) < 0.1


def test_it_starts_level_or_where_it_is_told() -> None:
    np.testing.assert_array_equal(track(RgbdOdometry(CONFIG), corner_frame(LEVEL)), LEVEL_CAMERA)
    start = turned(30.0, 1.0, 2.0, 3.0)
    np.testing.assert_array_equal(track(RgbdOdometry(CONFIG, start), corner_frame(LEVEL)), start)
    with pytest.raises(RefusedInput, match="pose"):
        RgbdOdometry(CONFIG, np.diag([1.0, 2.0, 1.0, 1.0]))


def test_blind_frames_are_lost_and_the_next_one_is_found_again() -> None:
    poses = walk(6)
    odometry = RgbdOdometry(CONFIG, poses[0])
    for T in poses[:3]:
        track(odometry, corner_frame(T))
    assert "depth" in lose(odometry, blind(corner_frame(poses[3])))
    estimate = track(odometry, corner_frame(poses[4]))
    assert np.linalg.norm(estimate[:3, 3] - poses[4][:3, 3]) < 0.02
    assert (odometry.lost, odometry.restarts) == (1, 0)


def test_the_first_frame_has_to_have_depth() -> None:
    odometry = RgbdOdometry(CONFIG, LEVEL)
    lose(odometry, blind(corner_frame(LEVEL)))
    np.testing.assert_array_equal(track(odometry, corner_frame(LEVEL)), LEVEL)


def test_what_fits_nothing_is_lost_until_it_starts_anew_where_it_was() -> None:
    odometry = RgbdOdometry(OdometryConfig(restart_after=3), LEVEL)
    track(odometry, corner_frame(LEVEL))
    elsewhere = corner_frame(turned(75.0, -0.8))
    for number in (1, 2, 3):
        assert f"frame {number} in a row" in lose(odometry, elsewhere)
    np.testing.assert_array_equal(track(odometry, elsewhere), LEVEL)
    assert (odometry.tracked, odometry.lost, odometry.restarts) == (2, 3, 1)
    np.testing.assert_allclose(track(odometry, elsewhere), LEVEL, atol=5e-3)


def test_other_intrinsics_go_on_from_the_last_pose() -> None:
    odometry = RgbdOdometry(CONFIG, turned(0.0, 1.0))
    track(odometry, corner_frame(LEVEL))
    frame = corner_frame(LEVEL)
    half = Intrinsics(75.0, 75.0, 39.5, 29.5, 80, 60)
    estimate = odometry.track(frame.rgb[::2, ::2], frame.depth_m[::2, ::2], half)
    np.testing.assert_array_equal(estimate, turned(0.0, 1.0))
    assert odometry.restarts == 1


def test_depth_fits_itself_and_not_what_is_elsewhere() -> None:
    depth_m = corner_frame(LEVEL).depth_m
    points = points_of(depth_m, INTRINSICS)
    assert fit_share(points, depth_m, np.eye(4), INTRINSICS) == 1.0
    T = turned(3.0, 0.1)
    moved = corner_frame(T).depth_m
    assert fit_share(points, moved, invert_pose(T) @ LEVEL, INTRINSICS) > 0.95
    assert fit_share(points, moved, np.eye(4), INTRINSICS) < 0.6
    assert fit_share(points, np.zeros_like(depth_m), np.eye(4), INTRINSICS) == 0.0
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert fit_share(points, depth_m, behind, INTRINSICS) == 0.0


def test_a_guess_that_is_off_is_refined_to_the_truth() -> None:
    start, T = turned(20.0, 1.2, -0.8), turned(26.0, 1.28, -0.83)
    truth = invert_pose(T) @ start
    points = points_of(corner_frame(start).depth_m, INTRINSICS)
    surface = surface_of(corner_frame(T).depth_m, INTRINSICS)
    guess = rigid_motion(np.array([0.06, -0.05, 0.04]), np.radians([1.0, -2.0, 1.0])) @ truth
    error = invert_pose(truth) @ refine(points, surface, guess, INTRINSICS)
    assert np.linalg.norm(error[:3, 3]) < 0.01
    assert rotation_angle_deg(error[:3, :3]) < 0.3


def test_a_refinement_without_surfaces_keeps_the_guess() -> None:
    depth_m = corner_frame(LEVEL).depth_m
    points = points_of(depth_m, INTRINSICS)
    nothing = surface_of(np.zeros_like(depth_m), INTRINSICS)
    guess = turned(2.0, 0.1)
    np.testing.assert_array_equal(refine(points, nothing, guess, INTRINSICS), guess)


@pytest.mark.skipif(not odometry_module.HAS_ODOMETRY, reason="OpenCV before 5")
def test_a_camera_that_turns_fast_is_followed() -> None:
    poses = [turned(9.0 * k, 1.2 + 0.03 * k, -0.8 - 0.02 * k) for k in range(5)]
    odometry = RgbdOdometry(CONFIG, poses[0])
    for T in poses:
        error = invert_pose(T) @ track(odometry, corner_frame(T))
        assert np.linalg.norm(error[:3, 3]) < 0.03
        assert rotation_angle_deg(error[:3, :3]) < 1.0
