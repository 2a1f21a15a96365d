"""Perturbed poses: the requested errors, reproducible, and jumps refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.corner_room import corner_frame, walk

from deworldsg_ros.poses.odometry import track_poses
from deworldsg_ros.poses.trajectory import Perturbation, PoseNoise, parse_noise, perturb_poses
from deworldsg_ros.recordings.posing import gate_jumps
from deworldsg_ros.scene.camera import RgbdFrame, check_pose, invert_pose, rotation_angle_deg
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput

STEPS = 400


def line(count: int = STEPS, step_m: float = 0.05) -> list[np.ndarray]:
    """A camera that moves straight ahead."""
    poses = [np.eye(4) for _ in range(count)]
    for index, T in enumerate(poses):
        T[2, 3] = index * step_m
    return poses


def apply(noise: PoseNoise, poses: list[np.ndarray]) -> list[np.ndarray]:
    perturbation = Perturbation(noise)
    return [perturbation.apply(T) for T in poses]


def test_zero_noise_changes_no_pose() -> None:
    for T, same in zip(walk(30), apply(PoseNoise(), walk(30))):
        np.testing.assert_allclose(same, T, atol=1e-12)


@settings(max_examples=20)
@given(
    st.integers(0, 2**31), st.floats(0, 0.1), st.floats(0, 5), st.floats(0, 0.1), st.floats(0, 5)
)
def test_perturbed_poses_are_rigid_and_reproducible(
    seed: int, jitter_m: float, jitter_deg: float, drift_m: float, drift_deg: float
) -> None:
    noise = PoseNoise(jitter_m, jitter_deg, drift_m, drift_deg, 0.1, 2.0, seed)
    one, other = apply(noise, walk(10)), apply(noise, walk(10))
    for T, same in zip(one, other):
        check_pose(T)
        np.testing.assert_array_equal(T, same)


def test_jitter_has_the_configured_size_and_does_not_accumulate() -> None:
    poses = line()
    worse = apply(PoseNoise(jitter_m=0.02, jitter_deg=1.0), poses)
    errors = [invert_pose(T) @ W for T, W in zip(poses, worse)]
    offsets = np.array([E[:3, 3] for E in errors])
    assert offsets.std() == pytest.approx(0.02, rel=0.1)
    assert abs(offsets[-50:].mean()) < 0.01
    angles = np.array([rotation_angle_deg(E[:3, :3]) for E in errors])
    assert math.sqrt((angles**2).mean() / 3) == pytest.approx(1.0, rel=0.1)


@given(st.integers(0, 1000))
@settings(max_examples=10)
def test_drift_grows_with_the_path(seed: int) -> None:
    poses = line()
    path_m = 0.05 * (STEPS - 1)
    straight = apply(PoseNoise(drift_m_per_m=0.03, seed=seed), poses)
    assert np.linalg.norm(straight[-1][:3, 3] - poses[-1][:3, 3]) == pytest.approx(0.03 * path_m)
    turning = apply(PoseNoise(drift_deg_per_m=1.0, seed=seed), poses)
    assert rotation_angle_deg(turning[-1][:3, :3]) == pytest.approx(path_m)
    still = apply(PoseNoise(drift_m_per_m=0.03, drift_deg_per_m=1.0, seed=seed), [poses[7]] * 20)
    np.testing.assert_allclose(still[-1], poses[7], atol=1e-12)


def moving(poses: list[np.ndarray]) -> list[RgbdFrame]:
    return [corner_frame(T, stamp_ns) for stamp_ns, T in enumerate(poses)]


def test_jumps_last_one_frame_and_the_gate_refuses_them() -> None:
    frames = moving(walk(40))
    noise = PoseNoise(jump_probability=0.2, jump_m=3.0, seed=4)
    worse = list(perturb_poses(frames, noise))
    off_m = [
        np.linalg.norm(a.T_world_camera[:3, 3] - b.T_world_camera[:3, 3])
        for a, b in zip(frames, worse)
    ]
    jumped = {index for index, value in enumerate(off_m) if value > 1}
    assert 3 < len(jumped) < 15
    assert all(off_m[index] == pytest.approx(3.0) for index in jumped)
    assert 0 not in jumped
    refusals: list[RefusedInput] = []
    kept = list(gate_jumps(worse, refusals.append))
    assert {frame.stamp_ns for frame in kept} == set(range(40)) - jumped
    assert {refusal.reason for refusal in refusals} == {"pose_jump"}
    assert len(refusals) == len(jumped)


def test_noise_is_parsed_from_text() -> None:
    assert parse_noise("") == PoseNoise()
    noise = parse_noise("jitter_m=0.02,jitter_deg=1,drift_m_per_m=0.01,seed=3")
    assert noise == PoseNoise(0.02, 1.0, 0.01, seed=3)
    for text, message in (
        ("jitter=1", "NAME one of jitter_m"),
        ("jitter_m", "expected NAME=NUMBER"),
        ("jitter_m=a", "expected NAME=NUMBER"),
        ("jitter_m=-1", "jitter_m is -1.0: expected >= 0"),
        ("jitter_m=nan", "jitter_m is nan"),
        ("jump_probability=2", "expected <= 1"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            parse_noise(text)


def test_tracked_frames_have_the_poses_of_the_odometry_and_lost_frames_are_reported() -> None:
    path = walk(5)
    frames = [replace(frame, T_world_camera=np.eye(4)) for frame in moving(path)]
    blank = frames[2]
    frames[2] = replace(blank, depth_m=np.zeros_like(blank.depth_m))
    lost: list[RefusedInput] = []
    tracked = list(track_poses(frames, path[0], lost.append))
    assert [frame.stamp_ns for frame in tracked] == [0, 1, 3, 4]
    for frame in tracked:
        error_m = np.linalg.norm(frame.T_world_camera[:3, 3] - path[frame.stamp_ns][:3, 3])
        assert error_m < 0.02
    assert [refusal.reason for refusal in lost] == ["odometry_lost"]
