"""`deworldsg run` on the recording that ships."""

import itertools
import json
import signal
import subprocess

import numpy as np
import pytest
from support.cli import COMMAND, DEMO_ROOM, deworldsg, environment, invoke, printed
from support.recordings import camera_items, write_bag

from deworldsg_ros import pipeline
from deworldsg_ros.cli import outputs
from deworldsg_ros.cli.outputs import Album
from deworldsg_ros.config import load_config
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.poses.loops import LoopOdometry
from deworldsg_ros.poses.trajectory import read_trajectory
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.scene.camera import Trajectory, rigid_motion
from deworldsg_ros.wire import messages as wire

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]


def test_a_run_writes_every_file_that_it_names(tmp_path):
    result = deworldsg(
        tmp_path,
        *("run", DEMO_ROOM, "--out", "out", "--max-frames", 12, "--set", "output.top_k=3"),
        "--timings",
        limit_s=360,
    )
    assert result.returncode == 0, result.stderr
    out = tmp_path / "out"
    graph = wire.decode((out / "scene_graph.json").read_bytes(), wire.SceneGraphMessage)
    assert graph.nodes
    assert all(len(surface_points(node)) for node in graph.nodes)
    assert all(len(node.classes) <= 3 for node in graph.nodes)
    assert (out / "scene_graph.png").read_bytes().startswith(b"\x89PNG")
    page = (out / "scene_graph.html").read_text()
    assert graph.nodes[0].label in page
    assert load_config(out / "config.yaml").output.top_k == 3
    report = json.loads((out / "run.json").read_text())
    assert report["frames"] == {"images": 171, "processed": 12}
    assert report["nodes"] == len(graph.nodes)
    assert set(report["times_ms"]) >= {"perception", "masks", "lifting", "merging", "relations"}
    assert "12/12" in result.stdout
    assert "relation inference" in result.stdout
    assert report["device"]
    for name in ("scene_graph.html", "scene_graph.png", "scene_graph.json", "run.json"):
        assert name in result.stdout


def test_a_recording_without_a_usable_frame_is_an_error_with_reasons(tmp_path):
    items = [item for item in camera_items(3) if "depth" not in item[0]]
    items += [item for item in camera_items(9)[-4:] if "depth" in item[0]]
    write_bag(tmp_path / "bag", items)
    result = deworldsg(tmp_path, "run", "bag", "--out", "out", limit_s=360)
    assert result.returncode == 2
    assert "3 no_depth" in result.stdout
    assert "not one frame" in result.stderr


def test_a_closed_loop_corrects_the_poses_that_are_saved(tmp_path, monkeypatch):
    track, poses, shift = LoopOdometry.track, {}, rigid_motion(np.array([0.5, 0, 0]), np.zeros(3))

    def closing_at_the_fourth(odometry, stamp_ns, *image):
        T, _ = track(odometry, stamp_ns, *image)
        poses[stamp_ns] = T
        if len(poses) != 4:
            return T, None
        moved = shift @ np.array(list(poses.values()))
        return moved[-1], Trajectory(np.array(list(poses)), moved, np.tile(shift, (4, 1, 1)))

    monkeypatch.setattr(LoopOdometry, "track", closing_at_the_fourth)
    shown = printed(
        *("run", DEMO_ROOM, "--odometry", "--out", tmp_path / "out", "--max-frames", "4"),
        *("--save-trajectory", tmp_path / "poses.txt"),
    )
    assert "loop closed 1 time, last correction 50.0 cm" in shown
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert report["loops"] == "loop closed 1 time, last correction 50.0 cm"
    saved = read_trajectory(tmp_path / "poses.txt")
    assert saved.keys == tuple(poses)
    expected = shift @ np.array(list(poses.values()))
    np.testing.assert_allclose(saved.T_world_cameras, expected, atol=1e-6)


class Broken(FakeWorldModel):
    """A world model that fails on every clip."""

    def predict(self, request):
        raise RuntimeError("no memory left")


def test_a_failing_world_model_is_in_the_report_and_the_run_continues(tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "build_world_model", lambda config, device: Broken(16))
    options = ["--max-frames", "6", "--set", "relations.max_clips_per_s=0"]
    shown = printed("run", DEMO_ROOM, "--out", tmp_path, *options)
    clips = json.loads((tmp_path / "run.json").read_text())["clips"]
    failed = clips["dropped"]["world_model_error"]
    assert failed > 0 and clips["encoded"] == 0
    assert f"left out by world model: {failed} world_model_error" in shown


FILES = ("out/scene_graph.json", "out/scene_graph.html", "out/scene_graph.png", "room.map")
MACHINES = (
    {"PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    {"PYTHONHASHSEED": "4711", "OMP_NUM_THREADS": "3"},
)


@pytest.mark.timeout(600)
def test_files_are_equal_to_the_byte_whatever_the_threads_and_the_seed_of_hashes(tmp_path):
    found = []
    for number, machine in enumerate(MACHINES):
        folder = tmp_path / str(number)
        folder.mkdir()
        command = ["run", DEMO_ROOM, "--out", "out", "--map", "room.map", "--max-frames", 15]
        subprocess.run(
            [*COMMAND, *map(str, command)],
            cwd=folder,
            env={**environment(folder), **machine},
            check=True,
            capture_output=True,
            timeout=280,
        )
        found.append({name: (folder / name).read_bytes() for name in FILES})
    assert [name for name in FILES if found[0][name] != found[1][name]] == []


@pytest.fixture
def interrupts():
    """Ctrl-C interrupts, also in a process of xdist."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press_ctrl_c_at(monkeypatch, *frames):
    """Press it when these frames have been processed."""
    count = itertools.count(1)

    def add(album, frame):
        if next(count) in frames:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Album, "add", add)


def test_ctrl_c_leaves_the_results_of_the_frames_so_far(tmp_path, monkeypatch, interrupts):
    press_ctrl_c_at(monkeypatch, 6)
    result = invoke("run", DEMO_ROOM, "--out", tmp_path, "--map", tmp_path / "room.map")
    assert result.exit_code == 130
    assert "the results are those of 6 of 171 frames" in result.stdout
    assert json.loads((tmp_path / "run.json").read_text())["stopped"] is True
    assert read_graph(tmp_path).nodes and (tmp_path / "scene_graph.html").exists()
    assert (tmp_path / "room.map").exists()


def test_a_second_ctrl_c_ends_at_once_and_keeps_the_results_of_before(
    tmp_path, monkeypatch, interrupts
):
    assert invoke("run", DEMO_ROOM, "--out", tmp_path, "--max-frames", 8).exit_code == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    press_ctrl_c_at(monkeypatch, 3)
    monkeypatch.setattr(outputs, "show_graph", lambda *_: signal.raise_signal(signal.SIGINT))
    assert invoke("run", DEMO_ROOM, "--out", tmp_path).exit_code == 130
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
