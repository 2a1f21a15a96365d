"""7-Scenes folders: registered, and as Microsoft distributes them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.recordings import (
    HEIGHT,
    INTRINSICS,
    WIDTH,
    depth_mm,
    encoded,
    pose,
    rgb_pixels,
    write_seven_scenes,
)

from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.folders.seven_scenes import (
    BASELINE_M,
    COLOR_FX_FY_CX_CY,
    DEPTH_FX_FY_CX_CY,
    FIRST_STAMP_NS,
)
from deworldsg_ros.recordings.recording import detect_kind, open_recording, open_source
from deworldsg_ros.recordings.writer import write_mcap
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RecordingError

COUNT = 5


def frames_of(path, **options):
    recording = open_recording(path, options=DatasetOptions(**options))
    return list(recording.frames()), recording


def test_registered_frames_with_their_times_and_poses(tmp_path):
    folder = write_seven_scenes(tmp_path / "kitchen", COUNT)
    assert detect_kind(folder) == "7scenes"
    frames, recording = frames_of(folder)
    assert len(frames) == recording.frame_count == COUNT
    for index, frame in enumerate(frames):
        # Every fourth frame of 30 Hz.
        assert frame.stamp_ns == FIRST_STAMP_NS + round(index * 4e9 / 30)
        assert frame.intrinsics == INTRINSICS
        np.testing.assert_allclose(frame.T_world_camera, pose(index), atol=1e-7)
        np.testing.assert_allclose(frame.depth_m, depth_mm(index) * 1e-3, atol=1e-6)
        assert np.abs(frame.rgb.astype(int) - rgb_pixels(index)).mean() < 4  # JPEG


def test_the_rate_option_replaces_the_rate_of_the_sensor(tmp_path):
    frames, _ = frames_of(write_seven_scenes(tmp_path / "k", COUNT), rate_hz=10.0)
    assert [frame.stamp_ns - FIRST_STAMP_NS for frame in frames] == [
        index * 10**8 for index in range(COUNT)
    ]


@pytest.mark.parametrize(
    "text",
    [
        "nan nan nan nan\n" * 4,
        "-1.#IND -1.#IND 0 0\n" * 4,
        "1 0 0 0\n0 1 0 0\n0 0 1 0",
        "0 0 0 0\n" * 4,
        "1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1",
        "",
    ],
)
def test_frames_with_an_invalid_pose_are_dropped_and_counted(tmp_path, text):
    folder = write_seven_scenes(tmp_path / "k", COUNT)
    (folder / "frame-000008.pose.txt").write_text(text)
    frames, recording = frames_of(folder)
    assert len(frames) == COUNT - 1
    assert recording.drops == {"invalid_pose": 1}


def test_frames_with_missing_or_broken_files_are_dropped_and_the_files_named(tmp_path):
    folder = write_seven_scenes(tmp_path / "k", COUNT)
    (folder / "frame-000004.depth.png").unlink()
    (folder / "frame-000012.color.jpg").write_bytes(b"no image")
    frames, recording = frames_of(folder)
    assert len(frames) == COUNT - 2
    assert recording.drops["missing_file"] == 1
    assert recording.drops["decode_failed"] == 1
    assert any("frame-000004.depth.png" in loss for loss in recording.losses)


def test_a_folder_and_its_converted_bag_give_equal_frames(tmp_path):
    folder = write_seven_scenes(tmp_path / "k", COUNT)
    write_mcap(open_source(folder).raw_messages(), tmp_path / "k.mcap")
    ours, theirs = frames_of(folder)[0], list(open_recording(tmp_path / "k.mcap").frames())
    assert len(ours) == len(theirs) == COUNT
    for a, b in zip(ours, theirs):
        assert (a.stamp_ns, a.intrinsics, a.frame_id) == (b.stamp_ns, b.intrinsics, b.frame_id)
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth_m, b.depth_m)
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)


def test_a_folder_of_several_sequences_is_refused_with_their_names(tmp_path):
    for name in ("seq-01", "seq-02"):
        write_seven_scenes(tmp_path / name, 1)
    with pytest.raises(RecordingError, match="seq-01, seq-02"):
        open_recording(tmp_path)


def test_intrinsics_that_are_no_matrix_are_refused_by_name(tmp_path):
    folder = write_seven_scenes(tmp_path / "k", 1)
    (folder / "camera-intrinsics.txt").write_text("525 525")
    with pytest.raises(RecordingError, match=r"camera-intrinsics\.txt.*3x3"):
        open_recording(folder)


# The original layout: a wall at a known distance, seen by the Kinect's two cameras.

SIZE = (640, 480)
WALL_MM = 2000
EDGE_X_M = 0.3  # right of this the wall stands 1 m further back


def write_original(folder, count=2):
    folder.mkdir()
    depth_camera = Intrinsics(*DEPTH_FX_FY_CX_CY, *SIZE)
    color_camera = Intrinsics(*COLOR_FX_FY_CX_CY, *SIZE)
    z = WALL_MM * 1e-3

    def edge_column(camera, offset_m):
        return camera.fx * (EDGE_X_M - offset_m) / z + camera.cx

    depth = np.full((480, 640), WALL_MM, np.uint16)
    depth[:, int(edge_column(depth_camera, 0.0)) :] = WALL_MM + 1000
    depth[:40] = 65535
    color = np.zeros((480, 640, 3), np.uint8)
    color[:, : int(edge_column(color_camera, BASELINE_M))] = 255
    for index in range(count):
        stem = folder / f"frame-{index:06d}"
        stem.with_suffix(".color.png").write_bytes(encoded(color))
        stem.with_suffix(".depth.png").write_bytes(encoded(depth))
        np.savetxt(stem.with_suffix(".pose.txt"), np.eye(4), "%.9g")
    return folder


def test_original_layout_is_registered_with_the_known_calibration(tmp_path):
    frames, recording = frames_of(write_original(tmp_path / "seq-01"))
    assert len(frames) == 2
    assert not recording.drops
    frame = frames[0]
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (528.41, 320.32)
    # 65535 is no depth of 65 m.
    assert frame.depth_m.max() < 3.1
    row = frame.depth_m[240]
    assert set(np.round(row[row > 0], 2)) == {2.0, 3.0}
    # The edge is where colour has it: white is near, black is far.
    near_m = row[(frame.rgb[240, :, 0] > 128) & (row > 0)]
    assert (near_m < 2.5).mean() > 0.99
    far_m = row[(frame.rgb[240, :, 0] < 128) & (row > 0)]
    assert (far_m > 2.5).mean() > 0.98
    # The depth camera sees less than the colour camera, on the right even less.
    valid = np.flatnonzero(row)
    assert 0 < valid[0] < SIZE[0] - 1 - valid[-1] < 60
    # Its frames are 1/30 s apart, and the pose is moved to the colour camera.
    assert frames[1].stamp_ns - frames[0].stamp_ns == round(1e9 / 30)
    np.testing.assert_allclose(frame.T_world_camera[:3, 3], [BASELINE_M, 0, 0], atol=1e-9)


def test_the_intrinsics_option_implies_registered_depth(tmp_path):
    folder = write_original(tmp_path / "seq-01")
    frames, _ = frames_of(folder, intrinsics=(525.0, 525.0, 319.5, 239.5))
    assert frames[0].intrinsics.fx == 525.0
    np.testing.assert_allclose(frames[0].T_world_camera, np.eye(4), atol=1e-12)
    assert (frames[0].depth_m[240] > 0).all()


@pytest.mark.slow
def test_the_real_kitchen_is_read_whole(shared_dir):
    frames, recording = frames_of(shared_dir / "data" / "redkitchen")
    assert len(frames) == 250
    assert not recording.drops
    assert frames[0].rgb.shape == (480, 640, 3)
    assert 0.4 < np.median(frames[0].depth_m[frames[0].depth_m > 0]) < 4


def test_support_images_have_the_properties_that_the_tests_assume():
    assert rgb_pixels(0).shape == (HEIGHT, WIDTH, 3)
    decoded = cv2.imdecode(np.frombuffer(encoded(depth_mm(3)), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decoded, depth_mm(3))
