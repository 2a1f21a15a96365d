"""The shipped recording, made wrong on purpose: what its frames, `doctor` and `run` say."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from itertools import islice

import pytest
from support.cli import DEMO_ROOM
from support.wrong import WRONG, write_wrong
from typer.testing import CliRunner

from deworldsg_ros.cli.app import app
from deworldsg_ros.doctor import FrameSampler, Observations, find
from deworldsg_ros.graph.graph_files import read_graph
from deworldsg_ros.recordings.recording import open_recording

pytestmark = pytest.mark.timeout(400)


@pytest.fixture(scope="module")
def frames():
    recording = open_recording(DEMO_ROOM)
    yield list(islice(recording.frames(), 60))
    recording.close()


@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        *[(name, None, "") for name in ("right", "on its side", "one frame", "still", "dark")],
        ("depth times 10", "depth_unit", "multiplied by 0.1"),
        ("depth by 5", "depth_unit", "multiplied by 5"),
        ("shifted depth", "not_registered", "24 pixels away"),
        ("no depth", "little_depth", "depth_scale"),
        ("late poses", "late_poses", "0.4 s later"),
        ("poses of the body", "poses_of_the_body", "x is taken as forward"),
        ("inverse poses", "poses_inverted", "inverse"),
        ("other poses", "poses_do_not_fit", "not those of this camera"),
    ],
)
def test_the_frames_tell_what_is_wrong_and_nothing_else(frames, name, code, words):
    """No detector runs."""
    sampler = FrameSampler()
    for frame in WRONG[name](frames[:50]):
        sampler.add(frame)
    findings = find(Observations(checks=sampler.checks()))
    assert [finding.code for finding in findings] == ([] if code is None else [code])
    assert words in " ".join(map(str, findings))


def test_a_few_frames_are_kept_of_many_and_none_of_none(frames):
    sampler = FrameSampler()
    assert sampler.checks() is None
    for index in range(40):
        for frame in frames[:10]:
            sampler.add(replace(frame, stamp_ns=frame.stamp_ns + 2 * 10**9 * index))
    assert len(sampler._pairs) <= 12
    assert sampler.checks() is not None


@pytest.fixture
def examine(frames, tmp_path):
    """The exit code and the output of a command on a wrong recording."""

    def call(name, *command):
        bag = write_wrong(WRONG[name](frames), tmp_path / f"{name}.mcap")
        result = CliRunner().invoke(app, [*command[:1], str(bag), *map(str, command[1:])])
        return result.exit_code, " ".join((result.stdout + result.stderr).split())

    return call


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        ("right", 0, "nothing is off"),
        ("one frame", 3, "Only 1 frame reached the graph"),
        ("still", 3, "The camera stands still (0 cm, 0 degrees)"),
        ("jumping poses", 3, "The pose jumped at"),
        ("depth by 5", 3, "multiplied by 5"),
        ("dark", 3, "It knows 80 classes: person"),
    ],
)
def test_doctor_names_what_is_wrong(examine, name, code, words):
    exit_code, output = examine(name, "doctor")
    assert words in output
    assert exit_code == code, output


@pytest.mark.slow
def test_a_camera_on_its_side_gives_the_same_objects(examine, tmp_path):
    labels = {}
    for name in ("right", "on its side"):
        out = tmp_path / "out" / name
        code, output = examine(name, "run", "--out", out)
        assert code == 0, output
        labels[name] = Counter(node.label for node in read_graph(out).nodes)
        findings = json.loads((out / "run.json").read_text())["findings"]
        assert [item["code"] for item in findings] == ["turned"] * (name != "right")
        assert ("note: The camera is turned by 90 degrees in 60 frames" in output) is bool(findings)
    # Pixels are sampled in another order: an object at the threshold may differ.
    assert (labels["on its side"] & labels["right"]).total() >= labels["right"].total() - 1 > 8


@pytest.mark.parametrize("arguments", [[], [str(DEMO_ROOM), "--live"]])
def test_doctor_wants_a_recording_or_running_nodes(arguments):
    result = CliRunner().invoke(app, ["doctor", *arguments])
    assert result.exit_code == 2
    assert "either a RECORDING or --live" in result.stderr
