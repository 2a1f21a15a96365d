"""tools/merging_lab: a replay of captured local graphs equals the evaluation of the frames."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from support.recordings import write_seven_scenes
from support.sequences import write_room

from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.edge_measures import ReferenceScene
from deworldsg_ros.evaluation.front_ends import Faults, FrontEndChoice
from deworldsg_ros.evaluation.runner import ScanTask, evaluate_scan
from deworldsg_ros.evaluation.scoring import ProtocolOptions
from deworldsg_ros.graph.graph_files import read_graph

NAMES = ("captures", "capture", "replay")


@pytest.fixture(scope="module")
def lab(root_dir: Path) -> Iterator[SimpleNamespace]:
    """The modules of the tool."""
    path = list(sys.path)
    sys.path.insert(0, str(root_dir / "tools" / "merging_lab"))
    yield SimpleNamespace(**{name: importlib.import_module(name) for name in NAMES})
    sys.path[:] = path
    for name in NAMES:
        del sys.modules[name]


@pytest.fixture
def rooms(tmp_path: Path) -> Path:
    return write_room(tmp_path / "rooms", frames=6)


def captured(lab: Any, rooms: Path, folder: Path, *arguments: str) -> list[str]:
    """Names of the captures that the command wrote."""
    lab.capture.main([str(rooms), "--out", str(folder), *arguments])
    return sorted(path.name for path in folder.iterdir())


# The wrong label of one object lasts longer than the frames.
@pytest.mark.parametrize(
    ("kind", "faults", "seen"), [("clean", Faults(), 3), ("label", Faults(label=0.1), 2)]
)
def test_the_replay_of_a_capture_is_the_graph_of_the_evaluation(
    lab: Any, rooms: Path, tmp_path: Path, kind: str, faults: Faults, seen: int
) -> None:
    names = captured(lab, rooms, tmp_path / "cap", "--kinds", kind)
    assert names == [f"room_0.{kind}.pkl"]
    capture = lab.captures.read_capture(tmp_path / "cap" / names[0])
    assert all(ids.tolist() == [3, 2, 1] for ids in capture.object_ids)
    replayed = lab.replay.replay(capture, Config())
    choice = FrontEndChoice("recorded", faults=faults)
    out = tmp_path / "out"
    outcome = evaluate_scan(
        ScanTask(rooms, "replica", "room_0", out, Config(), choice, ProtocolOptions())
    )
    graph = read_graph(out / "room_0")
    assert msgspec.json.encode(replayed.graph) == msgspec.json.encode(graph)
    score = lab.replay.score(capture, replayed)
    assert score.results == [outcome.result]
    assert score.measures == outcome.measures
    assert score.seen == seen


def test_a_row_is_printed_and_written_for_each_capture(
    lab: Any, rooms: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, numbers = tmp_path / "cap", tmp_path / "numbers.json"
    arguments = ("--kinds", "clean,flip", "--every", "2")
    names = captured(lab, rooms, folder, *arguments)
    assert names == ["room_0.clean.every2.pkl", "room_0.flip.every2.pkl"]
    captured(lab, rooms, folder, *arguments)
    assert "room_0.flip.every2: exists" in capsys.readouterr().out
    lab.replay.main(
        [str(folder), "--only", "*.clean*", "--missed", "--json", str(numbers), "--settings"]
        + ["output.min_existence=0.9"]
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:5] == ["room_0.clean.every2", "3", "3", "0", "0"]
    # Three frames are too few for a node: all detections of an object went to a tentative one.
    assert [line.partition(";")[2] for line in lines if "detections" in line] == [
        f" 3 in no published node {number}" for number in (3, 2, 1)
    ]
    assert json.loads(numbers.read_text())["room_0.clean.every2"]["found"] == 0


def test_a_recording_without_annotation_has_a_line_of_labels(
    lab: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_seven_scenes(tmp_path / "kitchen", 3)
    arguments = ("--min-score", "0.2", "--settings", "perception.threads=1")
    assert captured(lab, folder, tmp_path / "cap", *arguments) == ["kitchen.backend-0.2.pkl"]
    lab.replay.main([str(tmp_path / "cap")])
    assert "0 nodes" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="kind bleed"):
        captured(lab, folder, tmp_path / "cap", "--kinds", "bleed")


def node(existence: float | None, label: str, x: float) -> SimpleNamespace:
    stated = {} if existence is None else {"existence": existence}
    return SimpleNamespace(label=label, mean_m=[x, 0.0, 0.0], **stated)


@pytest.mark.parametrize(
    ("nodes", "expected"),
    [
        ([], []),
        ([node(None, "cup", 0)], []),
        ([node(0.4, "cup", 0), node(0.9, "cup", 0.1)], [(0.9, True), (0.4, False)]),
        ([node(0.7, "cup", 2), node(0.6, "book", 0)], [(0.7, False), (0.6, False)]),
    ],
    ids=["empty", "no field", "the surest is the first", "elsewhere or wrong"],
)
def test_existence_is_compared_with_the_first_node_of_an_object(
    lab: Any, nodes: list[Any], expected: list[tuple[float, bool]]
) -> None:
    half = np.full((1, 3), 0.2)
    reference = ReferenceScene([1], ["cup"], -half, half, np.zeros((1, 3)), frozenset(), exact=True)
    beliefs = lab.replay.existence_beliefs(nodes, reference)
    assert [tuple(belief) for belief in beliefs] == expected
    assert bool(lab.replay.calibration_lines(beliefs)) == bool(expected)
