"""TUM RGB-D folders."""

from __future__ import annotations

import numpy as np
import pytest
from support.recordings import HEIGHT, WIDTH, encoded, pose, rgb_pixels

from deworldsg_ros.config import Config, InputsConfig
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.posing import PoseChoice, choose_poses
from deworldsg_ros.recordings.recording import Recording, detect_kind, open_recording, open_source
from deworldsg_ros.recordings.source import Role
from deworldsg_ros.scene.camera import interpolate_pose, quaternion_from_rotation
from deworldsg_ros.scene.errors import RecordingError

COUNT = 4
T0_NS = 1305031102175304000
STEP_NS = 100_000_000


def text_of(time_ns):
    return f"{time_ns // 10**9}.{time_ns % 10**9:09d}"


def write_tum(folder, depth_offset_ns=5_000_000, pose_step_ns=50_000_000):
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    rgb_lines = ["# color images", "# timestamp filename"]
    depth_lines = ["# depth maps"]
    for index in range(COUNT):
        time_ns = T0_NS + index * STEP_NS
        bgr = np.ascontiguousarray(rgb_pixels(index)[:, :, ::-1])
        (folder / "rgb" / f"{index}.png").write_bytes(encoded(bgr))
        depth = np.full((HEIGHT, WIDTH), 5000 + 50 * index, np.uint16)
        depth[0] = 0
        (folder / "depth" / f"{index}.png").write_bytes(encoded(depth))
        rgb_lines.append(f"{text_of(time_ns)} rgb/{index}.png")
        depth_lines.append(f"{text_of(time_ns + depth_offset_ns)} depth/{index}.png")
    pose_lines = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    # Poses are not at the times of the images.
    for number in range(-1, 2 * COUNT + 2):
        time_ns = T0_NS + number * pose_step_ns + 20_000_000
        T = pose((time_ns - T0_NS) / STEP_NS)
        values = [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])]
        pose_lines.append(f"{text_of(time_ns)} " + " ".join(f"{v:.9f}" for v in values))
    for name, lines in (("rgb", rgb_lines), ("depth", depth_lines), ("groundtruth", pose_lines)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


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
    folder = write_tum(tmp_path / name)
    assert detect_kind(folder) == "tum"
    frames, recording = frames_of(folder)
    assert len(frames) == recording.frame_count == COUNT
    assert not recording.drops
    for index, frame in enumerate(frames):
        # Stamps are exact: a float64 could not hold their nanoseconds.
        assert frame.stamp_ns == T0_NS + index * STEP_NS
        assert (frame.intrinsics.fx, frame.intrinsics.cy) == (fx, cy)
        np.testing.assert_array_equal(frame.rgb, rgb_pixels(index))
        np.testing.assert_allclose(frame.depth_m[1:], 1.0 + 0.01 * index, atol=5e-4)
        assert not frame.depth_m[0].any()
        before, after = pose(index - 0.3), pose(index + 0.2)
        between = interpolate_pose(before, after, 0.6)
        np.testing.assert_allclose(frame.T_world_camera, between, atol=1e-6)


def test_depth_that_is_too_far_in_time_drops_the_frame(tmp_path):
    folder = write_tum(tmp_path / "fr1", depth_offset_ns=30_000_000)
    frames, recording = frames_of(folder)
    assert not frames
    assert recording.drops["no_depth"] == COUNT
    assert len(frames_of(folder, InputsConfig(slop_s=0.05))[0]) == COUNT


def test_a_hole_in_the_ground_truth_drops_the_frames_in_it(tmp_path):
    folder = write_tum(tmp_path / "fr1")
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(lines[:6]))
    frames, recording = frames_of(folder)
    assert 0 < len(frames) < COUNT
    assert recording.drops["no_pose"] == COUNT - len(frames)


def test_an_unknown_camera_is_refused_with_a_request_for_intrinsics(tmp_path):
    folder = write_tum(tmp_path / "my_office")
    with pytest.raises(RecordingError, match="--intrinsics"):
        open_recording(folder)
    frames, _ = frames_of(folder, intrinsics=(500.0, 501.0, 30.0, 20.0))
    assert frames[0].intrinsics.fy == 501.0
    with pytest.raises(RecordingError, match="expected no --rate"):
        frames_of(folder, intrinsics=(500.0, 501.0, 30.0, 20.0), rate_hz=10.0)


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth.txt"])
def test_the_missing_file_is_named(tmp_path, name):
    folder = write_tum(tmp_path / "fr1")
    (folder / name).unlink()
    with pytest.raises(RecordingError, match=name.replace(".", r"\.")):
        open_recording(folder, kind="tum")


@pytest.mark.parametrize("with_poses", [True, False])
def test_the_ground_truth_is_needed_only_for_its_poses(tmp_path, with_poses):
    folder = write_tum(tmp_path / "fr1")
    if not with_poses:
        (folder / "groundtruth.txt").unlink()
    source = open_source(folder, need_poses=False)
    assert (Role.POSE in source.topics) is with_poses
    recording = Recording(choose_poses(source, PoseChoice(odometry=True), Config()))
    assert len(list(recording.frames())) == COUNT


@pytest.mark.parametrize(
    ("line", "words"),
    [("one two", "line 2"), ("1.5", "expected 7"), ("1.5 0 0 0 0 0 x 1", "expected numbers")],
)
def test_a_line_that_cannot_be_read_is_named(tmp_path, line, words):
    folder = write_tum(tmp_path / "fr1")
    (folder / "groundtruth.txt").write_text(f"# a comment\n{line}\n")
    with pytest.raises(RecordingError, match=words):
        open_recording(folder)


def test_frames_with_lost_images_are_dropped_and_the_images_named(tmp_path):
    folder = write_tum(tmp_path / "fr1")
    (folder / "rgb" / "2.png").unlink()
    (folder / "depth" / "1.png").write_bytes(b"no image")
    frames, recording = frames_of(folder)
    assert [frame.stamp_ns for frame in frames] == [T0_NS, T0_NS + 3 * STEP_NS]
    assert recording.drops["unreadable_file"] == 2
    assert any("2.png" in loss for loss in recording.losses)
    assert any("1.png" in loss for loss in recording.losses)


def test_an_empty_index_is_refused(tmp_path):
    folder = write_tum(tmp_path / "fr1")
    (folder / "depth.txt").write_text("# nothing\n\n")
    with pytest.raises(RecordingError, match=r"depth\.txt has no entry"):
        open_recording(folder)
