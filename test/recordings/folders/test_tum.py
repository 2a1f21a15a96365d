"""TUM RGB-D folders."""

import numpy as np
import pytest
from support.recordings import STEP_NS, TUM_T0_NS, pose, rgb_pixels, write_tum

from deworldsg_ros.config import Config, InputsConfig
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.posing import PoseChoice, choose_poses
from deworldsg_ros.recordings.recording import Recording, open_recording, open_source
from deworldsg_ros.recordings.source import Role
from deworldsg_ros.scene.camera import interpolate_pose
from deworldsg_ros.scene.errors import RecordingError

COUNT = 4


def frames_of(path, inputs=None, **options):
    recording = open_recording(path, inputs, options=DatasetOptions(**options))
    return list(recording.frames()), recording


@pytest.mark.parametrize(
    ("name", "fx", "cy"),
    [
        ("rgbd_dataset_freiburg1_desk", 517.3, 255.3),
        ("rgbd_dataset_freiburg2_xyz", 520.9, 249.7),
        ("fr3_office", 535.4, 247.6),
    ],
)
def test_frames_are_associated_and_the_camera_is_known_by_name(tmp_path, name, fx, cy):
    frames, recording = frames_of(write_tum(tmp_path / name))
    assert len(frames) == COUNT
    assert not recording.drops
    for index, frame in enumerate(frames):
        assert frame.stamp_ns == TUM_T0_NS + index * STEP_NS
        assert (frame.intrinsics.fx, frame.intrinsics.cy) == (fx, cy)
        np.testing.assert_array_equal(frame.rgb, rgb_pixels(index))
        np.testing.assert_allclose(frame.depth_m[1:], 1.0 + 0.01 * index, atol=5e-4)
        assert not frame.depth_m[0].any()
        between = interpolate_pose(pose(index - 0.3), pose(index + 0.2), 0.6)
        np.testing.assert_allclose(frame.T_world_camera, between, atol=1e-6)


def test_what_is_too_far_in_time_drops_the_frame(tmp_path):
    folder = write_tum(tmp_path / "fr1", depth_offset_ns=30_000_000)
    frames, recording = frames_of(folder)
    assert not frames
    assert recording.drops["no_depth"] == COUNT
    assert len(frames_of(folder, InputsConfig(slop_s=0.05))[0]) == COUNT
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(lines[:6]))
    frames, recording = frames_of(folder, InputsConfig(slop_s=0.05))
    assert 0 < len(frames) < COUNT
    assert recording.drops["no_pose"] == COUNT - len(frames)


def test_an_unknown_camera_is_refused_with_a_request_for_intrinsics(tmp_path):
    folder = write_tum(tmp_path / "my_office")
    with pytest.raises(RecordingError, match="--intrinsics"):
        open_recording(folder)
    given = (500.0, 501.0, 30.0, 20.0)
    assert frames_of(folder, intrinsics=given)[0][0].intrinsics.fy == 501.0
    with pytest.raises(RecordingError, match="--rate"):
        frames_of(folder, intrinsics=given, rate_hz=10.0)


@pytest.mark.parametrize("with_poses", [True, False])
def test_the_ground_truth_is_needed_only_for_its_poses(tmp_path, with_poses):
    folder = write_tum(tmp_path / "fr1")
    if not with_poses:
        (folder / "groundtruth.txt").unlink()
    source = open_source(folder, need_poses=False)
    assert (Role.POSE in source.topics) is with_poses
    recording = Recording(choose_poses(source, PoseChoice(odometry=True), Config()))
    assert len(list(recording.frames())) == COUNT
