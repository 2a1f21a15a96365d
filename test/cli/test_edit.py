"""`deworldsg edit` on a map file."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer.testing
from support.merging import VOCABULARY
from support.surfaces import CUP, HERE, view

from deworldsg_ros.cli.app import app
from deworldsg_ros.cli.ask import parse_edit
from deworldsg_ros.client import ClientError
from deworldsg_ros.config import Config, MergingConfig
from deworldsg_ros.graph.edits import SplitNode
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import claim_map, read_map, write_map

runner = typer.testing.CliRunner()


def saved(folder: Path, association: str = "surface") -> Path:
    config = Config(merging=MergingConfig(association=association))
    builder = GraphBuilder(config, VOCABULARY, "world")
    for stamp in range(1, 8):
        builder.integrate(view(stamp, (HERE, CUP)))
    write_map(builder, folder / "room.map")
    return folder / "room.map"


@pytest.mark.parametrize("association", ["surface", "paper"])
def test_a_map_is_edited_and_the_edit_undone(tmp_path: Path, association: str) -> None:
    path = saved(tmp_path, association)
    config = Config(merging=MergingConfig(association=association))
    before = read_map(config, path).full()
    done = runner.invoke(app, ["edit", str(path), "set_label", "#1", "chair"])
    assert (done.exit_code, done.output) == (0, "object 1 is a 'chair'\n")
    (node,) = read_map(config, path).full().nodes
    assert (node.label, node.label_provenance) == ("chair", "operator")
    done = runner.invoke(app, ["edit", str(path), "delete", "1"])
    assert done.exit_code == 0 and read_map(config, path).full().nodes == []
    for _ in range(2):
        assert runner.invoke(app, ["edit", str(path), "undo"]).exit_code == 0
    assert read_map(config, path).full() == before


def test_a_refused_edit_leaves_the_map_as_it_is(tmp_path: Path) -> None:
    path = saved(tmp_path)
    before = path.read_bytes()
    for words, says in (
        (["delete", "7"], "object 7 is not in the graph"),
        (["undo"], "nothing to undo"),
        (["paint", "1", "red"], "'paint 1 red': expected set_label ID LABEL"),
        (["merge", "1", "one"], "one is no id"),
        (["merge", "1", "²"], "² is no id"),
        (["delete", "9" * 5000], "is no id"),
        (["split", "1", "0,0", "1,1,1"], "length >= 3"),
        (["delete", "-3"], "No such option"),
    ):
        done = runner.invoke(app, ["edit", str(path), *words])
        assert done.exit_code == 2, done.output
        assert says in done.output
    lock = claim_map(path)
    try:
        done = runner.invoke(app, ["edit", str(path), "delete", "1"])
        assert done.exit_code == 2 and "end that process" in done.output
    finally:
        lock.release()
    done = runner.invoke(app, ["edit", str(tmp_path / "no.map"), "undo"])
    assert "expected a file that graph_node or --map has written" in done.output
    assert path.read_bytes() == before


def test_the_words_of_a_split() -> None:
    expected = SplitNode(5, [[0.0, 1.0, 2.0], [-3.0, 4.0, 5.0]])
    assert parse_edit(["split", "5", "0,1,2", "-3,4,5"]) == expected
    with pytest.raises(ClientError, match="expected set_label"):
        parse_edit([])
