"""The file of a finished scene graph: the message of /scene_graph as JSON."""

from __future__ import annotations

from pathlib import Path

from deworldsg_ros.files import read_regular, write_atomically
from deworldsg_ros.parsing import paused_collector
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.errors import RefusedInput

GRAPH_FILE = "scene_graph.json"
# 10^5 nodes with 512 surface points have 3 GB as text.
MAX_GRAPH_BYTES = 4 << 30


def write_graph(folder: Path, graph: wire.SceneGraphMessage) -> Path:
    """Write ``folder/scene_graph.json``; returns its path. Raises OSError."""
    path = folder / GRAPH_FILE
    write_atomically(path, wire.encode(graph))
    return path


def read_graph(path: Path) -> wire.SceneGraphMessage:
    """Read a scene graph: a file, or ``scene_graph.json`` of a folder.

    Raises:
        RefusedInput: ``unreadable_graph``, or the reason for which `wire.decode` refuses it.
    """
    content = read_content(path)
    try:
        with paused_collector():
            return wire.decode(content, wire.SceneGraphMessage, MAX_GRAPH_BYTES)
    except RefusedInput as refusal:
        raise RefusedInput(refusal.reason, f"scene graph {path}: {refusal}") from refusal


def read_content(path: Path) -> bytes:
    """The text of a scene graph: a file, or ``scene_graph.json`` of a folder.

    Raises:
        RefusedInput: ``unreadable_graph``.
    """
    path = path / GRAPH_FILE if path.is_dir() else path
    try:
        return read_regular(path, MAX_GRAPH_BYTES)
    except OSError as error:
        message = f"scene graph {path} cannot be read ({error.strerror})"
        raise RefusedInput("unreadable_graph", message) from error
