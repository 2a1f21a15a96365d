"""The graph of the shipped recording, as an earlier release saved it."""

import shutil

import pytest
from support.view import SAVED

from deworldsg_ros.client import SceneGraph


@pytest.fixture(scope="session")
def room():
    """34 objects of the shipped recording; a file of version 1, with 60 surface points each."""
    return SceneGraph.load(SAVED)


@pytest.fixture
def demo_out(tmp_path, monkeypatch):
    """The folder of a run in the present folder."""
    folder = tmp_path / "demo_out"
    folder.mkdir()
    shutil.copy(SAVED, folder / "scene_graph.json")
    monkeypatch.chdir(tmp_path)
    return folder
