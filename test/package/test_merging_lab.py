"""tools/merging_lab: a replay of captured local graphs equals the evaluation of the frames."""

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from support.recordings import write_seven_scenes
from support.sequences import write_room

from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.front_ends import Faults, FrontEndChoice
from deworldsg_ros.evaluation.runner import ScanTask, evaluate_scan
from deworldsg_ros.evaluation.scoring import ProtocolOptions
from deworldsg_ros.graph.graph_files import read_graph

NAMES = ("captures", "capture", "replay")


@pytest.fixture(scope="module")
def lab(root_dir):
    """The modules of the tool."""
    path = list(sys.path)
    sys.path.insert(0, str(root_dir / "tools" / "merging_lab"))
    yield SimpleNamespace(**{name: importlib.import_module(name) for name in NAMES})
    sys.path[:] = path
    for name in NAMES:
        del sys.modules[name]


def captured(lab: Any, source: Path, folder: Path, *arguments: str) -> list[str]:
    """Names of the captures that the command wrote."""
    lab.capture.main([str(source), "--out", str(folder), *arguments])
    return sorted(path.name for path in folder.iterdir())


# The wrong label of one object lasts longer than the frames.
@pytest.mark.parametrize(
    ("kind", "faults", "seen"), [("clean", Faults(), 3), ("label", Faults(label=0.1), 2)]
)
def test_the_replay_of_a_capture_is_the_graph_of_the_evaluation(lab, tmp_path, kind, faults, seen):
    rooms, out = write_room(tmp_path / "rooms", frames=6), tmp_path / "out"
    names = captured(lab, rooms, tmp_path / "cap", "--kinds", kind)
    assert names == [f"room_0.{kind}.pkl"]
    capture = lab.captures.read_capture(tmp_path / "cap" / names[0])
    replayed = lab.replay.replay(capture, Config())
    choice = FrontEndChoice("recorded", faults=faults)
    outcome = evaluate_scan(
        ScanTask(rooms, "replica", "room_0", out, Config(), choice, ProtocolOptions())
    )
    graph = read_graph(out / "room_0")
    assert msgspec.json.encode(replayed.graph) == msgspec.json.encode(graph)
    score = lab.replay.score(capture, replayed)
    assert (score.results, score.measures) == ([outcome.result], outcome.measures)
    assert score.seen == seen


def test_a_recording_without_annotation_has_a_line_of_labels(lab, tmp_path, capsys):
    kitchen = write_seven_scenes(tmp_path / "kitchen", 3)
    options = ("--min-score", "0.2", "--settings", "perception.threads=1")
    assert captured(lab, kitchen, tmp_path / "cap", *options) == ["kitchen.backend-0.2.pkl"]
    with pytest.raises(SystemExit, match="kind bleed"):
        captured(lab, kitchen, tmp_path / "cap", "--kinds", "bleed")
    lab.replay.main([str(tmp_path / "cap")])
    assert "0 nodes" in capsys.readouterr().out
