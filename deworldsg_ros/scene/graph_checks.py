"""What the arrays of a saved graph have to fulfil before a graph is made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.scene import limits
from deworldsg_ros.scene.array_checks import (
    acyclic,
    checked,
    contained,
    distinct,
    distributions,
    holds,
    lengths,
    within,
)
from deworldsg_ros.scene.arrays import Int64
from deworldsg_ros.scene.edges import MAX_ID
from deworldsg_ros.scene.edits import MAX_EDITS, Edit
from deworldsg_ros.scene.names import check_names

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
Arrays = Mapping[str, NDArray[Any]]


class Header(msgspec.Struct):
    """The settings of a saved graph; see `GraphState`."""

    version: Annotated[int, msgspec.Meta(ge=1)]
    classes: list[str]
    predicates: list[str]
    frame_id: str
    surface_point_capacity: Annotated[int, msgspec.Meta(ge=0, le=MAX_SURFACE_POINTS)]
    remembered_frames: Annotated[int, msgspec.Meta(ge=0, le=MAX_REMEMBERED_FRAMES)]
    revision: Count
    next_id: Annotated[int, msgspec.Meta(ge=1, le=MAX_ID + 1)]
    # Files of earlier releases do not have it.
    even_gaussians: bool = False
    format: Literal["deworldsg scene graph"] = "deworldsg scene graph"


def check_header(header: Header) -> None:
    """Raise ValueError for a name that no message may contain."""
    for names in (header.classes, header.predicates, [header.frame_id]):
        check_names(names)


def check_arrays(arrays: Arrays, header: Header) -> None:
    """Raise ValueError unless the arrays are those of a graph with this header."""
    _check_nodes(arrays, header)
    ids = arrays["ids"]
    _check_edges(arrays, header, ids)
    if "vote_pairs" in arrays:  # not in files of older releases
        _check_votes(arrays, header, ids)
    _check_id_memory(arrays, header, ids)


def check_edits(edits: Sequence[Edit], arrays: Arrays) -> None:
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


def _check_nodes(arrays: Arrays, header: Header) -> None:
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
    first = checked(arrays, "first_seen_ns", np.int64, count)
    last = checked(arrays, "last_seen_ns", np.int64, count)
    _check_stamps("first_seen_ns", first)
    _check_stamps("last_seen_ns", last)
    holds("first_seen_ns", (first <= last).all(), "no later than last_seen_ns")
    within("revisions", checked(arrays, "revisions", np.int64, count), 0, header.revision)
    points = checked(arrays, "surface_points", np.float32, None, 3)
    within("surface_points", points, *_sym(MAX_POSITION_M))
    counts = checked(arrays, "surface_point_counts", np.int64, count)
    lengths("surface_point_counts", counts, len(points))
    within("surface_point_counts", counts, 0, header.surface_point_capacity)


def _check_edges(arrays: Arrays, header: Header, ids: Int64) -> None:
    pairs = checked(arrays, "edge_pairs", np.int64, None, 2)
    _check_pairs("edge_pairs", pairs, ids)
    shape = len(pairs), len(header.predicates)
    logits = checked(arrays, "edge_visual_logits", np.float64, *shape)
    within("edge_visual_logits", logits, *_sym(MAX_LOGIT))
    counts = checked(arrays, "edge_counts", np.int64, len(pairs), 4)
    within("edge_counts (frames)", counts[:, 0], 0, MAX_COUNT)
    unseen = logits[counts[:, 0] == 0]
    holds("edge_visual_logits", not unseen.any(), "zeros for an edge without frames")
    _check_stamps("edge_counts (last_seen_ns)", counts[:, 1])
    within("edge_counts (neighbour_frames)", counts[:, 2], 0, MAX_COUNT)
    within("edge_counts (revision)", counts[:, 3], 0, header.revision)


def _check_votes(arrays: Arrays, header: Header, ids: Int64) -> None:
    pairs = checked(arrays, "vote_pairs", np.int64, None, 2)
    _check_pairs("vote_pairs", pairs, ids)
    holds("vote_pairs", (pairs[:, 0] < pairs[:, 1]).all(), "the smaller id first")
    known = checked(arrays, "vote_known", np.int64, len(pairs), 3)
    within("vote_known (frames)", known[:, 0], 0, MAX_COUNT)
    within("vote_known (revision)", known[:, 1], 0, header.revision)
    within("vote_known (has votes)", known[:, 2], 0, 1)
    voted = int(known[:, 2].sum())
    counts = checked(arrays, "vote_counts", np.float64, voted, 2, len(header.predicates))
    # A frame adds at most one vote, spread over the predicates.
    most = known[known[:, 2] == 1, 0].astype(np.float64)[:, None, None] * (1 + 1e-9)
    holds("vote_counts", ((counts >= 0) & (counts <= most)).all(), "0 to the number of frames")


def _check_id_memory(arrays: Arrays, header: Header, ids: Int64) -> None:
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


def _check_pairs(name: str, pairs: Int64, ids: Int64) -> None:
    contained(name, pairs, ids)
    distinct(name, pairs)
    holds(name, (pairs[:, 0] != pairs[:, 1]).all(), "two different nodes")


def _check_stamps(name: str, stamps_ns: Int64) -> None:
    within(name, stamps_ns, 0, MAX_STAMP_NS)


def _sym(limit: float) -> tuple[float, float]:
    return -limit, limit
