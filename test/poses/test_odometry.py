"""RGB-D odometry on frames with exactly known poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.corner_room import INTRINSICS, LEVEL, camera_at, corner_frame, walk

from deworldsg_ros.poses.odometry import (
    HAS_ODOMETRY,
    LEVEL_CAMERA,
    RgbdOdometry,
    fit_fraction,
    points_of,
    refine,
    surface_of,
)
from deworldsg_ros.scene.camera import (
    Intrinsics,
    RgbdFrame,
    check_pose,
    invert_pose,
    rigid_motion,
    rotation_angle_deg,
)
from deworldsg_ros.scene.errors import RefusedInput


def track(odometry: RgbdOdometry, frame: RgbdFrame) -> np.ndarray:
    return odometry.track(frame.rgb, frame.depth_m, frame.intrinsics)


def lose(odometry: RgbdOdometry, frame: RgbdFrame) -> str:
    with pytest.raises(RefusedInput) as refused:
        track(odometry, frame)
    assert refused.value.reason == "odometry_lost"
    return str(refused.value)


def without_depth(frame: RgbdFrame) -> RgbdFrame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


@pytest.mark.parametrize("depth_only", sorted({not HAS_ODOMETRY, True}))
def test_a_walking_camera_is_tracked(depth_only: bool) -> None:
    poses = walk(15)
    odometry = RgbdOdometry(poses[0], depth_only=depth_only)
    for T in poses:
        estimate = track(odometry, corner_frame(T))
        check_pose(estimate)
        error = invert_pose(T) @ estimate
        assert np.linalg.norm(error[:3, 3]) < 0.02
        assert rotation_angle_deg(error[:3, :3]) < 0.5
    assert (odometry.tracked, odometry.lost, odometry.restarts) == (15, 0, 0)


def test_a_camera_that_stands_still_does_not_drift() -> None:
    odometry = RgbdOdometry()
    rng = np.random.default_rng(0)
    frame = corner_frame(LEVEL)
    for _ in range(12):
        noise = rng.normal(0, 0.002, frame.depth_m.shape).astype(np.float32)
        estimate = track(odometry, replace(frame, depth_m=frame.depth_m + noise))
    assert np.linalg.norm(estimate[:3, 3]) < 0.005
    assert rotation_angle_deg(LEVEL_CAMERA[:3, :3].T @ estimate[:3, :3]) < 0.1


def test_the_first_pose_is_level_or_the_given_one() -> None:
    np.testing.assert_array_equal(track(RgbdOdometry(), corner_frame(LEVEL)), LEVEL_CAMERA)
    start = camera_at(30.0, 1.0, 2.0, 3.0)
    np.testing.assert_array_equal(track(RgbdOdometry(start), corner_frame(LEVEL)), start)
    with pytest.raises(RefusedInput, match="pose"):
        RgbdOdometry(np.diag([1.0, 2.0, 1.0, 1.0]))


def test_tracking_continues_after_a_frame_without_depth() -> None:
    poses = walk(6)
    odometry = RgbdOdometry(poses[0])
    for T in poses[:3]:
        track(odometry, corner_frame(T))
    assert "depth" in lose(odometry, without_depth(corner_frame(poses[3])))
    estimate = track(odometry, corner_frame(poses[4]))
    assert np.linalg.norm(estimate[:3, 3] - poses[4][:3, 3]) < 0.02
    assert (odometry.lost, odometry.restarts) == (1, 0)


def test_the_first_frame_needs_depth() -> None:
    odometry = RgbdOdometry(LEVEL)
    lose(odometry, without_depth(corner_frame(LEVEL)))
    np.testing.assert_array_equal(track(odometry, corner_frame(LEVEL)), LEVEL)


def test_tracking_restarts_at_the_last_pose_after_several_lost_frames() -> None:
    odometry = RgbdOdometry(LEVEL, restart_after=3)
    track(odometry, corner_frame(LEVEL))
    elsewhere = corner_frame(camera_at(75.0, -0.8))
    for number in (1, 2, 3):
        assert f"lost frame {number} in a row" in lose(odometry, elsewhere)
    np.testing.assert_array_equal(track(odometry, elsewhere), LEVEL)
    assert (odometry.tracked, odometry.lost, odometry.restarts) == (2, 3, 1)
    np.testing.assert_allclose(track(odometry, elsewhere), LEVEL, atol=5e-3)


def test_new_intrinsics_continue_from_the_last_pose() -> None:
    odometry = RgbdOdometry(camera_at(0.0, 1.0))
    track(odometry, corner_frame(LEVEL))
    frame = corner_frame(LEVEL)
    half = Intrinsics(75.0, 75.0, 39.5, 29.5, 80, 60)
    estimate = odometry.track(frame.rgb[::2, ::2], frame.depth_m[::2, ::2], half)
    np.testing.assert_array_equal(estimate, camera_at(0.0, 1.0))
    assert odometry.restarts == 1


def test_depth_fits_itself_and_no_other_view() -> None:
    depth_m = corner_frame(LEVEL).depth_m
    points = points_of(depth_m, INTRINSICS)
    assert fit_fraction(points, depth_m, np.eye(4), INTRINSICS) == 1.0
    T = camera_at(3.0, 0.1)
    moved = corner_frame(T).depth_m
    assert fit_fraction(points, moved, invert_pose(T) @ LEVEL, INTRINSICS) > 0.95
    assert fit_fraction(points, moved, np.eye(4), INTRINSICS) < 0.6
    assert fit_fraction(points, np.zeros_like(depth_m), np.eye(4), INTRINSICS) == 0.0
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert fit_fraction(points, depth_m, behind, INTRINSICS) == 0.0


def test_a_wrong_guess_is_refined() -> None:
    start, T = camera_at(20.0, 1.2, -0.8), camera_at(26.0, 1.28, -0.83)
    truth = invert_pose(T) @ start
    points = points_of(corner_frame(start).depth_m, INTRINSICS)
    surface = surface_of(corner_frame(T).depth_m, INTRINSICS)
    guess = rigid_motion(np.array([0.06, -0.05, 0.04]), np.radians([1.0, -2.0, 1.0])) @ truth
    error = invert_pose(truth) @ refine(points, surface, guess, INTRINSICS)
    assert np.linalg.norm(error[:3, 3]) < 0.01
    assert rotation_angle_deg(error[:3, :3]) < 0.3


def test_refinement_without_surfaces_keeps_the_guess() -> None:
    depth_m = corner_frame(LEVEL).depth_m
    points = points_of(depth_m, INTRINSICS)
    no_surface = surface_of(np.zeros_like(depth_m), INTRINSICS)
    guess = camera_at(2.0, 0.1)
    np.testing.assert_array_equal(refine(points, no_surface, guess, INTRINSICS), guess)


@pytest.mark.skipif(not HAS_ODOMETRY, reason="OpenCV before 5")
def test_a_fast_rotation_is_tracked() -> None:
    poses = [camera_at(9.0 * k, 1.2 + 0.03 * k, -0.8 - 0.02 * k) for k in range(5)]
    odometry = RgbdOdometry(poses[0])
    for T in poses:
        error = invert_pose(T) @ track(odometry, corner_frame(T))
        assert np.linalg.norm(error[:3, 3]) < 0.03
        assert rotation_angle_deg(error[:3, :3]) < 1.0
