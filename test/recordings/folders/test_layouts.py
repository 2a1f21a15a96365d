"""Folders of all data sets, then TUM, 3RScan, ReplicaSSG and rendered rooms."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recordings import (
    STEP_NS,
    TUM_T0_NS,
    frames_of,
    pose,
    rgb_pixels,
    write_seven_scenes,
    write_tum,
)
from support.sequences import (
    BACKGROUND_M,
    CAMERA,
    DEPTH_M,
    HEIGHT,
    WIDTH,
    depth_mm,
    write_room,
    write_sequence,
)

from deworldsg_ros.config import Config, InputsConfig
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.folders.sequence import resample, rotated_intrinsics, rotated_pose
from deworldsg_ros.recordings.posing import PoseChoice, choose_poses
from deworldsg_ros.recordings.recording import Recording, detect_kind, open_recording, open_source
from deworldsg_ros.recordings.replaying import write_mcap
from deworldsg_ros.recordings.source import Role
from deworldsg_ros.scene.camera import Intrinsics, interpolate_pose, pose_from_quaternion
from deworldsg_ros.scene.errors import RecordingError

COUNT = 4


def write(kind: str, root: Path) -> Path:
    if kind == "7scenes":
        return write_seven_scenes(root / "k", COUNT)
    if kind == "tum":
        return write_tum(root / "fr1", COUNT)
    if kind == "rooms":
        return write_room(root, COUNT) / "data" / "room_0"
    if kind == "replica":
        (root / "ReplicaSSG").mkdir()
    return write_sequence(root / "data" / "a", COUNT)


@pytest.mark.parametrize("kind", ["7scenes", "tum", "rooms", "replica", "3rscan"])
def test_a_folder_is_recognised_and_its_bag_has_the_same_frames(tmp_path, kind):
    folder = write(kind, tmp_path)
    assert detect_kind(folder) == kind
    if (folder / "sequence").exists():
        assert detect_kind(folder / "sequence") == kind
        assert open_source(folder / "sequence").name == folder.name
    write_mcap(open_source(folder).raw_messages(), tmp_path / "a.mcap")
    recording = open_recording(folder)
    ours = list(recording.frames())
    theirs = list(open_recording(tmp_path / "a.mcap").frames())
    assert len(ours) == len(theirs) == recording.frame_count == COUNT
    assert not recording.drops
    for a, b in zip(ours, theirs):
        assert (a.stamp_ns, a.intrinsics, a.frame_id) == (b.stamp_ns, b.intrinsics, b.frame_id)
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth_m, b.depth_m)
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)


def test_an_index_without_end_is_refused_in_a_short_line(tmp_path):
    folder = write("tum", tmp_path)
    index = folder / "groundtruth.txt"
    index.write_text("x" * 1_000_000)
    with pytest.raises(RecordingError) as refused:
        open_source(folder)
    assert "expected numbers" in str(refused.value) and len(str(refused.value)) < 500
    with index.open("r+") as file:
        file.truncate(200_000_000)
    with pytest.raises(RecordingError, match="200000000 bytes: expected at most"):
        open_source(folder)


@pytest.mark.parametrize(
    ("kind", "file", "content", "reason"),
    [
        ("7scenes", "frame-000004.depth.png", None, "missing_file"),
        ("7scenes", "frame-000008.color.jpg", "no image", "decode_failed"),
        *(
            ("7scenes", "frame-000008.pose.txt", content, "invalid_pose")
            for content in (
                *("nan nan nan nan\n" * 4, "-1.#IND -1.#IND 0 0\n" * 4, "0 0 0 0\n" * 4, ""),
                *("1 0 0 0\n0 1 0 0\n0 0 1 0", "1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1"),
            )
        ),
        ("tum", "rgb/2.png", None, "unreadable_file"),
        ("tum", "depth/1.png", "no image", "unreadable_file"),
        ("3rscan", "sequence/frame-000001.depth.pgm", None, "missing_file"),
        ("3rscan", "sequence/frame-000002.pose.txt", "-inf " * 16, "invalid_pose"),
        ("3rscan", "sequence/frame-000003.depth.pgm", "P5 no image", "decode_failed"),
    ],
)
def test_a_lost_file_costs_its_frame_and_is_counted(tmp_path, kind, file, content, reason):
    folder = write(kind, tmp_path)
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_text(content)
    recording = open_recording(folder)
    assert len(list(recording.frames())) == COUNT - 1
    assert recording.drops[reason] == 1
    if content is None:
        assert any(file.rpartition("/")[2] in loss for loss in recording.losses)


@pytest.mark.parametrize(
    ("kind", "file", "content", "words"),
    [
        ("7scenes", "camera-intrinsics.txt", "525 525", r"camera-intrinsics\.txt.*3x3"),
        ("tum", "rgb.txt", None, r"rgb\.txt"),
        ("tum", "depth.txt", None, r"depth\.txt"),
        ("tum", "depth.txt", "# nothing\n\n", r"depth\.txt has no entry"),
        ("tum", "groundtruth.txt", None, r"groundtruth\.txt"),
        ("tum", "groundtruth.txt", "# a comment\none two\n", "line 2"),
        ("tum", "groundtruth.txt", "1.5\n", "expected 7"),
        ("tum", "groundtruth.txt", "1.5 0 0 0 0 0 x 1\n", "expected numbers"),
        ("3rscan", "sequence/_info.txt", None, r"sequence/_info\.txt.*3RScan"),
        ("3rscan", "sequence/_info.txt", "OLD m_calibrationColorIntrinsic = 1 2 3", "expected 16"),
        ("3rscan", "sequence/_info.txt", "OLD m_depthShift = 0", "expected > 0"),
        ("3rscan", "sequence/_info.txt", "OLD m_colorWidth = many", "many"),
        ("3rscan", "sequence/_info.txt", "OLD m_colorWidth = 95", "expected 95x64"),
    ],
)
def test_a_folder_that_cannot_be_read_is_refused_by_file(tmp_path, kind, file, content, words):
    folder = write(kind, tmp_path)
    text = (folder / file).read_text()
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_text(content.replace("OLD ", text))
    with pytest.raises(RecordingError, match=words):
        open_recording(folder, kind=kind)


def test_folders_of_several_recordings_and_unknown_choices_are_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"room_0.*data/room_0"):
        open_source(write_room(tmp_path / "rooms"))
    for name in ("seq-01", "seq-02"):
        write_seven_scenes(tmp_path / "scenes" / name, 1)
    with pytest.raises(RecordingError, match="seq-01, seq-02"):
        open_source(tmp_path / "scenes")
    with pytest.raises(RecordingError, match="no frame-NNNNNN.color.jpg; .*ReplicaSSG"):
        open_source(write_sequence(tmp_path / "data" / "a", 0), kind="replica")
    with pytest.raises(RecordingError, match="'laser'"):
        DatasetOptions(depth_source="laser")


# --- TUM ---------------------------------------------------------------------------------------


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
    (folder / "groundtruth.txt").rename(folder / ("groundtruth.txt" if with_poses else "other"))
    source = open_source(folder, need_poses=False)
    assert (Role.POSE in source.topics) is with_poses
    recording = Recording(choose_poses(source, PoseChoice(odometry=True), Config()))
    assert len(list(recording.frames())) == COUNT


# --- 3RScan, ReplicaSSG and rendered rooms -----------------------------------------------------


def test_frames_of_a_room_are_as_written_and_those_of_3rscan_are_rotated(tmp_path):
    for number, frame in enumerate(
        open_recording(write_room(tmp_path / "rooms") / "data" / "room_0").frames()
    ):
        assert frame.intrinsics == CAMERA
        assert (np.rint(frame.depth_m * 1000) == depth_mm()).all()
        assert frame.T_world_camera[0, 3] == 0.01 * number
        assert frame.stamp_ns == 10**9 + number * 10**8
    frame = next(open_recording(write_sequence(tmp_path / "data" / "a")).frames())
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
    quat=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.3),
)
def test_a_rotated_camera_sees_the_same_points(u, v, quat):
    T = pose_from_quaternion(np.array([1.0, 2.0, 3.0]), np.array(quat) / np.linalg.norm(quat))
    turned = rotated_intrinsics(CAMERA)
    ray = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
    # Turned clockwise, a corner-based pixel (u, v) is at (H - v, u).
    turned_ray = np.array([(HEIGHT - v - turned.cx) / turned.fx, (u - turned.cy) / turned.fy, 1.0])
    np.testing.assert_allclose(T[:3, :3] @ ray, rotated_pose(T)[:3, :3] @ turned_ray, atol=1e-12)


def test_depth_of_a_smaller_image_is_resampled_to_the_colour_image(tmp_path):
    small = Intrinsics(40.0, 40.0, 23.5, 15.5, WIDTH // 2, HEIGHT // 2)
    (tmp_path / "ReplicaSSG").mkdir()
    folder = tmp_path / "data" / "a"
    write_sequence(folder, 1, depth=small, depth_image=depth_mm()[::2, ::2])
    frame = next(open_recording(folder).frames())
    assert frame.depth_m[30, 20] == pytest.approx(DEPTH_M, abs=1e-6)
    assert frame.depth_m[5, 20] == pytest.approx(BACKGROUND_M, abs=1e-6)
    assert (np.rint(frame.depth_m * 1000) != depth_mm()).mean() < 0.05
    # To the same camera it is the identity, and outside there is none.
    image = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH)
    assert (resample(image, CAMERA, CAMERA) == image).all()
    narrow = Intrinsics(160.0, 160.0, CAMERA.cx, CAMERA.cy, WIDTH, HEIGHT)
    assert resample(image + 1, narrow, CAMERA)[0, 0] == 0


def test_depth_source_of_3rscan(tmp_path):
    folder = write_sequence(tmp_path / "data" / "a", 1)
    assert open_source(folder).topics["depth"].name == "frame-*.depth.pgm"
    with pytest.raises(RecordingError, match="--depth-source"):
        open_source(folder, options=DatasetOptions(depth_source="rendered"))
    rendered = np.full((HEIGHT, WIDTH), 1500, np.uint16)
    cv2.imwrite(str(folder / "sequence" / "frame-000000.rendered.depth.png"), rendered)
    for source, expected in (("auto", 1.5), ("rendered", 1.5), ("sensor", BACKGROUND_M)):
        recording = open_recording(folder, options=DatasetOptions(depth_source=source))
        assert next(recording.frames()).depth_m[0, 0] == pytest.approx(expected, abs=1e-6)
