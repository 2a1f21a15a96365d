"""A scene graph as one .npz file, without loss.

The graph that is read continues exactly as the one that was written.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.parsing import parse_json
from deworldsg_ros.scene.array_checks import checked
from deworldsg_ros.scene.array_file import Arrays, read_arrays, write_arrays
from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.edges import EdgeArrays, Pair
from deworldsg_ros.scene.edits import Edit
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.graph import GraphState, SceneGraph
from deworldsg_ros.scene.graph_checks import Header, check_arrays, check_edits, check_header
from deworldsg_ros.scene.node_ids import IdState
from deworldsg_ros.scene.nodes import SAVED_COLUMNS
from deworldsg_ros.scene.votes import PairVotes

# A reader of version N reads N - 1 too.
FORMAT_VERSION = 1


def save(graph: SceneGraph, path: str | Path) -> None:
    """Write the whole state of a graph; OSError if that fails."""
    write(path, to_arrays(graph.state()))


def load(path: str | Path) -> SceneGraph:
    """Read what `save` wrote; RefusedInput ``invalid_graph_file`` if the file is not one."""
    return graph_from_arrays(read(path), str(path))


def to_arrays(state: GraphState) -> Arrays:
    """The arrays of a graph by name, and its settings as JSON bytes under ``header``."""
    header = {
        "format": "deworldsg scene graph",
        "version": FORMAT_VERSION,
        "classes": state.vocabulary.classes,
        "predicates": state.vocabulary.predicates,
        "frame_id": state.frame_id,
        "surface_point_capacity": state.surface_point_capacity,
        "remembered_frames": state.remembered_frames,
        "even_gaussians": state.even_gaussians,
        "revision": state.revision,
        "next_id": state.ids.next_id,
    }
    return {
        "header": np.frombuffer(json.dumps(header).encode(), np.uint8),
        **state.nodes,
        "surface_points": state.surface_points,
        "surface_point_counts": state.surface_counts,
        "edge_pairs": state.edges.pairs,
        "edge_visual_logits": state.edges.visual_logits,
        "edge_counts": state.edges.counts,
        **_vote_arrays(state),
        **_id_arrays(state.ids),
        **_edit_arrays(state),
    }


def _edit_arrays(state: GraphState) -> Arrays:
    """Empty without edits, as in files of older releases."""
    content = msgspec.json.encode(list(state.edits))
    return {"edits": np.frombuffer(content, np.uint8)} if state.edits else {}


def _vote_arrays(state: GraphState) -> Arrays:
    votes, width = state.votes.values(), len(state.vocabulary.predicates)
    voted = [item.counts for item in votes if item.counts is not None]
    known = [(v.frames, v.revision, v.counts is not None) for v in votes]
    return {
        "vote_pairs": np.array(list(state.votes), np.int64).reshape(-1, 2),
        "vote_known": np.array(known, np.int64).reshape(-1, 3),
        "vote_counts": np.array(voted, np.float64).reshape(len(voted), 2, width),
    }


def _id_arrays(ids: IdState) -> Arrays:
    rows = ids.frames.values()
    return {
        "successors": np.array(list(ids.successors.items()), np.int64).reshape(-1, 2),
        "removals": np.array(ids.removals, np.int64),
        "frame_stamps_ns": np.array(list(ids.frames), np.int64),
        "frame_node_counts": np.array([len(row) for row in rows], np.int64),
        "frame_nodes": np.array([node_id for row in rows for node_id in row], np.int64),
    }


def graph_from_arrays(arrays: Arrays, source: str, **settings: Any) -> SceneGraph:
    """The graph of `to_arrays`.

    Args:
        arrays: by name; others are ignored.
        source: file name for errors.
        settings: of `SceneGraph`; they replace the saved ones.

    Raises:
        RefusedInput: ``invalid_graph_file`` if the arrays are not those of a graph.
    """
    try:
        return SceneGraph.from_state(replace(_state(arrays), **settings))
    except (KeyError, ValueError, TypeError, IndexError, MemoryError) as error:
        raise RefusedInput(
            "invalid_graph_file", f"graph file {source}: {reason_of(error)}"
        ) from error


def _state(arrays: Arrays) -> GraphState:
    header, edits = header_of(arrays), _edits(arrays)
    check_arrays(arrays, header)
    check_edits(edits, arrays)
    return GraphState(
        vocabulary=Vocabulary(tuple(header.classes), tuple(header.predicates)),
        frame_id=header.frame_id,
        nodes={name: _column(arrays, name) for name in SAVED_COLUMNS},
        surface_points=arrays["surface_points"],
        surface_counts=arrays["surface_point_counts"],
        edges=EdgeArrays(arrays["edge_pairs"], arrays["edge_visual_logits"], arrays["edge_counts"]),
        votes=_votes(arrays) if "vote_pairs" in arrays else {},  # not in files of older releases
        ids=_ids(arrays, header.next_id),
        revision=header.revision,
        surface_point_capacity=header.surface_point_capacity,
        remembered_frames=header.remembered_frames,
        even_gaussians=header.even_gaussians,
        edits=edits,
    )


def _edits(arrays: Arrays) -> list[Edit]:
    if "edits" not in arrays:
        return []
    return parse_json(checked(arrays, "edits", np.uint8, None).tobytes(), list[Edit])


def header_of(arrays: Arrays) -> Header:
    """The settings of a saved graph; ValueError if there are none."""
    header = parse_json(checked(arrays, "header", np.uint8, None).tobytes(), Header)
    if header.version > FORMAT_VERSION:
        raise ValueError(f"version {header.version}: expected {FORMAT_VERSION} or older")
    check_header(header)
    return header


def _column(arrays: Arrays, name: str) -> NDArray[Any]:
    if name == "existence" and name not in arrays:  # files of older releases
        return np.full(len(arrays["ids"]), -1.0)
    return arrays[name]


def _votes(arrays: Arrays) -> dict[Pair, PairVotes]:
    counts = iter(arrays["vote_counts"])
    return {
        (first, second): PairVotes(frames, next(counts) if voted else None, revision)
        for (first, second), (frames, revision, voted) in zip(
            arrays["vote_pairs"].tolist(), arrays["vote_known"].tolist()
        )
    }


def _ids(arrays: Arrays, next_id: int) -> IdState:
    rows = _split(arrays["frame_nodes"], arrays["frame_node_counts"])
    return IdState(
        next_id=next_id,
        successors={removed: kept for removed, kept in arrays["successors"].tolist()},
        removals=tuple(arrays["removals"].tolist()),
        frames={
            stamp_ns: tuple(row.tolist())
            for stamp_ns, row in zip(arrays["frame_stamps_ns"].tolist(), rows)
        },
    )


def _split(flat: NDArray[Any], counts: Int64) -> list[NDArray[Any]]:
    return np.split(flat, np.cumsum(counts)[:-1]) if len(counts) else []


def write(path: str | Path, arrays: Arrays, *, previous: Path | None = None) -> None:
    """Write arrays as .npz; as `write_atomically`."""
    write_arrays(Path(path), arrays, previous=previous)


def read(path: str | Path) -> Arrays:
    """Read arrays; RefusedInput ``invalid_graph_file`` if the file is no .npz, or damaged."""
    try:
        return read_arrays(Path(path))
    except (OSError, ValueError, MemoryError) as error:
        raise RefusedInput(
            "invalid_graph_file", f"graph file {path}: {reason_of(error)}"
        ) from error


def reason_of(error: Exception) -> str:
    """A readable reason, also for exceptions whose text is only a name."""
    if isinstance(error, KeyError):
        return f"there is no {error} in it"
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
