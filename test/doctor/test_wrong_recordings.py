"""`deworldsg doctor` and `run` on bags that are made wrong on purpose."""

from __future__ import annotations

import json
from collections import Counter
from itertools import islice

import pytest
from support.cli import DEMO_ROOM
from support.wrong import WRONG, write_wrong
from typer.testing import CliRunner

from deworldsg_ros.cli.app import app
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.recordings.recording import open_recording

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]


@pytest.fixture(scope="module")
def frames():
    recording = open_recording(DEMO_ROOM)
    yield list(islice(recording.frames(), 60))
    recording.close()


@pytest.fixture
def examine(frames, tmp_path):
    """The exit code and the output of a command on a wrong recording."""

    def call(name, *command):
        bag = write_wrong(WRONG[name](frames), tmp_path / f"{name}.mcap")
        result = CliRunner().invoke(app, [*command[:1], str(bag), *map(str, command[1:])])
        return result.exit_code, " ".join((result.stdout + result.stderr).split())

    return call


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("one frame", "Only 1 frame reached the graph"),
        ("still", "The camera stands still (0 cm, 0 degrees)"),
        ("depth by 5", "multiplied by 5"),
        ("no depth", "of the pixels have a depth"),
        ("shifted depth", "The edges of depth are about 24 pixels away"),
        ("jumping poses", "The pose jumped at"),
        ("late poses", "0.4 s later"),
        ("dark", "It knows 80 classes: person"),
    ],
)
def test_doctor_names_what_is_wrong(examine, name, words):
    code, output = examine(name, "doctor")
    assert words in output
    assert code == 3, output


def test_doctor_says_that_nothing_is_off(examine):
    code, output = examine("right", "doctor")
    assert "nothing is off" in output
    assert code == 0


def test_a_colour_topic_as_depth_is_an_error(examine):
    code, output = examine("right", "doctor", "--depth", "/rgb/image_raw")
    assert code == 2
    assert "is a picture" in output


def test_a_camera_on_its_side_gives_the_same_objects(examine, tmp_path):
    labels = {}
    for name in ("right", "on its side"):
        out = tmp_path / "out" / name
        code, output = examine(name, "run", "--out", out)
        assert code == 0, output
        graph = read_graph(out)
        labels[name] = Counter(node.label for node in graph.nodes)
        findings = json.loads((out / "run.json").read_text())["findings"]
        assert [item["code"] for item in findings] == ["turned"] * (name != "right")
        assert ("note: The camera is turned by 90 degrees in 60 frames" in output) is bool(findings)
    # Pixels are sampled in another order: an object at the threshold may differ.
    assert (labels["on its side"] & labels["right"]).total() >= labels["right"].total() - 1 > 8


def test_doctor_wants_a_recording_or_running_nodes():
    for arguments in ([], [str(DEMO_ROOM), "--live"]):
        result = CliRunner().invoke(app, ["doctor", *arguments])
        assert result.exit_code == 2
        assert "expected either a RECORDING or --live" in result.stderr
