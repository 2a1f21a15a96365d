"""A scene graph as one file without loss, the checks of that file, and the message as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.array_file import Arrays, read_arrays, write_arrays
from deworldsg_ros.base.files import parse_json, paused_collector, read_regular, write_atomically
from deworldsg_ros.graph.edits import MAX_EDITS, Edit
from deworldsg_ros.graph.graph import GlobalGraph, GraphState
from deworldsg_ros.graph.nodes import MAX_ID, SAVED, IdState
from deworldsg_ros.graph.pairs import PairArrays
from deworldsg_ros.scene import limits
from deworldsg_ros.scene.arrays import Int64, UInt16
from deworldsg_ros.scene.checks import (
    acyclic,
    checked,
    contained,
    distinct,
    distributions,
    holds,
    lengths,
    within,
)
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.limits import check_names
from deworldsg_ros.wire import messages as wire

# --- What the arrays of a saved graph have to fulfil before a graph is made of them.

# What clients read in a message may be in a map: the limits of both are the same.
MAX_POSITION_M = limits.MAX_GRAPH_COORDINATE_M
# Numbers that only grow: 100 frames a second for 10^6 years, far from overflow.
MAX_COUNT = 2**52
MAX_STAMP_NS = limits.MAX_SECONDS * 10**9 + 10**9 - 1
# Of summed logits: each relation of each frame may add the largest one. Sums of such sums stay
# finite.
MAX_LOGIT = limits.MAX_LOGIT * limits.MAX_RELATIONS * MAX_COUNT
# The default is 512.
MAX_SURFACE_POINTS = limits.MAX_POINTS
MAX_REMEMBERED_FRAMES = 1 << 20

Count = Annotated[int, msgspec.Meta(ge=0, le=MAX_COUNT)]
ArraysByName = Mapping[str, NDArray[Any]]


class Header(msgspec.Struct):
    """The settings of a saved graph; see `GraphState`."""

    version: Annotated[int, msgspec.Meta(ge=1)]
    classes: list[str]
    predicates: list[str]
    frame_id: str
    surface_point_capacity: Annotated[int, msgspec.Meta(ge=0, le=MAX_SURFACE_POINTS)]
    remembered_frames: Annotated[int, msgspec.Meta(ge=0, le=MAX_REMEMBERED_FRAMES)]
    next_id: Annotated[int, msgspec.Meta(ge=1, le=MAX_ID + 1)]
    # Files of earlier releases do not have it.
    even_gaussians: bool = False
    format: Literal["deworldsg scene graph"] = "deworldsg scene graph"


def check_header(header: Header) -> None:
    """Raise ValueError for a name that no message may contain."""
    for names in (header.classes, header.predicates, [header.frame_id]):
        check_names(names)


def check_arrays(arrays: ArraysByName, header: Header) -> None:
    """Raise ValueError unless the arrays are those of a graph with this header."""
    _check_nodes(arrays, header)
    ids = arrays["ids"]
    _check_edges(arrays, header, ids)
    if "vote_pairs" in arrays:  # not in files of older releases
        _check_votes(arrays, header, ids)
    _check_id_memory(arrays, header, ids)


def check_edits(edits: Sequence[Edit], arrays: ArraysByName) -> None:
    """Raise ValueError unless the edits are of the nodes in the arrays."""
    holds("edits", len(edits) <= MAX_EDITS, f"at most {MAX_EDITS}")
    numbers = np.array([0, *(edit.id for edit in edits)])
    holds("edits (id)", (np.diff(numbers) > 0).all(), "ascending numbers")
    replaced = np.array([node_id for edit in edits for node_id in edit.replaced], np.int64)
    distinct("edits (replaced)", replaced)
    deleted = [node_id for edit in edits if edit.kind == "delete" for node_id in edit.nodes]
    hidden = arrays["ids"][~arrays["confirmed"]]
    contained("edits (replaced)", replaced, hidden)
    contained("edits (deleted)", np.array(deleted, np.int64), hidden)
    nodes = np.array([node_id for edit in edits for node_id in edit.nodes], np.int64)
    contained("edits (nodes)", nodes, arrays["ids"])
    for edit in edits:
        within("edits (stamp_ns)", np.array(edit.stamp_ns), 0, MAX_STAMP_NS)
        # New nodes have later ids: so no node is replaced by itself, in any number of steps.
        newer = max(edit.replaced, default=0) < min(edit.nodes)
        holds("edits (nodes)", newer, "later ids than the nodes that they replace")
        is_merge_or_split = edit.kind in ("merge", "split")
        holds("edits (replaced)", is_merge_or_split or not edit.replaced, "of a merge or a split")
        # Of a split that cannot be undone any more, one part may be gone.
        wanted = 2 if edit.kind == "split" and (edit.replaced or len(edit.nodes) == 2) else 1
        holds("edits (nodes)", len(edit.nodes) == wanted, f"{wanted} for {edit.kind}")


def _check_nodes(arrays: ArraysByName, header: Header) -> None:
    ids = checked(arrays, "ids", np.int64, None)
    count = len(ids)
    within("ids", ids, 1, header.next_id - 1)
    distinct("ids", ids)
    within("means", checked(arrays, "means", np.float64, count, 3), *_sym(MAX_POSITION_M))
    covariances = checked(arrays, "covariances", np.float64, count, 3, 3)
    within("covariances", covariances, *_sym(limits.MAX_GRAPH_VARIANCE_M2))
    apart = np.abs(covariances - covariances.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0)
    largest = np.abs(covariances).max(axis=(1, 2), initial=0.0)
    holds("covariances", (apart <= 1e-6 * largest).all(), "symmetric matrices")
    classes = checked(arrays, "class_probabilities", np.float64, count, len(header.classes))
    distributions("class_probabilities", classes)
    within("weights", checked(arrays, "weights", np.float64, count), 1e-9, MAX_COUNT)
    within("observations", checked(arrays, "observations", np.int64, count), 1, MAX_COUNT)
    checked(arrays, "confirmed", np.bool_, count)
    if "existence" in arrays:  # not in files of older releases
        existence = checked(arrays, "existence", np.float64, count)
        within("existence", existence[existence != -1.0], 0.0, 1.0)
    if "colours" in arrays:  # nor this
        colours = checked(arrays, "colours", np.float64, count, 4)
        pixels = colours[:, 3:]
        within("colours (pixels)", pixels, 0, MAX_COUNT * limits.MAX_SIDE_PX**2)
        most = limits.MAX_LAB * (1 + 1e-9) * pixels
        holds("colours", (np.abs(colours[:, :3]) <= most).all(), f"means up to {limits.MAX_LAB:g}")
        holds("colours (lightness)", (colours[:, 0] >= 0).all(), "0 or more")
    first = checked(arrays, "first_seen_ns", np.int64, count)
    last = checked(arrays, "last_seen_ns", np.int64, count)
    _check_stamps("first_seen_ns", first)
    _check_stamps("last_seen_ns", last)
    holds("first_seen_ns", (first <= last).all(), "no later than last_seen_ns")
    points = checked(arrays, "surface_points", np.float32, None, 3)
    within("surface_points", points, *_sym(MAX_POSITION_M))
    counts = checked(arrays, "surface_point_counts", np.int64, count)
    lengths("surface_point_counts", counts, len(points))
    within("surface_point_counts", counts, 0, header.surface_point_capacity)


def _check_edges(arrays: ArraysByName, header: Header, ids: Int64) -> None:
    pairs = checked(arrays, "edge_pairs", np.int64, None, 2)
    _check_pairs("edge_pairs", pairs, ids)
    shape = len(pairs), len(header.predicates)
    logits = checked(arrays, "edge_visual_logits", np.float64, *shape)
    within("edge_visual_logits", logits, *_sym(MAX_LOGIT))
    counts = _counts(arrays, "edge_counts", len(pairs), 3)
    within("edge_counts (frames)", counts[:, 0], 0, MAX_COUNT)
    unseen = logits[counts[:, 0] == 0]
    holds("edge_visual_logits", not unseen.any(), "zeros for an edge without frames")
    _check_stamps("edge_counts (last_seen_ns)", counts[:, 1])
    within("edge_counts (neighbour_frames)", counts[:, 2], 0, MAX_COUNT)


def _check_votes(arrays: ArraysByName, header: Header, ids: Int64) -> None:
    pairs = checked(arrays, "vote_pairs", np.int64, None, 2)
    _check_pairs("vote_pairs", pairs, ids)
    holds("vote_pairs", (pairs[:, 0] < pairs[:, 1]).all(), "the smaller id first")
    known = _counts(arrays, "vote_known", len(pairs), 2)
    within("vote_known (frames)", known[:, 0], 0, MAX_COUNT)
    within("vote_known (has votes)", known[:, -1], 0, 1)
    voted = int(known[:, -1].sum())
    counts = checked(arrays, "vote_counts", np.float64, voted, 2, len(header.predicates))
    # A frame adds at most one vote, spread over the predicates.
    most = known[known[:, -1] == 1, 0].astype(np.float64)[:, None, None] * (1 + 1e-9)
    holds("vote_counts", ((counts >= 0) & (counts <= most)).all(), "0 to the number of frames")


def _check_id_memory(arrays: ArraysByName, header: Header, ids: Int64) -> None:
    links = checked(arrays, "successors", np.int64, None, 2)
    within("successors (removed ids)", links[:, 0], 1, header.next_id - 1)
    within("successors", links[:, 1], 0, header.next_id - 1)
    distinct("successors (removed ids)", links[:, 0])
    holds("successors", not np.isin(links[:, 0], ids).any(), "ids of removed nodes")
    acyclic("successors", links)
    within("removals", checked(arrays, "removals", np.int64, None), 1, header.next_id - 1)
    stamps = checked(arrays, "frame_stamps_ns", np.int64, None)
    _check_stamps("frame_stamps_ns", stamps)
    distinct("frame_stamps_ns", stamps)
    most = header.remembered_frames
    holds("frame_stamps_ns", len(stamps) <= most, f"at most {most} frames")
    nodes = checked(arrays, "frame_nodes", np.int64, None)
    counts = checked(arrays, "frame_node_counts", np.int64, len(stamps))
    lengths("frame_node_counts", counts, len(nodes))
    within("frame_nodes", nodes, 0, header.next_id - 1)


def _counts(arrays: ArraysByName, name: str, count: int, width: int) -> Int64:
    """Numbers (count, width); version 1 had a revision beside them."""
    values = checked(arrays, name, np.int64, count, None)
    holds(name, values.shape[1] in (width, width + 1), f"{width} columns")
    return values


def _check_pairs(name: str, pairs: Int64, ids: Int64) -> None:
    contained(name, pairs, ids)
    distinct(name, pairs)
    holds(name, (pairs[:, 0] != pairs[:, 1]).all(), "two different nodes")


def _check_stamps(name: str, stamps_ns: Int64) -> None:
    within(name, stamps_ns, 0, MAX_STAMP_NS)


def _sym(limit: float) -> tuple[float, float]:
    return -limit, limit


# --- The file of a finished scene graph: the message of /scene_graph as JSON.

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
    if content.startswith(b"PK"):  # a zip archive
        raise RefusedInput(
            "unreadable_graph",
            f"{path} is no scene graph; if it is a map, a node (map_path) or `deworldsg run --map` "
            f"goes on from it, and its graph is {GRAPH_FILE} in the folder of the run, or the file "
            "that graph_node saves (save_path)",
        )
    try:
        with paused_collector():
            return wire.decode(content, wire.SceneGraphMessage, MAX_GRAPH_BYTES)
    except RefusedInput as refusal:
        raise RefusedInput(refusal.reason, f"scene graph {path}: {refusal}") from refusal


def graph_path(path: Path) -> Path:
    """The file of a scene graph: itself, or ``scene_graph.json`` of a folder."""
    return path / GRAPH_FILE if path.is_dir() else path


def read_content(path: Path) -> bytes:
    """The text of a scene graph: a file, or ``scene_graph.json`` of a folder.

    Raises:
        RefusedInput: ``unreadable_graph``.
    """
    path = graph_path(path)
    try:
        return read_regular(path, MAX_GRAPH_BYTES)
    except OSError as error:
        message = f"scene graph {path} cannot be read ({error.strerror})"
        raise RefusedInput("unreadable_graph", message) from error


# --- A scene graph as one .npz file, without loss.
#
# The graph that is read continues exactly as the one that was written.

# A reader of version N reads N - 1 too.
FORMAT_VERSION = 2


def save(graph: GlobalGraph, path: str | Path) -> None:
    """Write the whole state of a graph; OSError if that fails."""
    write(path, to_arrays(graph.state()))


def load(path: str | Path) -> GlobalGraph:
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
        "next_id": state.ids.next_id,
    }
    return {
        "header": np.frombuffer(json.dumps(header).encode(), np.uint8),
        **state.nodes,
        "surface_points": state.surface_points,
        "surface_keyframes": state.surface_keyframes,
        "surface_point_counts": state.surface_counts,
        **vars(state.pairs),
        **_id_arrays(state.ids),
        **_edit_arrays(state),
        **state.embeddings,
    }


def _edit_arrays(state: GraphState) -> Arrays:
    """Empty without edits, as in files of older releases."""
    content = msgspec.json.encode(list(state.edits))
    return {"edits": np.frombuffer(content, np.uint8)} if state.edits else {}


def _id_arrays(ids: IdState) -> Arrays:
    rows = ids.frames.values()
    return {
        "successors": np.array(list(ids.successors.items()), np.int64).reshape(-1, 2),
        "removals": np.array(ids.removals, np.int64),
        "frame_stamps_ns": np.array(list(ids.frames), np.int64),
        "frame_node_counts": np.array([len(row) for row in rows], np.int64),
        "frame_nodes": np.array([node_id for row in rows for node_id in row], np.int64),
    }


def graph_from_arrays(arrays: Arrays, source: str, **settings: Any) -> GlobalGraph:
    """The graph of `to_arrays`.

    Args:
        arrays: by name; others are ignored.
        source: file name for errors.
        settings: of `GlobalGraph`; they replace the saved ones.

    Raises:
        RefusedInput: ``invalid_graph_file`` if the arrays are not those of a graph.
    """
    try:
        return GlobalGraph.from_state(replace(_state(arrays), **settings))
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
        nodes={name: _column(arrays, name) for name in SAVED},
        surface_points=arrays["surface_points"],
        surface_keyframes=_keyframes(arrays),
        surface_counts=arrays["surface_point_counts"],
        pairs=_pairs(arrays, len(header.predicates)),
        ids=_ids(arrays, header.next_id),
        surface_point_capacity=header.surface_point_capacity,
        remembered_frames=header.remembered_frames,
        even_gaussians=header.even_gaussians,
        edits=edits,
        embeddings=arrays,
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
    if name not in arrays:  # files of older releases
        count = len(arrays["ids"])
        if name == "existence":
            return np.full(count, -1.0)
        if name == "colours":
            return np.zeros((count, 4))
    return arrays[name]


def _keyframes(arrays: Arrays) -> UInt16:
    """The keyframe of each surface point; not known (0) in files of older releases."""
    count = len(arrays["surface_points"])
    if "surface_keyframes" not in arrays:
        return np.zeros(count, np.uint16)
    return checked(arrays, "surface_keyframes", np.uint16, count)


def _pairs(arrays: Arrays, width: int) -> PairArrays:
    edges = {name: arrays[name] for name in ("edge_pairs", "edge_visual_logits")}
    # Version 1 had a revision after the counts, and between the two of votes.
    edges["edge_counts"] = arrays["edge_counts"][:, :3]
    if "vote_pairs" not in arrays:  # nor had its first files votes
        none = np.zeros((0, 2), np.int64)
        return PairArrays(
            **edges, vote_pairs=none, vote_known=none, vote_counts=np.zeros((0, 2, width))
        )
    return PairArrays(
        **edges,
        vote_pairs=arrays["vote_pairs"],
        vote_known=arrays["vote_known"][:, [0, -1]],
        vote_counts=arrays["vote_counts"],
    )


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
