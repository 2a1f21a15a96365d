"""Every code block of README.md's client and of the page "use the graph" runs."""

import re
import shlex
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from support.cli import printed
from support.merging import VOCABULARY
from support.spaces import seen_room
from support.surfaces import CUP, HERE, view

import deworldsg_ros.client
from deworldsg_ros.cli import ask
from deworldsg_ros.client import SceneGraph
from deworldsg_ros.config import Config
from deworldsg_ros.graph.edits import SetLabel
from deworldsg_ros.graph.provenance import write_space
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import write_map

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(path: Path) -> list[tuple[str, str]]:
    """Language and content of each block."""
    return BLOCK.findall(path.read_text(encoding="utf-8"))


class FakeClient(nullcontext):
    """A live client without ROS: the graph of a file, and answers to commands."""

    def __init__(self, namespace: str = "", *, embeddings: bool = False) -> None:
        super().__init__(self)
        self.graph = SceneGraph.load("demo_out")

    def on_change(self, callback: Callable[..., object]) -> None:
        callback(self.graph, self.graph.changes_since(self.graph))

    def command(self, *call: Any, **request: Any) -> dict[str, Any]:
        return {"nodes": [58], "text": "done"}

    set_label = merge = split = delete = undo = command


@pytest.fixture
def page(root_dir, demo_out, monkeypatch):
    """The blocks of the page, with the files that it names and a client without ROS."""
    monkeypatch.setattr(deworldsg_ros.client, "SceneGraphClient", FakeClient, raising=False)
    write_space(demo_out / "scene_graph.json", seen_room())
    for name in ("monday", "tuesday", "kitchen", "living_room"):
        shutil.copytree(demo_out, demo_out.with_name(name))
    builder = GraphBuilder(Config(), VOCABULARY, "world")
    for stamp in range(1, 8):
        builder.integrate(view(stamp, (HERE, CUP)))
    builder.edit(SetLabel(1, "mug"))
    builder.space = seen_room()
    builder.find_rooms_and_things()
    write_map(builder, Path("room.map"))
    poses = [f"{stamp / 10} 0.1 0 0 0 0 0 1\n" for stamp in range(1, 8)]
    Path("slam.txt").write_text("".join(poses))
    return blocks(root_dir / "docs" / "use_the_graph.md")


def test_the_readme_says_which_cup_is_on_the_table(root_dir, demo_out, capsys):
    (block,) = [text for language, text in blocks(root_dir / "README.md") if language == "python"]
    assert len(block.strip().splitlines()) <= 10
    exec(compile(block, "README.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("cup #13 (-0.8") for line in lines)
    assert any("elephant" in line for line in lines)


def test_the_python_of_the_page_runs(page):
    names: dict[str, object] = {}
    python = [text for language, text in page if language == "python"]
    assert len(python) >= 7
    for block in python:
        exec(compile(block, "use_the_graph.md", "exec"), names)


def test_the_section_about_rooms_runs(page, root_dir):
    text = (root_dir / "docs" / "maps_that_last.md").read_text(encoding="utf-8")
    (section,) = re.findall(
        r"^## Rooms and storeys\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL
    )
    for language, block in BLOCK.findall(section):
        if language == "python":
            exec(compile(block, "maps_that_last.md", "exec"), {})
            continue
        for line in block.splitlines():
            printed(*shlex.split(line, comments=True)[1:])


def test_the_commands_of_the_page_run(page, monkeypatch):
    server = Mock()  # test_mcp.py has the server itself
    monkeypatch.setattr(ask, "make_server", server)
    lines = [line for language, text in page if not language for line in text.splitlines()]
    commands = [shlex.split(line, comments=True) for line in lines if line.strip()]
    assert len(commands) >= 18
    for program, *words in commands:
        if program != "pip":
            assert program == "deworldsg", words
            printed(*words)
    assert server.called
