"""Commands, options, and the messages for errors of the user."""

from __future__ import annotations

import io
import re

import pytest
import typer.testing
from rich.console import Console
from support.cli import deworldsg
from support.recordings import camera_items, write_bag, write_seven_scenes

import deworldsg_ros
from deworldsg_ros.cli.app import app
from deworldsg_ros.cli.configuration import described_yaml, effective_config
from deworldsg_ros.cli.terminal import working
from deworldsg_ros.config import Config, load_config
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.scene.errors import ConfigurationError


@pytest.fixture
def invoke(tmp_path, monkeypatch):
    """A command in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")

    def call(*arguments):
        return typer.testing.CliRunner().invoke(app, list(map(str, arguments)))

    return call


def test_an_error_is_one_sentence_without_a_traceback(tmp_path):
    result = deworldsg(tmp_path, "run", "nowhere", "--out", "x")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("error: ")


def test_version_and_help(tmp_path):
    assert deworldsg(tmp_path, "--version").stdout == f"deworldsg {deworldsg_ros.__version__}\n"
    result = deworldsg(tmp_path, "--help")
    assert result.returncode == 0
    lines = re.findall(r"^  (?:[a-z]\S*) +\S.*$", result.stdout.split("Commands:")[1], re.MULTILINE)
    assert {line.split()[0] for line in lines} >= {"run", "demo", "convert", "info", "config"}
    assert not [line for line in lines if line.endswith(("...", "…"))]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "nowhere", "--out", "x"], "nowhere"),
        (["run", "nowhere"], "--out"),
        (["demo", "nowhere"], "nowhere"),
        (["info", "nowhere"], "nowhere"),
        (["convert", "tum", "nowhere", "x.mcap"], "nowhere"),
        (["convert", "kitti", ".", "x.mcap"], "7scenes"),
        (["convert", "auto", ".", "x.bag"], ".mcap"),
        (
            ["convert", "auto", ".", "x.mcap", "--depth-source", "laser"],
            "expected auto, rendered, sensor",
        ),
        (["config", "--set", "lifting.tauu=1"], "did you mean lifting.tau?"),
        (["config", "--set", "tau=0.1"], "did you mean lifting.tau?"),
        (["config", "--set", "score_treshold=0.1"], "did you mean perception.score_threshold?"),
        (["config", "--set", "lifting.min_existence=0"], "did you mean output.min_existence?"),
        (["config", "--set", "lifting.tau=2"], "expected for lifting.tau: relative tolerance"),
        (["config", "--set", "lifting.tau=wide"], "[>= 0, <= 1]"),
        (["config", "--set", "tau"], "section.field=value"),
        (["config", "--config", "nowhere.yaml"], "nowhere.yaml"),
        (["run", ".", "--out", "x", "--intrinsics", "1,2"], "FX,FY,CX,CY"),
        (["run", ".", "--out", "x", "--intrinsics", "nan,1,2,3"], "FX and FY above 0"),
        (["dance"], "dance"),
    ],
)
def test_errors_are_one_sentence_and_exit_code_2(invoke, tmp_path, arguments, words):
    result = invoke(*arguments)
    assert result.exit_code == 2, result.output
    assert words in result.stderr
    assert result.exception is None or isinstance(result.exception, SystemExit)
    # Nothing was made on the way.
    assert [path.name for path in tmp_path.iterdir() if path.name != "ros"] == []


def test_convert_makes_a_bag_that_info_and_run_understand(invoke, tmp_path):
    folder = write_seven_scenes(tmp_path / "kitchen", 5)
    result = invoke("convert", "auto", folder, "kitchen.mcap", "--rate", 5)
    assert result.exit_code == 0, result.stderr
    assert "20 messages" in result.stdout
    frames = list(open_recording(tmp_path / "kitchen.mcap").frames())
    assert [frame.stamp_ns for frame in frames] == [10**9 + 2 * 10**8 * i for i in range(5)]
    result = invoke("info", "kitchen.mcap")
    assert result.exit_code == 0
    for line in (
        r"kitchen\.mcap: rosbag2, 5 RGB images",
        r"/rgb/image_raw/compressed +CompressedImage +5 +rgb",
        r"/camera/pose +PoseStamped +5 +pose",
    ):
        assert re.search(line, result.stdout), result.stdout
    again = invoke("convert", "auto", folder, "kitchen.mcap")
    assert again.exit_code == 2
    assert "exists already" in again.stderr


def test_info_shows_the_topics_even_if_one_is_missing(invoke, tmp_path):
    write_bag(tmp_path / "bag", [item for item in camera_items(2) if "depth" not in item[0]])
    result = invoke("info", "bag")
    assert result.exit_code == 2
    assert "/camera/color/camera_info" in result.stdout
    assert "no depth topic" in result.stderr


def test_info_explains_how_to_use_a_recording_without_poses(invoke, tmp_path):
    write_bag(tmp_path / "bag", camera_items(2, with_pose=False))
    result = invoke("info", "bag")
    assert result.exit_code == 0
    assert re.search(r"/camera/color/camera_info +CameraInfo +2 +camera_info", result.stdout)
    assert "--odometry" in result.stdout
    assert "--odometry" in invoke("convert", "auto", "bag", "out.mcap").stderr


def test_info_takes_the_options_of_run(invoke, tmp_path):
    items = [item for item in camera_items(1, compressed=False) if "info" not in item[0]]
    renamed = [(topic.replace("depth", "range"), *rest) for topic, *rest in items]
    write_bag(tmp_path / "bag", renamed)
    assert "no depth topic" in invoke("info", "bag", "--intrinsics", "60,61,31.5,23.5").stderr
    given = ("--depth", "/camera/range/image_raw", "--intrinsics", "60,61,31.5,23.5")
    result = invoke("info", "bag", *given)
    assert result.exit_code == 0, result.stderr
    assert "1 RGB image\n" in result.stdout
    assert re.search(r"/camera/range/image_raw .* depth", result.stdout)


def test_a_misspelt_option_of_a_file_is_named_with_the_one_that_is_meant(invoke, tmp_path):
    for content, words in (
        ("perception: {treshold: 1}", "perception.treshold (did you mean perception.score_thresh"),
        ("percepton: {threads: 1}", "no section percepton (did you mean perception?)"),
    ):
        (tmp_path / "c.yaml").write_text(content)
        result = invoke("config", "--config", "c.yaml")
        assert result.exit_code == 2
        assert words in result.stderr


def test_info_reports_lost_data(invoke, tmp_path):
    write_bag(tmp_path / "bag", camera_items(40))
    file = tmp_path / "bag" / "bag.mcap"
    file.write_bytes(file.read_bytes()[:40_000])
    result = invoke("info", file)
    assert result.exit_code == 0, result.stderr
    assert "lost:" in result.stdout


def test_the_printed_configuration_reads_back_equal(invoke, tmp_path):
    config = effective_config(None, ["lifting.tau=0.1", "output.include_surface_points=true"])
    path = tmp_path / "config.yaml"
    path.write_text(described_yaml(config))
    assert load_config(path) == config
    assert config.lifting.tau == 0.1
    assert config.output.include_surface_points is True
    result = invoke("config", "--config", path)
    assert result.stdout == described_yaml(config)
    for number, line in enumerate(result.stdout.splitlines()):
        if line.startswith("      ") and not line.strip().startswith("#"):
            assert result.stdout.splitlines()[number - 1].strip().startswith("# "), line


@pytest.mark.parametrize(
    ("setting", "section", "field", "value"),
    [
        ("inputs.world_up=y", "inputs", "world_up", "y"),
        ("inputs.max_depth_m=5", "inputs", "max_depth_m", 5.0),
        ("relations.clip_length=8", "relations", "clip_length", 8),
        ("inputs.world_frame=on", "inputs", "world_frame", "on"),
    ],
)
def test_single_settings_keep_the_type_of_their_field(setting, section, field, value):
    found = getattr(getattr(effective_config(None, [setting]), section), field)
    assert found == value
    assert type(found) is type(value)


def test_a_setting_of_the_wrong_type_is_refused():
    for setting in (
        "relations.clip_length=many",
        "lifting.tau=yes",
        "output.include_surface_points=3",
    ):
        with pytest.raises(ConfigurationError, match=setting.split("=")[0].split(".")[1]):
            effective_config(None, [setting])


def test_the_shipped_default_is_used_without_a_file():
    assert effective_config(None) == Config()


def test_without_a_terminal_the_text_of_the_spinner_is_printed():
    console = Console(file=io.StringIO())
    with working(console, "loading …"):
        pass
    assert console.file.getvalue() == "loading …\n"
