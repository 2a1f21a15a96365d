"""What folders of all data sets have in common: they are recognised, converted, and lose little."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.recordings import write_seven_scenes, write_tum
from support.sequences import write_room, write_sequence

from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.recording import detect_kind, open_recording, open_source
from deworldsg_ros.recordings.writer import write_mcap
from deworldsg_ros.scene.errors import RecordingError

COUNT = 4


def write(kind: str, root: Path) -> Path:
    """A folder of this kind with a few frames."""
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


@pytest.mark.parametrize(
    ("kind", "file", "content", "reason"),
    [
        ("7scenes", "frame-000004.depth.png", None, "missing_file"),
        ("7scenes", "frame-000008.color.jpg", "no image", "decode_failed"),
        ("7scenes", "frame-000008.pose.txt", "nan nan nan nan\n" * 4, "invalid_pose"),
        ("7scenes", "frame-000008.pose.txt", "-1.#IND -1.#IND 0 0\n" * 4, "invalid_pose"),
        ("7scenes", "frame-000008.pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0", "invalid_pose"),
        ("7scenes", "frame-000008.pose.txt", "0 0 0 0\n" * 4, "invalid_pose"),
        (
            *("7scenes", "frame-000008.pose.txt"),
            *("1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1", "invalid_pose"),
        ),
        ("7scenes", "frame-000008.pose.txt", "", "invalid_pose"),
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
