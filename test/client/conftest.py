"""The graph of the shipped recording, as an earlier release saved it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from support.view import SAVED

from deworldsg_ros.client import SceneGraph


@pytest.fixture(scope="session")
def room() -> SceneGraph:
    """34 objects of the shipped recording; a file of version 1, with 60 surface points each."""
    return SceneGraph.load(SAVED)


@pytest.fixture
def demo_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run in the present folder."""
    folder = tmp_path / "demo_out"
    folder.mkdir()
    shutil.copy(SAVED, folder / "scene_graph.json")
    monkeypatch.chdir(tmp_path)
    return folder
