"""3RScan, ReplicaSSG and rendered rooms: what is read, turned, refused; and as a bag."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.sequences import (
    BACKGROUND_M,
    CAMERA,
    DEPTH_M,
    HEIGHT,
    WIDTH,
    depth_mm,
    write_info,
    write_room,
    write_sequence,
)

from deworldsg_ros.recordings.folders.dataset import DatasetOptions, detect_dataset
from deworldsg_ros.recordings.folders.sequence import resample, rotated_intrinsics, rotated_pose
from deworldsg_ros.recordings.recording import open_recording, open_source
from deworldsg_ros.recordings.writer import write_mcap
from deworldsg_ros.scene.camera import Intrinsics, pose_from_quaternion
from deworldsg_ros.scene.errors import RecordingError


def test_each_folder_is_recognised(tmp_path: Path) -> None:
    rio = write_sequence(tmp_path / "rio" / "data" / "a")
    (tmp_path / "replica" / "ReplicaSSG").mkdir(parents=True)
    replica = write_sequence(tmp_path / "replica" / "data" / "a")
    room = write_room(tmp_path / "rooms") / "data" / "room_0"
    for folder, kind in ((rio, "3rscan"), (replica, "replica"), (room, "rooms")):
        assert detect_dataset(folder) == kind
        assert detect_dataset(folder / "sequence") == kind
        assert open_source(folder / "sequence").name == folder.name


def test_a_whole_data_set_is_no_recording(tmp_path: Path) -> None:
    root = write_room(tmp_path / "rooms")
    with pytest.raises(RecordingError, match=r"with the scans room_0; expected one.*data/room_0"):
        open_source(root)


def test_frames_of_a_room(tmp_path: Path) -> None:
    recording = open_recording(write_room(tmp_path) / "data" / "room_0")
    frames = list(recording.frames())
    assert len(frames) == recording.frame_count == 3
    assert not recording.drops
    for number, frame in enumerate(frames):
        assert frame.intrinsics == CAMERA
        assert (np.rint(frame.depth_m * 1000) == depth_mm()).all()
        assert frame.T_world_camera[0, 3] == 0.01 * number
        assert frame.stamp_ns == 10**9 + number * 10**8
        assert recording.source.frame_numbers[frame.stamp_ns] == number  # type: ignore[attr-defined]


def test_images_poses_and_intrinsics_of_3rscan_are_rotated(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "data" / "a")
    frame = next(open_recording(folder).frames())
    assert frame.rgb.shape == (WIDTH, HEIGHT, 3)
    assert frame.intrinsics == Intrinsics(
        CAMERA.fy, CAMERA.fx, HEIGHT - CAMERA.cy, CAMERA.cx, HEIGHT, WIDTH
    )
    # The blue corner was at the upper left: clockwise, it comes to the upper right.
    assert frame.rgb[2, -3, 2] > 200
    assert frame.rgb[2, 3, 2] < 150
    assert (np.rint(frame.depth_m * 1000) == np.rot90(depth_mm(), -1)).all()


@given(
    u=st.floats(0, WIDTH - 1),
    v=st.floats(0, HEIGHT - 1),
    quat=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(
        lambda q: sum(x * x for x in q) > 0.1
    ),
)
def test_a_rotated_camera_sees_the_same_points(u: float, v: float, quat: list[float]) -> None:
    T = pose_from_quaternion(
        np.array([1.0, 2.0, 3.0]), np.array(quat) / np.linalg.norm(np.array(quat))
    )
    turned = rotated_intrinsics(CAMERA)
    ray = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
    # Turned clockwise, a corner-based pixel (u, v) is at (H - v, u).
    turned_ray = np.array([(HEIGHT - v - turned.cx) / turned.fx, (u - turned.cy) / turned.fy, 1.0])
    np.testing.assert_allclose(T[:3, :3] @ ray, rotated_pose(T)[:3, :3] @ turned_ray, atol=1e-12)


def test_depth_of_a_smaller_image_is_resampled_to_the_colour_image(tmp_path: Path) -> None:
    small = Intrinsics(40.0, 40.0, 23.5, 15.5, WIDTH // 2, HEIGHT // 2)
    folder = tmp_path / "replica" / "data" / "a"
    (tmp_path / "replica" / "ReplicaSSG").mkdir(parents=True)
    write_sequence(folder, 1, depth=small, depth_image=depth_mm()[::2, ::2])
    frame = next(open_recording(folder).frames())
    assert frame.depth_m[30, 20] == pytest.approx(DEPTH_M, abs=1e-6)
    assert frame.depth_m[5, 20] == pytest.approx(BACKGROUND_M, abs=1e-6)
    wrong = (np.rint(frame.depth_m * 1000) != depth_mm()).mean()
    assert wrong < 0.05


def test_resampling_to_the_same_camera_is_the_identity_and_outside_is_zero() -> None:
    image = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH)
    assert (resample(image, CAMERA, CAMERA) == image).all()
    narrow = Intrinsics(160.0, 160.0, CAMERA.cx, CAMERA.cy, WIDTH, HEIGHT)
    assert resample(image + 1, narrow, CAMERA)[0, 0] == 0


def test_depth_source_of_3rscan(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "data" / "a", 1)
    assert open_source(folder).topics["depth"].name == "frame-*.depth.pgm"  # type: ignore[index]
    with pytest.raises(RecordingError, match="--depth-source is rendered"):
        open_source(folder, options=DatasetOptions(depth_source="rendered"))
    rendered = np.full((HEIGHT, WIDTH), 1500, np.uint16)
    cv2.imwrite(str(folder / "sequence" / "frame-000000.rendered.depth.png"), rendered)
    for source, expected in (("auto", 1.5), ("rendered", 1.5), ("sensor", BACKGROUND_M)):
        options = DatasetOptions(depth_source=source)
        frame = next(open_recording(folder, options=options).frames())
        assert frame.depth_m[0, 0] == pytest.approx(expected, abs=1e-6)
    with pytest.raises(
        RecordingError, match="depth source 'laser': expected auto, rendered, sensor"
    ):
        DatasetOptions(depth_source="laser")


def test_a_missing_info_is_refused_with_its_path_and_source(tmp_path: Path) -> None:
    folder = tmp_path / "data" / "a"
    folder.mkdir(parents=True)
    with pytest.raises(RecordingError, match=r"sequence/_info\.txt is missing; .*3RScan"):
        open_source(folder, kind="3rscan")
    write_info(folder / "sequence" / "_info.txt")
    with pytest.raises(RecordingError, match="no frame-NNNNNN.color.jpg; .*ReplicaSSG"):
        open_source(folder, kind="replica")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("m_calibrationColorIntrinsic = 1 2 3", "expected 16"),
        ("m_depthShift = 0", "expected > 0"),
        ("m_colorWidth = many", "many"),
        ("m_colorWidth = 95", "expected 95x64"),
    ],
)
def test_a_wrong_line_of_info_is_refused_by_name(tmp_path: Path, line: str, expected: str) -> None:
    folder = write_sequence(tmp_path / "data" / "a", 1)
    info = folder / "sequence" / "_info.txt"
    info.write_text(info.read_text() + line + "\n")
    with pytest.raises(RecordingError, match=expected):
        open_source(folder)


def test_frames_without_their_files_or_a_pose_are_counted(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "data" / "a", 5)
    (folder / "sequence" / "frame-000001.depth.pgm").unlink()
    (folder / "sequence" / "frame-000002.pose.txt").write_text("-inf " * 16)
    (folder / "sequence" / "frame-000003.depth.pgm").write_bytes(b"P5 no image")
    recording = open_recording(folder)
    assert len(list(recording.frames())) == 2
    assert recording.drops == {"missing_file": 1, "invalid_pose": 1, "decode_failed": 1}


def test_a_bag_of_a_scan_has_the_same_frames(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "data" / "a", 2)
    path = tmp_path / "a.mcap"
    assert write_mcap(open_source(folder).raw_messages(), path) == 8
    for ours, theirs in zip(open_recording(folder).frames(), open_recording(path).frames()):
        assert ours.stamp_ns == theirs.stamp_ns
        assert ours.intrinsics == theirs.intrinsics
        assert (ours.rgb == theirs.rgb).all()
        assert (ours.depth_m == theirs.depth_m).all()
        assert (ours.T_world_camera == theirs.T_world_camera).all()
