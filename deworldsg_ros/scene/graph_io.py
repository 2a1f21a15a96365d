"""The whole state of a scene graph as named arrays, and as one .npz file.

Nothing is lost: the graph that is read goes on exactly as the one that was written.
"""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import Vocabulary

if TYPE_CHECKING:
    from deworldsg_ros.scene.graph import SceneGraph

State = dict[str, NDArray[Any]]

# A reader of version N reads N - 1 too.
FORMAT_VERSION = 1

_NODE_COLUMNS = (
    "ids",
    "means",
    "covariances",
    "class_probabilities",
    "weights",
    "observations",
    "confirmed",
    "first_seen_ns",
    "last_seen_ns",
    "revisions",
)


def state_of(graph: SceneGraph) -> State:
    """Every array that makes up a graph, and its settings as JSON bytes."""
    nodes = graph.nodes
    header = {
        "format": "deworldsg scene graph",
        "version": FORMAT_VERSION,
        "classes": graph.vocabulary.classes,
        "predicates": graph.vocabulary.predicates,
        "frame_id": graph.frame_id,
        "surface_point_capacity": graph.surface_point_capacity,
        "remembered_frames": graph.remembered_frames,
        "even_gaussians": graph.even_gaussians,
        "revision": graph.revision,
        "next_id": graph._next_id,
    }
    edges = graph.edges
    frames = graph._frames
    points = [nodes.surface(row) for row in range(len(nodes))]
    return {
        "header": np.frombuffer(json.dumps(header).encode(), np.uint8),
        **{name: getattr(nodes, name).copy() for name in _NODE_COLUMNS},
        "surface_points": np.concatenate([np.zeros((0, 3), np.float32), *points]),
        "surface_point_counts": np.array([len(item) for item in points], np.int64),
        "edge_pairs": np.array(list(edges), np.int64).reshape(-1, 2),
        "edge_visual_logits": np.array(
            [edge.visual_logits for edge in edges.values()], np.float64
        ).reshape(-1, len(graph.vocabulary.predicates)),
        "edge_counts": np.array(
            [
                (edge.frames, edge.last_seen_ns, edge.neighbour_frames, edge.revision)
                for edge in edges.values()
            ],
            np.int64,
        ).reshape(-1, 4),
        "successors": np.array(list(graph._successors.items()), np.int64).reshape(-1, 2),
        "removals": np.array(graph._removals, np.int64),
        "frame_stamps_ns": np.array(list(frames), np.int64),
        "frame_node_counts": np.array([len(ids) for ids in frames.values()], np.int64),
        "frame_nodes": np.array([node for ids in frames.values() for node in ids], np.int64),
    }


def graph_of(state: State, source: str, **settings: Any) -> SceneGraph:
    """The graph of a state; settings of `SceneGraph` take the place of those saved.

    Raises:
        RefusedInput: ``invalid_graph_file``, with `source`, where the state is not one.
    """
    try:
        return _graph_of(state, settings)
    except (KeyError, ValueError, TypeError, IndexError, MemoryError) as error:
        raise RefusedInput("invalid_graph_file", f"graph file {source}: {told(error)}") from error


def told(error: Exception) -> str:
    """What is wrong with a file, in words, where the exception tells no more than a name."""
    if isinstance(error, KeyError):
        return f"there is no {error} in it"
    return getattr(error, "strerror", None) or str(error)


def _graph_of(state: State, settings: dict[str, Any]) -> SceneGraph:
    from deworldsg_ros.scene.graph import SceneGraph

    header = json.loads(state["header"].tobytes())
    if header.get("version", 0) > FORMAT_VERSION:
        raise ValueError(f"version {header['version']}: wanted {FORMAT_VERSION} or older")
    saved = ("surface_point_capacity", "remembered_frames", "even_gaussians")
    graph = SceneGraph(
        Vocabulary(tuple(header["classes"]), tuple(header["predicates"])),
        header["frame_id"],
        **{name: header[name] for name in saved if name in header} | settings,
    )
    nodes = graph.nodes
    points = _split(state["surface_points"], state["surface_point_counts"])
    for index, node_id in enumerate(state["ids"].tolist()):
        row = nodes.append(node_id)
        nodes.put(
            row,
            state["means"][index],
            state["covariances"][index],
            state["class_probabilities"][index],
            float(state["weights"][index]),
            int(state["observations"][index]),
        )
        nodes.set_surface(row, points[index])
        for name in ("confirmed", "first_seen_ns", "last_seen_ns", "revisions"):
            getattr(nodes, name)[row] = state[name][index]
    for pair, logits, (frames, last_seen_ns, neighbour_frames, revision) in zip(
        state["edge_pairs"].tolist(),
        state["edge_visual_logits"],
        state["edge_counts"].tolist(),
    ):
        graph._edges.add(
            (pair[0], pair[1]),
            logits=logits if frames else None,
            frames=frames,
            neighbour_frames=neighbour_frames,
            stamp_ns=last_seen_ns,
            revision=revision,
        )
    graph.revision = int(header["revision"])
    graph._next_id = int(header["next_id"])
    graph._successors = {gone: kept for gone, kept in state["successors"].tolist()}
    graph._removals = state["removals"].tolist()
    frame_nodes = _split(state["frame_nodes"], state["frame_node_counts"])
    for stamp_ns, ids in zip(state["frame_stamps_ns"].tolist(), frame_nodes):
        graph._frames[stamp_ns] = tuple(ids.tolist())
    return graph


def _split(flat: NDArray[Any], counts: Int64) -> list[NDArray[Any]]:
    return np.split(flat, np.cumsum(counts)[:-1]) if len(counts) else []


def check_writable(path: Path) -> None:
    """Make the folder of a file that `write` is to write; raises OSError where it cannot be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = _partial(path)
    partial.touch()
    partial.unlink()


def _partial(path: Path) -> Path:
    return path.with_name(path.name + ".partial")


def write(path: str | Path, state: State) -> None:
    """Write a state as .npz; the file appears complete or not at all."""
    path = Path(path)
    partial = _partial(path)
    with partial.open("wb") as file:
        np.savez(file, **state)  # type: ignore[arg-type]  # its own options are named in the stub
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def read(path: str | Path) -> State:
    """Read a state; raises RefusedInput ``invalid_graph_file``."""
    try:
        with Path(path).open("rb") as file:
            if not zipfile.is_zipfile(file):
                raise ValueError("no .npz archive, as a saved graph or map is")
        with np.load(Path(path), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, TypeError) as error:
        raise RefusedInput("invalid_graph_file", f"graph file {path}: {told(error)}") from error
