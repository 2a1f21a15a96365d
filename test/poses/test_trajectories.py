"""Trajectory files: reading, validation, interpolation, and use with a recording."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.merging import random_pose
from support.recordings import camera_items, stamp_ns, write_bag
from support.sequences import write_sequence
from typer.testing import CliRunner

from deworldsg_ros.cli.app import app
from deworldsg_ros.config import Config
from deworldsg_ros.poses.trajectory import TrajectoryError, read_trajectory, write_tum
from deworldsg_ros.recordings.folders.sequence import ROTATED_AXES
from deworldsg_ros.recordings.posing import PoseChoice, choose_poses, posed_frames
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.errors import ConfigurationError, RecordingError

S = 10**9
SLOP_NS = 100_000_000
TUM_LINE = "1.5 1 2 3 0 0 0 1"
KITTI_LINE = "1 0 0 4 0 1 0 5 0 0 1 6"


def written(path, *lines):
    path.write_text("\n".join(lines) + "\n")
    return path


@given(st.integers(0, 2**32 - 1))
def test_a_written_trajectory_is_read_back(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    poses = [random_pose(rng) for _ in range(5)]
    stamps_ns = np.cumsum(rng.integers(1, 10**10, 5)).tolist()
    path = tmp_path_factory.getbasetemp() / "written.txt"
    write_tum(path, stamps_ns, poses)
    trajectory = read_trajectory(path)
    assert (trajectory.kind, list(trajectory.keys)) == ("tum", stamps_ns)
    np.testing.assert_allclose(trajectory.T_world_cameras, poses, atol=1e-7)
    for stamp, T in zip(stamps_ns, poses):
        np.testing.assert_allclose(trajectory.at(stamp, 0, 0, 0), T, atol=1e-7)


def test_tum_poses_are_interpolated_between_two_near_stamps(tmp_path):
    half = np.sqrt(0.5)
    lines = "# comment", "1.0 0 0 0 0 0 0 1", f"1.1 1 0 0 0 0 {half} {half}"
    trajectory = read_trajectory(written(tmp_path / "t.txt", *lines))
    T = trajectory.at(1 * S + 50_000_000, 0, 0, SLOP_NS)
    np.testing.assert_allclose(T[:3, 3], [0.5, 0, 0])
    assert np.degrees(np.arctan2(T[1, 0], T[0, 0])) == pytest.approx(45.0)
    np.testing.assert_array_equal(trajectory.at(1 * S, 0, 0, 0), np.eye(4))
    # Outside, the nearest pose within the slop.
    np.testing.assert_array_equal(trajectory.at(1 * S - SLOP_NS, 0, 0, SLOP_NS), np.eye(4))
    for stamp in (1 * S - SLOP_NS - 1, 2 * S):
        assert trajectory.at(stamp, 0, 0, SLOP_NS) is None
    assert trajectory.at(1 * S + 60_000_000, 0, 0, 50_000_000)[0, 3] == 1.0


def test_kitti_poses_have_positions_and_pose_files_have_numbers(tmp_path):
    trajectory = read_trajectory(written(tmp_path / "k.txt", KITTI_LINE, KITTI_LINE))
    assert trajectory.kind == "kitti"
    assert trajectory.at(0, 99, 1, 0)[:3, 3].tolist() == [4.0, 5.0, 6.0]
    assert trajectory.at(0, 0, 2, 0) is None
    folder = tmp_path / "sequence"
    folder.mkdir()
    np.savetxt(folder / "frame-000004.pose.txt", np.eye(4))
    assert read_trajectory(folder).kind == "3rscan"
    moved = np.eye(4)
    moved[0, 3] = 2.0
    np.savetxt(folder / "frame-000004.slam.pose.txt", moved)
    np.savetxt(folder / "frame-000005.slam.pose.txt", np.full((4, 4), -np.inf))
    slam = read_trajectory(folder)
    assert (slam.kind, slam.keys, slam.missing) == ("slam", (4,), 1)
    assert slam.at(0, 4, 0, 0)[0, 3] == 2.0
    assert slam.at(0, 5, 0, 0) is None
    assert read_trajectory(folder, "3rscan").at(0, 4, 0, 0)[0, 3] == 0.0


@pytest.mark.parametrize(
    ("kind", "lines", "offender"),
    [
        ("auto", ["# nothing"], "no poses"),
        ("auto", ["1 2 3"], "line 1 has 3 values"),
        ("tum", [TUM_LINE, "2 1 2"], "line 2 has 3 values"),
        ("tum", ["1 nan 2 3 0 0 0 1"], "line 1: 'nan 2 3 0 0 0 1'"),
        ("tum", ["one 1 2 3 0 0 0 1"], "line 1: 'one'"),
        ("tum", ["1 1 2 3 0 0 0 0"], "norm 0.0000"),
        ("tum", [TUM_LINE, TUM_LINE], "line 2: stamp 1.5"),
        ("kitti", ["-1 0 0 4 0 1 0 5 0 0 1 6"], "line 1: .*right-handed"),
        ("auto", [KITTI_LINE, TUM_LINE], "line 2 has 8 values"),
        ("slam", [TUM_LINE], "expected the folder"),
    ],
)
def test_errors_name_file_and_line(tmp_path, kind, lines, offender):
    with pytest.raises(TrajectoryError, match=rf"t\.txt.*{offender}"):
        read_trajectory(written(tmp_path / "t.txt", *lines), kind)


def test_missing_files_and_bad_folders_are_refused(tmp_path):
    with pytest.raises(TrajectoryError, match=r"t\.txt: cannot be read"):
        read_trajectory(tmp_path / "t.txt")
    with pytest.raises(TrajectoryError, match=r"no frame-NNNNNN\.pose\.txt"):
        read_trajectory(tmp_path)
    with pytest.raises(TrajectoryError, match="'bvh'"):
        read_trajectory(written(tmp_path / "t.txt", TUM_LINE), "bvh")
    with pytest.raises(TrajectoryError, match="is a folder"):
        read_trajectory(tmp_path, "tum")
    (tmp_path / "frame-000001.pose.txt").write_text("1 2 3")
    with pytest.raises(TrajectoryError, match=r"frame-000001\.pose\.txt has 3 values"):
        read_trajectory(tmp_path)
    with pytest.raises(TrajectoryError, match="cannot be written"):
        write_tum(tmp_path / "no" / "t.txt", [], [])
    with pytest.raises(ConfigurationError, match="expected only one"):
        PoseChoice(Path("t.txt"), odometry=True)


def frames_with(path, choice):
    config = Config()
    source = open_source(path, need_poses=choice.need_poses)
    recording = Recording(choose_poses(source, choice, config), config.inputs)
    frames = list(posed_frames(recording, choice, [].append))
    source.close()
    return recording, frames


def test_a_trajectory_replaces_the_poses_of_a_bag(tmp_path):
    bag = write_bag(tmp_path / "bag", camera_items(6))
    lines = [f"{stamp_ns(k) / S:.9f} {k / 10} 0 0 0 0 0 1" for k in range(6) if k not in (2, 3, 4)]
    recording, frames = frames_with(bag, PoseChoice(written(tmp_path / "t.txt", *lines)))
    # Frames 2 and 4 take the nearest pose, 0.1 s away; nothing stands for frame 3.
    assert [frame.stamp_ns for frame in frames] == [stamp_ns(k) for k in (0, 1, 2, 4, 5)]
    assert recording.drops["no_pose"] == 1
    assert {frame.frame_id for frame in frames} == {"map"}
    assert frames[0].T_world_camera[0, 3] == 0.0


def test_a_bag_without_poses_needs_another_source_of_poses(tmp_path):
    bag = write_bag(tmp_path / "bag", camera_items(3, with_pose=False))
    with pytest.raises(RecordingError, match="no pose topic"):
        open_source(bag)
    kitti = written(tmp_path / "k.txt", *[KITTI_LINE] * 3)
    recording, frames = frames_with(bag, PoseChoice(kitti))
    assert [frame.T_world_camera[0, 3] for frame in frames] == [4.0] * 3
    assert frames[0].frame_id == "world"
    assert recording.frame_count == 3


@pytest.mark.parametrize("own_poses", [True, False])
def test_slam_poses_of_a_scan_are_rotated_with_its_images(tmp_path, own_poses):
    folder = write_sequence(tmp_path / "data" / "scan", 4)
    for path in (folder / "sequence").glob("*.pose.txt"):
        T = np.loadtxt(path)
        T[:3] = [[0, 0, 1, 10], [1, 0, 0, 20], [0, 1, 0, 30]]
        if "000001" not in path.name:
            np.savetxt(path.with_name(path.name.replace(".pose", ".slam.pose")), T)
        if not own_poses:
            path.unlink()
    recording, frames = frames_with(folder, PoseChoice(folder / "sequence", "slam"))
    assert len(frames) == 3
    assert recording.drops["no_pose"] == 1
    T[:3, :3] = T[:3, :3] @ ROTATED_AXES
    np.testing.assert_allclose(frames[0].T_world_camera, T, atol=1e-9)
    recording, frames = frames_with(folder, PoseChoice())
    assert (len(frames), recording.drops["missing_file"]) == ((4, 0) if own_poses else (0, 4))


def test_run_takes_a_trajectory_and_writes_the_poses_used(tmp_path, root_dir):
    bag, out, used = root_dir / "bags" / "demo_room", tmp_path / "out", tmp_path / "used.txt"

    def run(*arguments):
        words = ["run", bag, "--out", out, "--max-frames", 3, *arguments]
        return CliRunner().invoke(app, [str(word) for word in words])

    def report():
        return json.loads((out / "run.json").read_text())

    result = run("--save-trajectory", used, "--temporal")
    assert result.exit_code == 0, result.output
    assert report()["temporal"]["id_switches"] is None
    assert report()["temporal"]["updates"] >= 1
    again = tmp_path / "again.txt"
    result = run("--poses", used, "--save-trajectory", again)
    assert result.exit_code == 0, result.output
    assert report()["poses"] == "used.txt"
    first, second = (read_trajectory(path).T_world_cameras for path in (used, again))
    np.testing.assert_allclose(first, second, atol=1e-7)
    for option, value in (("--poses", tmp_path / "nothing.txt"), ("--pose-noise", "wobble=1")):
        result = run(option, value)
        assert result.exit_code == 2
        assert str(value).rsplit("/", 1)[-1] in result.stderr
