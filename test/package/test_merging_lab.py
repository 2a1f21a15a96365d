"""tools/merging_lab: a replay of captured local graphs equals the evaluation of the frames."""

import importlib
import sys

import msgspec
import pytest
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
    yield [importlib.import_module(name) for name in NAMES]
    sys.path[:] = path
    for name in NAMES:
        del sys.modules[name]


# The wrong label of one object lasts longer than the frames.
@pytest.mark.parametrize(
    ("kind", "faults", "seen"), [("clean", Faults(), 3), ("label", Faults(label=0.1), 2)]
)
def test_the_replay_of_a_capture_is_the_graph_of_the_evaluation(lab, tmp_path, kind, faults, seen):
    captures, capturing, replaying = lab
    rooms, folder, out = write_room(tmp_path / "rooms", 6), tmp_path / "cap", tmp_path / "out"
    capturing.main([str(rooms), "--out", str(folder), "--kinds", kind])
    (path,) = folder.iterdir()
    assert path.name == f"room_0.{kind}.pkl"
    capture = captures.read_capture(path)
    replayed = replaying.replay(capture, Config())
    choice = FrontEndChoice("recorded", faults=faults)
    outcome = evaluate_scan(
        ScanTask(rooms, "replica", "room_0", out, Config(), choice, ProtocolOptions())
    )
    graph = read_graph(out / "room_0")
    assert msgspec.json.encode(replayed.graph) == msgspec.json.encode(graph)
    score = replaying.score(capture, replayed)
    assert (score.results, score.measures) == ([outcome.result], outcome.measures)
    assert score.seen == seen
