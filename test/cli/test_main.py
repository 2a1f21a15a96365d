"""Options, refusals, and the commands that look at recordings and configurations."""

import json
import re
from pathlib import Path

import pytest
from support.cli import deworldsg, invoke, printed, refusal
from support.recordings import camera_items, write_bag, write_seven_scenes

import deworldsg_ros
from deworldsg_ros.cli.configuration import described_yaml, effective_config
from deworldsg_ros.cli.run import RunOptions, _check_paths
from deworldsg_ros.config import Config, load_config
from deworldsg_ros.recordings.recording import open_recording


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty folder, in which the commands run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    return tmp_path


def test_version_help_and_an_error_of_one_sentence(folder):
    assert deworldsg(folder, "--version").stdout == f"deworldsg {deworldsg_ros.__version__}\n"
    shown = deworldsg(folder, "--help").stdout.split("Commands:")[1]
    lines = re.findall(r"^  (?:[a-z]\S*) +\S.*$", shown, re.MULTILINE)
    assert {line.split()[0] for line in lines} >= {"run", "demo", "convert", "info", "config"}
    assert not [line for line in lines if line.endswith(("...", "…"))]
    result = deworldsg(folder, "run", "nowhere", "--out", "x")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("error: ")


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["run", "nowhere", "--out", "x"], "nowhere"),
        (["run", "nowhere"], "--out"),
        (["run", ".", "--out", "x", "--intrinsics", "1,2"], "FX,FY,CX,CY"),
        (["run", ".", "--out", "x", "--intrinsics", "nan,1,2,3"], "FX and FY above 0"),
        (["demo", "nowhere"], "nowhere"),
        (["info", "nowhere"], "nowhere"),
        (["convert", "tum", "nowhere", "x.mcap"], "nowhere"),
        (["convert", "kitti", ".", "x.mcap"], "7scenes"),
        (["convert", "auto", ".", "x.bag"], ".mcap"),
        (["convert", "auto", ".", "x.mcap", "--depth-source", "laser"], "rendered"),
        (["config", "--set", "tau"], "section.field=value"),
        (["config", "--set", "tau=0.1"], "did you mean lifting.tau?"),
        (["config", "--set", "lifting.tauu=1"], "did you mean lifting.tau?"),
        (["config", "--set", "score_treshold=0.1"], "did you mean perception.score_threshold?"),
        (["config", "--set", "lifting.min_existence=0"], "did you mean output.min_existence?"),
        (["config", "--set", "lifting.tau=2"], "lifting.tau: relative tolerance"),
        (["config", "--set", "lifting.tau=wide"], "[>= 0, <= 1]"),
        (["config", "--set", "lifting.tau=yes"], "lifting.tau"),
        (["config", "--set", "relations.clip_length=many"], "relations.clip_length"),
        (["config", "--set", "output.include_surface_points=3"], "include_surface_points"),
        (["config", "--config", "nowhere.yaml"], "nowhere.yaml"),
        (["dance"], "dance"),
    ],
)
def test_what_is_refused_and_nothing_is_made_on_the_way(folder, command, words):
    assert words in refusal(*command)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("perception: {treshold: 1}", "perception.treshold (did you mean perception.score_thresh"),
        ("percepton: {threads: 1}", "percepton (did you mean perception?)"),
    ],
)
def test_a_misspelt_option_of_a_file_is_named_with_the_one_that_is_meant(content, words):
    Path("c.yaml").write_text(content)
    assert words in refusal("config", "--config", "c.yaml")


def test_convert_makes_a_bag_that_info_and_run_understand(folder):
    write_seven_scenes(folder / "kitchen", 5)
    assert "20 messages" in printed("convert", "auto", "kitchen", "kitchen.mcap", "--rate", 5)
    frames = list(open_recording(folder / "kitchen.mcap").frames())
    assert [frame.stamp_ns for frame in frames] == [10**9 + 2 * 10**8 * i for i in range(5)]
    shown = printed("info", "kitchen.mcap")
    for line in (
        r"kitchen\.mcap: rosbag2, 5 RGB images",
        r"/rgb/image_raw/compressed +CompressedImage +5 +rgb",
        r"/camera/pose +PoseStamped +5 +pose",
    ):
        assert re.search(line, shown), shown
    assert "exists already" in refusal("convert", "auto", "kitchen", "kitchen.mcap")


