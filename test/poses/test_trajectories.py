"""Trajectory files: reading, validation, interpolation, and use with a recording."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.cli import deworldsg
from support.merging import random_pose
from support.recordings import (
    HEIGHT,
    INTRINSICS,
    WIDTH,
    camera_items,
    depth_mm,
    encoded,
    pose,
    rgb_pixels,
    stamp_ns,
    write_bag,
)

from deworldsg_ros.config import Config
from deworldsg_ros.poses.trajectory import TrajectoryError, read_trajectory, write_tum
from deworldsg_ros.recordings.folders.sequence import ROTATED_AXES
from deworldsg_ros.recordings.posing import PoseChoice, choose_poses, posed_frames
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.errors import ConfigurationError, RecordingError, RefusedInput

S = 10**9
SLOP_NS = 100_000_000
TUM_LINE = "1.5 1 2 3 0 0 0 1"
KITTI_LINE = "1 0 0 4 0 1 0 5 0 0 1 6"


def written(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


@given(st.integers(0, 2**32 - 1))
def test_a_written_trajectory_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    poses = [random_pose(rng) for _ in range(5)]
    stamps_ns = np.cumsum(rng.integers(1, 10**10, 5)).tolist()
    path = tmp_path_factory.getbasetemp() / "written.txt"
    write_tum(path, stamps_ns, poses)
    trajectory = read_trajectory(path)
    assert (trajectory.kind, list(trajectory.keys)) == ("tum", stamps_ns)
    np.testing.assert_allclose(trajectory.T_world_cameras, poses, atol=1e-7)
    for stamp_ns_, T in zip(stamps_ns, poses):
        np.testing.assert_allclose(trajectory.at(stamp_ns_, 0, 0, 0), T, atol=1e-7)


def test_tum_poses_are_interpolated_between_two_near_stamps(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    path = written(
        tmp_path / "t.txt", "# comment", "1.0 0 0 0 0 0 0 1", f"1.1 1 0 0 0 0 {half} {half}"
    )
    trajectory = read_trajectory(path)
    T = trajectory.at(1 * S + 50_000_000, 0, 0, SLOP_NS)
    assert T is not None
    np.testing.assert_allclose(T[:3, 3], [0.5, 0, 0])
    assert np.degrees(np.arctan2(T[1, 0], T[0, 0])) == pytest.approx(45.0)
    np.testing.assert_array_equal(trajectory.at(1 * S, 0, 0, 0), np.eye(4))
    nearest = trajectory.at(1 * S - SLOP_NS, 0, 0, SLOP_NS)
    np.testing.assert_array_equal(nearest, np.eye(4))
    assert trajectory.at(1 * S - SLOP_NS - 1, 0, 0, SLOP_NS) is None
    assert trajectory.at(2 * S, 0, 0, SLOP_NS) is None
    assert trajectory.at(1 * S + 60_000_000, 0, 0, 50_000_000)[0, 3] == 1.0


def test_kitti_poses_have_positions_and_pose_files_have_numbers(tmp_path: Path) -> None:
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


BAD = {
    "empty": ("auto", ["# nothing"], "has no poses"),
    "columns": ("auto", ["1 2 3"], "line 1 has 3 values: expected 8"),
    "short": ("tum", [TUM_LINE, "2 1 2"], "line 2 has 3 values: expected stamp"),
    "nan": ("tum", ["1 nan 2 3 0 0 0 1"], "line 1: 'nan 2 3 0 0 0 1': .*expected"),
    "word": ("tum", ["1 x 2 3 0 0 0 1"], "line 1: 'x 2 3 0 0 0 1'"),
    "stamp": ("tum", ["one 1 2 3 0 0 0 1"], "line 1: 'one' is no stamp"),
    "zero quaternion": ("tum", ["1 1 2 3 0 0 0 0"], "norm 0.0000: expected 1"),
    "order": ("tum", [TUM_LINE, TUM_LINE], "line 2: stamp 1.5 is not later"),
    "mirror": ("kitti", ["-1 0 0 4 0 1 0 5 0 0 1 6"], "line 1: .*right-handed"),
    "mixed": ("auto", [KITTI_LINE, TUM_LINE], "line 2 has 8 values: expected 12 numbers"),
    "format": ("bvh", [TUM_LINE], "format 'bvh': expected auto, tum"),
    "no folder": (
        "slam",
        [TUM_LINE],
        r"expected the folder that contains frame-NNNNNN.slam.pose.txt",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_errors_name_file_and_line(tmp_path: Path, case: str) -> None:
    kind, lines, message = BAD[case]
    with pytest.raises(TrajectoryError, match=message):
        read_trajectory(written(tmp_path / "t.txt", *lines), kind)


def test_missing_files_and_bad_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TrajectoryError, match=r"t\.txt: cannot be read"):
        read_trajectory(tmp_path / "t.txt")
    with pytest.raises(TrajectoryError, match=r"no frame-NNNNNN\.pose\.txt in it"):
        read_trajectory(tmp_path)
    with pytest.raises(TrajectoryError, match="is a folder"):
        read_trajectory(tmp_path, "tum")
    (tmp_path / "frame-000001.pose.txt").write_text("1 2 3")
    with pytest.raises(TrajectoryError, match=r"frame-000001\.pose\.txt has 3 values"):
        read_trajectory(tmp_path)
    with pytest.raises(TrajectoryError, match="cannot be written"):
        write_tum(tmp_path / "no" / "t.txt", [], [])


def frames_with(path: Path, choice: PoseChoice, config: Config | None = None):  # type: ignore[no-untyped-def]
    config = config or Config()
    source = open_source(path, need_poses=choice.need_poses)
    recording = Recording(choose_poses(source, choice, config), config.inputs)
    refusals: list[RefusedInput] = []
    frames = list(posed_frames(recording, choice, refusals.append))
    source.close()
    return recording, frames, refusals


def test_a_trajectory_replaces_the_poses_of_a_bag(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", camera_items(6))
    lines = [f"{stamp_ns(k) / S:.9f} {k / 10} 0 0 0 0 0 1" for k in range(6) if k not in (2, 3, 4)]
    path = written(tmp_path / "t.txt", *lines)
    config = Config()
    choice = PoseChoice(path)
    source = open_source(bag, need_poses=False)
    recording = Recording(choose_poses(source, choice, config), config.inputs)
    frames = list(recording.frames())
    # Frames 2 and 4 take the nearest pose, 0.1 s away; nothing stands for frame 3.
    assert [frame.stamp_ns for frame in frames] == [stamp_ns(k) for k in (0, 1, 2, 4, 5)]
    assert recording.drops["no_pose"] == 1
    assert {frame.frame_id for frame in frames} == {"map"}
    assert frames[0].T_world_camera[0, 3] == 0.0


def test_a_bag_without_poses_needs_another_source_of_poses(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", camera_items(3, with_pose=False))
    with pytest.raises(RecordingError, match="no pose topic"):
        open_source(bag)
    path = written(tmp_path / "k.txt", *[KITTI_LINE] * 3)
    recording, frames, _ = frames_with(bag, PoseChoice(path))
    assert [frame.T_world_camera[0, 3] for frame in frames] == [4.0] * 3
    assert frames[0].frame_id == "world"
    assert recording.frame_count == 3


def scan(folder: Path, *, poses: bool) -> Path:
    """A scan of 3RScan: four frames, poses of SLAM, and optionally its own poses."""
    sequence = folder / "sequence"
    sequence.mkdir(parents=True)
    K = np.eye(4)
    K[:3, :3] = INTRINSICS.matrix
    numbers = " ".join(map(str, K.ravel()))
    written(
        sequence / "_info.txt",
        *(f"m_{kind}Width = {WIDTH}" for kind in ("color", "depth")),
        *(f"m_{kind}Height = {HEIGHT}" for kind in ("color", "depth")),
        *(f"m_calibration{kind}Intrinsic = {numbers}" for kind in ("Color", "Depth")),
        "m_depthShift = 1000",
    )
    for k in range(4):
        stem = sequence / f"frame-{k:06d}"
        Path(f"{stem}.color.jpg").write_bytes(encoded(rgb_pixels(k), ".jpg"))
        Path(f"{stem}.depth.pgm").write_bytes(encoded(depth_mm(k), ".pgm"))
        if poses:
            np.savetxt(f"{stem}.pose.txt", pose(k))
        if k != 1:
            T = pose(k)
            T[0, 3] += 10.0
            np.savetxt(f"{stem}.slam.pose.txt", T)
    return folder


@pytest.mark.parametrize("poses", [True, False])
def test_slam_poses_of_a_scan_are_rotated_with_its_images(tmp_path: Path, poses: bool) -> None:
    folder = scan(tmp_path / "data" / "scan", poses=poses)
    recording, frames, _ = frames_with(folder, PoseChoice(folder / "sequence", "slam"))
    assert len(frames) == 3
    assert recording.drops["no_pose"] == 1
    expected = pose(0)
    expected[0, 3] += 10.0
    expected[:3, :3] = expected[:3, :3] @ ROTATED_AXES
    np.testing.assert_allclose(frames[0].T_world_camera, expected, atol=1e-9)


def test_a_scan_without_poses_has_no_frames_of_its_own(tmp_path: Path) -> None:
    recording, frames, _ = frames_with(scan(tmp_path / "data" / "scan", poses=False), PoseChoice())
    assert frames == []
    assert recording.drops["missing_file"] == 4


def test_poses_have_one_source() -> None:
    with pytest.raises(ConfigurationError, match="expected only one"):
        PoseChoice(Path("t.txt"), odometry=True)


def test_run_takes_a_trajectory_and_writes_the_poses_used(tmp_path: Path, root_dir: Path) -> None:
    bag = root_dir / "bags" / "demo_room"
    used, out = tmp_path / "used.txt", tmp_path / "out"
    first = deworldsg(
        tmp_path, "run", bag, "--out", out, "--max-frames", 3, "--save-trajectory", used,
        "--temporal",
    )  # fmt: skip
    assert first.returncode == 0, first.stderr
    report = json.loads((out / "run.json").read_text())
    assert report["temporal"]["id_switches"] is None
    assert report["temporal"]["updates"] >= 1
    again = deworldsg(
        tmp_path, "run", bag, "--out", out, "--max-frames", 3, "--poses", used,
        "--save-trajectory", tmp_path / "again.txt",
    )  # fmt: skip
    assert again.returncode == 0, again.stderr
    assert json.loads((out / "run.json").read_text())["poses"] == "used.txt"
    first_poses, second_poses = (
        read_trajectory(path).T_world_cameras for path in (used, tmp_path / "again.txt")
    )
    np.testing.assert_allclose(first_poses, second_poses, atol=1e-7)
    bad = deworldsg(tmp_path, "run", bag, "--out", out, "--poses", tmp_path / "nothing.txt")
    assert bad.returncode == 2
    assert "nothing.txt: cannot be read" in bad.stderr
    noisy = deworldsg(tmp_path, "run", bag, "--out", out, "--pose-noise", "wobble=1")
    assert noisy.returncode == 2
    assert "pose noise 'wobble=1': expected NAME=NUMBER" in noisy.stderr
