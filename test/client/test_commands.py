"""The commands that ask, compare, merge and edit graphs."""

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from support.cli import invoke, printed, refusal
from support.merging import VOCABULARY
from support.surfaces import CUP, HERE, view
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.client.combine import combine
from deworldsg_ros.config import Config, MergingConfig
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import claim_map, read_map, write_first_id, write_map
from deworldsg_ros.scene.camera import invert_pose, rigid_motion
from deworldsg_ros.wire import messages as wire


def test_questions_goals_and_explanations_are_tables_and_json(demo_out):
    assert "cup #13" in printed("query", demo_out, "cup", "on", "dining", "table")
    (answer,) = json.loads(printed("query", demo_out, "banana", "--json"))["answers"]
    assert answer["sure"] is False
    assert answer["odds"].startswith("1 : ")
    assert "not sure" in printed("query", demo_out, "banana")
    goal = json.loads(printed("goal", demo_out, "cup", "--json"))
    assert set(goal["pose"]) == {"position", "orientation"}
    assert "stand at" in printed("goal", demo_out, "13", "--distance", "0.8")
    assert "seen, and judged" in printed("explain", demo_out, "13", "5")
    assert json.loads(printed("explain", demo_out, "elephant", "--json"))["hidden"] == []


def test_graphs_are_merged_compared_and_exported(demo_out, room):
    T = rigid_motion(np.array([1.0, 2.0, 0.0]), np.array([0.0, 0.0, 0.5]))
    Path("other.json").write_text(wire.encode(combine(SceneGraph(make_graph()), room, T).message))
    merged = printed("merge", demo_out, "other.json", "both.json")
    assert "transform found" in merged
    assert "34 of the 34 and 34" in merged
    x, y, z = invert_pose(T)[:3, 3]
    told = ("--transform", f"{x},{y},{z},-28.648")
    assert "34 of the 34 and 34" in printed("merge", demo_out, "other.json", "b.json", *told)
    assert printed("diff", demo_out, "both.json") == "unchanged: 34 objects\n"
    changes = json.loads(printed("diff", demo_out, "other.json", "--json"))
    assert changes["moved"] or changes["gone"]
    assert "graph.csv" in printed("export", "csv", demo_out, "graph.csv")


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (["query", "nowhere", "cup"], "nowhere"),
        (["query", "demo_out"], "a question"),
        (["query", "demo_out", "cup on"], "at the end"),
        (["goal", "demo_out", "elephant"], "'elephant'"),
        (["goal", "demo_out", "cup", "--distance", "-1"], "positive"),
        (["explain", "demo_out", "99"], "99"),
        (["merge", "demo_out", "demo_out", "x", "--transform", "1,2"], "1,2"),
        (["mcp"], "--live"),
        (["mcp", "demo_out", "--live"], "--live"),
    ],
)
@pytest.mark.usefixtures("demo_out")
def test_what_is_refused(command, words):
    assert words in refusal(*command)


@pytest.mark.parametrize(
    "command",
    [
        ["explain", "a", "1"], ["explain", "a", "1", "2"], ["explain", "a", "1", "--json"],
        ["query", "a", "table"], ["query", "a", "sofa"], ["goal", "a", "1"], ["goal", "a", "2"],
        ["diff", "a", "b"], ["diff", "b", "a"], ["diff", "b", "a", "--json"],
        ["explain", "a", "\x1b[2J"],
    ],
)  # fmt: skip
def test_the_terminal_shows_names_as_text(command, monkeypatch):
    hostile = "cup\nelement vertex 9\x1b[2J\x00\ufffe"
    nodes = [make_node(1, hostile), make_node(2, "table", (0.4, 0, 0))]
    graphs = {"a": make_graph(nodes, [make_edge(1, 2, hostile)], hostile), "b": make_graph()}
    monkeypatch.setattr(SceneGraph, "load", lambda path: SceneGraph(graphs[path.name]))
    shown = invoke(*command)
    text = shown.stdout + shown.stderr
    assert "1b[2J" in text.replace("\n", "")
    assert not re.search(r"[\x00-\x09\x0b-\x1f]", text)
    assert "\nelement" not in text


def saved_map(folder: Path, config: Config) -> Path:
    builder = GraphBuilder(config, VOCABULARY, "world")
    for stamp in range(1, 8):
        builder.integrate(view(stamp, (HERE, CUP)))
    write_map(builder, folder / "room.map")
    return folder / "room.map"


@pytest.mark.parametrize("association", ["surface", "paper"])
def test_a_map_is_edited_and_the_edit_undone(tmp_path, association):
    config = Config(merging=MergingConfig(association=association))
    path = saved_map(tmp_path, config)
    before = read_map(config, path).full()
    assert printed("edit", path, "set_label", "#1", "chair") == "object 1 is a 'chair'\n"
    (node,) = read_map(config, path).full().nodes
    assert (node.label, node.label_provenance) == ("chair", "operator")
    printed("edit", path, "delete", "1")
    assert read_map(config, path).full().nodes == []
    for _ in range(2):
        printed("edit", path, "undo")
    assert read_map(config, path).full() == before


def test_an_edit_of_a_map_gives_no_id_that_was_published(tmp_path):
    path = saved_map(tmp_path, Config())
    write_first_id(path, 70)  # as of a node that was killed since
    answer = json.loads(printed("edit", path, "split", "1", "--json"))
    assert answer["nodes"] == [70, 71]


def test_a_pair_is_explained_by_names_or_a_relation(demo_out):
    texts = {
        printed("explain", demo_out, *words)
        for words in (("cup", "on", "table"), ("cup on table",), ("cup", "dining table"))
    }
    (text,) = texts
    assert re.match(r"cup #\d+ is on dining table #\d+", text)
    assert printed("explain", demo_out, "dining", "table").startswith("dining table #")
    start_s = time.monotonic()
    refusal("explain", demo_out, "a" + 60_000 * " " + "b")
    assert time.monotonic() - start_s < 20.0


def test_a_merge_never_replaces_what_it_reads(demo_out):
    before = (demo_out / "scene_graph.json").read_bytes()
    file = demo_out / "scene_graph.json"
    assert "one of the graphs" in refusal("merge", demo_out, demo_out, file)
    assert "360 degrees" in refusal("merge", demo_out, demo_out, "x", "--transform", "0,0,0,1e308")
    assert file.read_bytes() == before


def test_a_refused_edit_leaves_the_map_as_it_is(tmp_path):
    path = saved_map(tmp_path, Config())
    before = path.read_bytes()
    for words, says in (
        (["delete", "7"], "object 7"),
        (["undo"], "nothing to undo"),
        (["paint", "1", "red"], "'paint 1 red'"),
        (["merge", "1", "one"], "one is no id"),
        (["merge", "1", "²"], "² is no id"),
        (["delete", "9" * 5000], "is no id"),
        (["split", "1", "0,0", "1,1,1"], "length >= 3"),
        (["set_label", "1", "a" * 257], "length <= 256"),
        (["delete", "-3"], "No such option"),
    ):
        assert says in refusal("edit", path, *words)
    lock = claim_map(path)
    try:
        assert "end that process" in refusal("edit", path, "delete", "1")
    finally:
        lock.release()
    assert "no.map" in refusal("edit", tmp_path / "no.map", "undo")
    assert path.read_bytes() == before