def test_no_output_replaces_what_the_recording_has(folder):
    write_seven_scenes(folder / "kitchen", 5)
    pose = folder / "kitchen" / "frame-000000.pose.txt"
    before = pose.read_bytes()
    words = ("run", "kitchen", "--rate", 5, "--out", "kitchen/out")
    assert "of the recording" in refusal(*words, "--save-trajectory", pose)
    assert pose.read_bytes() == before
    printed("convert", "auto", "kitchen", "kitchen.mcap", "--rate", 5)
    words = ("run", "kitchen.mcap", "--out", "out", "--save-trajectory", "kitchen.mcap")
    assert "of the recording" in refusal(*words)
    for rate in ("inf", "1e308", "1e-300"):
        assert "rate is" in refusal("convert", "auto", "kitchen", "other.mcap", "--rate", rate)


def test_results_may_lie_in_the_folder_of_the_recording(folder):
    (folder / "kitchen" / "out").mkdir(parents=True)
    (folder / "kitchen" / "out" / "scene_graph.json").write_text("{}")
    (folder / "kitchen" / "room.map").write_text("")
    (folder / "kitchen" / "way.txt").write_text("")
    kitchen = Path("kitchen")
    _check_paths(RunOptions(kitchen, kitchen / "out", trajectory_out=kitchen / "way.txt",
                            map_path=kitchen / "room.map"))  # fmt: skip


def test_info_of_recordings_that_lack_something(folder):
    write_bag(folder / "no_depth", [item for item in camera_items(2) if "depth" not in item[0]])
    result = invoke("info", "no_depth")
    assert result.exit_code == 2 and "no depth topic" in result.stderr
    assert "/camera/color/camera_info" in result.stdout
    write_bag(folder / "no_pose", camera_items(2, with_pose=False))
    assert "--odometry" in printed("info", "no_pose")
    assert "--odometry" in refusal("convert", "auto", "no_pose", "out.mcap")
    file = write_bag(folder / "cut", camera_items(40)) / "cut.mcap"
    file.write_bytes(file.read_bytes()[:40_000])
    assert "lost:" in printed("info", file)


def test_the_printed_configuration_reads_back_equal_and_describes_each_option(folder):
    assert effective_config(None) == Config()
    config = effective_config(None, ["lifting.tau=0.1", "output.include_surface_points=true"])
    assert (config.lifting.tau, config.output.include_surface_points) == (0.1, True)
    path = folder / "config.yaml"
    path.write_text(described_yaml(config))
    assert load_config(path) == config
    shown = printed("config", "--config", path)
    assert shown == described_yaml(config)
    lines = [line.strip() for line in shown.splitlines() if line.startswith("      ")]
    for before, line in zip(lines, lines[1:]):
        assert line.startswith("#") or before.startswith("# "), line


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("inputs.world_up=y", "y"),
        ("inputs.max_depth_m=5", 5.0),
        ("relations.clip_length=8", 8),
        ("inputs.world_frame=on", "on"),
    ],
)
def test_settings_have_the_type_of_their_field(setting, value):
    section, _, field = setting.partition("=")[0].partition(".")
    found = getattr(getattr(effective_config(None, [setting]), section), field)
    assert (found, type(found)) == (value, type(value))


def test_what_a_file_of_weights_says_cannot_write_on_the_terminal(tmp_path):
    entries = {"a[red]\x1b[2J": {"dtype": "F32\x1b[31m\nfine", "shape": [2, 3]}}
    header = json.dumps(entries).encode()
    path = tmp_path / "model.safetensors"
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    shown = printed("models", "inspect", path)
    assert "\x1b" not in shown and "a[red]" in shown and len(shown.splitlines()) == 2


@pytest.mark.parametrize("claimed", [3, 99_999_999, 2**64 - 1])
def test_a_header_that_is_not_there_is_refused(tmp_path, claimed):
    path = tmp_path / "model.safetensors"
    path.write_bytes(claimed.to_bytes(8, "little") + b"{}")
    assert "of which 2 are there" in refusal("models", "inspect", path)
