"""RGB-D odometry on frames with exactly known poses, and poses that are perturbed on purpose."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.corner_room import LEVEL, camera_at, corner_frame, walk

from deworldsg_ros.poses.loops import LoopOdometry, track_poses
from deworldsg_ros.poses.odometry import LEVEL_CAMERA, RgbdOdometry
from deworldsg_ros.poses.trajectory import Perturbation, PoseNoise, parse_noise, perturb_poses
from deworldsg_ros.recordings.posing import gate_jumps
from deworldsg_ros.scene.camera import Intrinsics, check_pose, invert_pose, rotation_angle_deg
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput


def track(odometry, frame):
    return odometry.track(frame.rgb, frame.depth_m, frame.intrinsics)


def track_all(frames, T_world_start):
    """The poses of frames by odometry with a map; their stamps may be equal."""
    odometry = LoopOdometry(T_world_start)
    return [
        odometry.track(stamp_ns, frame.rgb, frame.depth_m, frame.intrinsics)[0]
        for stamp_ns, frame in enumerate(frames)
    ]


def lose(odometry, frame):
    with pytest.raises(RefusedInput) as refused:
        track(odometry, frame)
    assert refused.value.reason == "odometry_lost"
    return str(refused.value)


def without_depth(frame):
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


def assert_near(T, truth, shift_m, turn_deg):
    check_pose(T)
    error = invert_pose(truth) @ T
    assert np.linalg.norm(error[:3, 3]) < shift_m
    assert rotation_angle_deg(error[:3, :3]) < turn_deg


@pytest.mark.parametrize("is_black", [False, True])
def test_a_walking_camera_is_tracked(is_black):
    poses = walk(15)
    frames = [corner_frame(T) for T in poses]
    for frame in frames:
        frame.rgb[:] *= not is_black
    for estimate, T in zip(track_all(frames, poses[0]), poses):
        assert_near(estimate, T, 0.02, 0.5)


def test_a_fast_rotation_is_tracked():
    poses = [camera_at(9.0 * k, 1.2 + 0.03 * k, -0.8 - 0.02 * k) for k in range(5)]
    frames = [corner_frame(T, is_tiled=True) for T in poses]
    for estimate, T in zip(track_all(frames, poses[0]), poses):
        assert_near(estimate, T, 0.05, 1.0)


def test_a_camera_that_stands_still_does_not_drift():
    rng = np.random.default_rng(0)
    frame = corner_frame(LEVEL)
    noise_m = rng.normal(0, 0.002, (12, *frame.depth_m.shape)).astype(np.float32)
    frames = [replace(frame, depth_m=frame.depth_m + noise) for noise in noise_m]
    assert_near(track_all(frames, None)[-1], LEVEL_CAMERA, 0.005, 0.1)


def test_the_first_pose_is_level_or_the_given_one():
    np.testing.assert_array_equal(track(RgbdOdometry(), corner_frame(LEVEL)), LEVEL_CAMERA)
    start = camera_at(30.0, 1.0, 2.0, 3.0)
    odometry = RgbdOdometry(start)
    # The first frame needs depth.
    lose(odometry, without_depth(corner_frame(LEVEL)))
    np.testing.assert_array_equal(track(odometry, corner_frame(LEVEL)), start)
    with pytest.raises(RefusedInput, match="pose"):
        RgbdOdometry(np.diag([1.0, 2.0, 1.0, 1.0]))


def test_tracking_continues_after_a_frame_without_depth():
    path = walk(5)
    frames = [replace(corner_frame(T, k), T_world_camera=np.eye(4)) for k, T in enumerate(path)]
    frames[2] = without_depth(frames[2])
    lost = []
    tracked = list(track_poses(frames, path[0], lost.append))
    assert [frame.stamp_ns for frame in tracked] == [0, 1, 3, 4]
    for frame in tracked:
        assert_near(frame.T_world_camera, path[frame.stamp_ns], 0.02, 0.5)
    assert [refusal.reason for refusal in lost] == ["odometry_lost"]
    assert "depth" in str(lost[0])


def test_tracking_restarts_at_the_last_pose_after_several_lost_frames():
    odometry = RgbdOdometry(LEVEL, restart_after=3)
    track(odometry, corner_frame(LEVEL))
    elsewhere = corner_frame(camera_at(75.0, -0.8))
    for number in (1, 2, 3):
        assert f"lost frame {number} in a row" in lose(odometry, elsewhere)
    np.testing.assert_array_equal(track(odometry, elsewhere), LEVEL)
    assert (odometry.tracked, odometry.lost, odometry.restarts) == (2, 3, 1)
    np.testing.assert_allclose(track(odometry, elsewhere), LEVEL, atol=5e-3)


def test_new_intrinsics_continue_from_the_last_pose():
    odometry = RgbdOdometry(camera_at(0.0, 1.0))
    frame = corner_frame(LEVEL)
    track(odometry, frame)
    half = Intrinsics(75.0, 75.0, 39.5, 29.5, 80, 60)
    estimate = odometry.track(frame.rgb[::2, ::2], frame.depth_m[::2, ::2], half)
    np.testing.assert_array_equal(estimate, camera_at(0.0, 1.0))
    assert odometry.restarts == 1


STEPS, STEP_M = 400, 0.05


def line():
    """A camera that moves straight ahead."""
    poses = np.tile(np.eye(4), (STEPS, 1, 1))
    poses[:, 2, 3] = STEP_M * np.arange(STEPS)
    return poses


def apply(noise, poses):
    perturbation = Perturbation(noise)
    return [perturbation.apply(T) for T in poses]


SIZES = st.tuples(st.floats(0, 0.1), st.floats(0, 5), st.floats(0, 0.1), st.floats(0, 5))


@settings(max_examples=20)
@given(st.integers(0, 2**31), SIZES)
def test_perturbed_poses_are_rigid_and_reproducible(seed, sizes):
    noise = PoseNoise(*sizes, 0.1, 2.0, seed)
    one, other = apply(noise, walk(10)), apply(noise, walk(10))
    for T, same in zip(one, other):
        check_pose(T)
        np.testing.assert_array_equal(T, same)
    np.testing.assert_allclose(apply(PoseNoise(), walk(10)), walk(10), atol=1e-12)


def test_jitter_has_the_configured_size_and_does_not_accumulate():
    worse = apply(PoseNoise(jitter_m=0.02, jitter_deg=1.0), line())
    errors = np.array([invert_pose(T) @ W for T, W in zip(line(), worse)])
    offsets = errors[:, :3, 3]
    assert offsets.std() == pytest.approx(0.02, rel=0.1)
    assert abs(offsets[-50:].mean()) < 0.01
    angles = np.array([rotation_angle_deg(E[:3, :3]) for E in errors])
    assert math.sqrt((angles**2).mean() / 3) == pytest.approx(1.0, rel=0.1)


@given(st.integers(0, 1000))
@settings(max_examples=10)
def test_drift_grows_with_the_path(seed):
    poses = line()
    path_m = STEP_M * (STEPS - 1)
    straight = apply(PoseNoise(drift_m_per_m=0.03, seed=seed), poses)
    assert np.linalg.norm(straight[-1][:3, 3] - poses[-1][:3, 3]) == pytest.approx(0.03 * path_m)
    turning = apply(PoseNoise(drift_deg_per_m=1.0, seed=seed), poses)
    assert rotation_angle_deg(turning[-1][:3, :3]) == pytest.approx(path_m)
    still = apply(PoseNoise(drift_m_per_m=0.03, drift_deg_per_m=1.0, seed=seed), [poses[7]] * 20)
    np.testing.assert_allclose(still[-1], poses[7], atol=1e-12)


def test_jumps_last_one_frame_and_the_gate_refuses_them():
    frames = [corner_frame(T, stamp_ns) for stamp_ns, T in enumerate(walk(40))]
    worse = list(perturb_poses(frames, PoseNoise(jump_probability=0.2, jump_m=3.0, seed=4)))
    off_m = np.array([np.linalg.norm((a.T_world_camera - b.T_world_camera)[:3, 3])
                      for a, b in zip(frames, worse)])  # fmt: skip
    jumped = set(np.flatnonzero(off_m > 1).tolist())
    assert 3 < len(jumped) < 15 and 0 not in jumped
    np.testing.assert_allclose(off_m[sorted(jumped)], 3.0)
    refusals = []
    kept = list(gate_jumps(worse, refusals.append))
    assert {frame.stamp_ns for frame in kept} == set(range(40)) - jumped
    assert [refusal.reason for refusal in refusals] == ["pose_jump"] * len(jumped)


def test_noise_is_parsed_from_text():
    assert parse_noise("") == PoseNoise()
    noise = parse_noise("jitter_m=0.02,jitter_deg=1,drift_m_per_m=0.01,seed=3")
    assert noise == PoseNoise(0.02, 1.0, 0.01, seed=3)
    for text, message in (
        ("jitter=1", "'jitter=1'.*jitter_m"),
        ("jitter_m", "NAME=NUMBER"),
        ("jitter_m=-1", "jitter_m is -1.0"),
        ("jitter_m=nan", "jitter_m is nan"),
        ("jump_probability=2", "jump_probability is 2"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            parse_noise(text)
