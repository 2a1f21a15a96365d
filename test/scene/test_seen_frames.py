"""The frames behind nodes and edges: bounded, following merges, in maps and beside saved graphs."""

from __future__ import annotations

import numpy as np
import pytest
from support.merging import VOCABULARY, local_graph, random_local_graphs
from support.surfaces import CUP, HERE, TABLE, slab, view

from deworldsg_ros.client import SceneGraph as AskedGraph
from deworldsg_ros.config import Config, OutputConfig
from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.edits import MergeNodes
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.graph.graph_files import write_graph
from deworldsg_ros.graph.pairs import frame_votes
from deworldsg_ros.graph.provenance import (
    CLEAREST,
    PRUNE_FRAMES,
    FrameMemory,
    path_beside,
    write_seen,
)
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import copy_state, read_map, write_map
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.wire import messages as wire

CONFIG = Config(output=OutputConfig(min_existence=0.0))
FLOOR = slab((0, 0, 0.95), (1.2, 0.8, 0.01))


def graph_of(count: int) -> SceneGraph:
    graph = SceneGraph(VOCABULARY, "world")
    for _ in range(count):
        graph.add_node(np.zeros(3), np.eye(3), np.full(4, 0.25), 1)
    return graph


def seen_at(stamp_ns: int, strength: float, logit: float = 2.0):
    """A frame that shows two cups, the first on the second."""
    rest = (1 - strength) / 3
    classes = np.array([[strength, rest, rest, rest]] * 2)
    logits = np.array([[logit, -9.0, -9.0]])
    return local_graph(
        stamp_ns,
        np.zeros((2, 3)),
        np.stack([np.eye(3)] * 2),
        classes,
        pairs=[(0, 1)],
        logits=logits,
    )


def note(memory: FrameMemory, graph: SceneGraph, local: LocalGraph, node_ids: list[int]) -> None:
    memory.note(graph, local, node_ids, frame_votes(local.relations.logits))


def test_first_last_and_the_clearest_few_are_kept() -> None:
    graph, memory = graph_of(2), FrameMemory()
    for stamp_ns, strength in enumerate([0.5, 0.9, 0.6, 0.8, 0.7, 0.9], start=1):
        note(memory, graph, seen_at(stamp_ns, strength, strength), [1, 2])
    node, pair, other = memory.all(graph)
    assert (node.node, node.other, pair.node, pair.other, other.node) == (1, 0, 1, 2, 2)
    assert (node.first_ns, node.last_ns) == (1, 6)
    # Of equally clear frames, the earlier one comes first. The score of a detection is 0.9.
    assert [(f.stamp_ns, f.name, f.strength) for f in node.clearest] == [
        (2, "cup", 0.81), (6, "cup", 0.81), (4, "cup", 0.72),
    ]  # fmt: skip
    assert [(f.stamp_ns, f.name) for f in pair.clearest] == [(2, "on"), (6, "on"), (4, "on")]


def test_frames_follow_merges_and_removals_and_do_not_grow() -> None:
    graph, memory = graph_of(3), FrameMemory()
    note(memory, graph, seen_at(1, 0.5), [1, 2])
    note(memory, graph, seen_at(2, 0.9), [3, 2])
    graph.merge_nodes(1, 3)
    assert [(s.node, s.other, s.first_ns, s.last_ns) for s in memory.all(graph)] == [
        (1, 0, 1, 2), (1, 2, 1, 2), (2, 0, 1, 2),
    ]  # fmt: skip
    graph.remove_node(2)
    assert [(s.node, s.other) for s in memory.all(graph)] == [(1, 0)]
    for stamp_ns in range(3, 3 * PRUNE_FRAMES):
        new_id = graph.add_node(np.zeros(3), np.eye(3), np.full(4, 0.25), stamp_ns)
        note(memory, graph, seen_at(stamp_ns, 0.9), [1, new_id])
        graph.remove_node(new_id)
        assert len(memory._seen) <= 2 * PRUNE_FRAMES + 1
    (node,) = memory.all(graph)
    assert len(node.clearest) == CLEAREST


def test_a_removed_row_and_faint_votes_are_not_noted() -> None:
    graph, memory = graph_of(2), FrameMemory()
    note(memory, graph, seen_at(1, 0.5, -9.0), [0, 2])
    note(memory, graph, seen_at(1, 0.5, -9.0), [1, 2])
    assert [(s.node, s.other) for s in memory.all(graph)] == [(1, 0), (2, 0)]


def test_a_map_keeps_them_byte_for_byte(tmp_path) -> None:
    builder = GraphBuilder(CONFIG, VOCABULARY, "world")
    for local in random_local_graphs(np.random.default_rng(0), 40):
        builder.integrate(local)
    write_map(builder, tmp_path / "room.map")
    again = read_map(CONFIG, tmp_path / "room.map")
    assert len(again.frames.all(again.graph)) > len(again.graph)
    one, other = copy_state(builder)["seen_frames"], copy_state(again)["seen_frames"]
    assert one.tobytes() == other.tobytes()
    damaged = {**graph_files.read(tmp_path / "room.map"), "seen_frames": np.zeros(3, np.uint8)}
    graph_files.write(tmp_path / "room.map", damaged)
    with pytest.raises(ConfigurationError, match="JSON"):
        read_map(CONFIG, tmp_path / "room.map")


def test_explain_names_the_frames_of_a_saved_graph(tmp_path) -> None:
    builder = GraphBuilder(CONFIG, VOCABULARY, "world")
    for stamp in range(1, 6):
        builder.integrate(view(stamp, (HERE, CUP), (FLOOR, TABLE)))
    message = builder.full()
    path = write_graph(tmp_path, message)
    assert AskedGraph.load(tmp_path).explain(1).values["frames"] is None
    stamp_ns = wire.ns_from_stamp(message.stamp)
    write_seen(path, stamp_ns, builder.frames.all(builder.graph))
    found = AskedGraph.load(tmp_path).explain(1)
    assert found.lines[1] == (
        "frames: first 0.100, last 0.500, clearest 0.100 (cup 76%), 0.200 (cup 76%), "
        "0.300 (cup 76%)"
    )
    assert found.values["frames"]["clearest"][0]["stamp_ns"] == 10**8
    # The file of another graph, or a damaged one, is not used.
    write_seen(path, stamp_ns + 1, builder.frames.all(builder.graph))
    assert AskedGraph.load(tmp_path).frames(1) is None
    path_beside(path).write_text("{")
    assert AskedGraph.load(tmp_path).frames(1) is None


def test_a_merged_object_has_the_frames_of_both() -> None:
    builder = GraphBuilder(CONFIG, VOCABULARY, "world")
    for stamp in range(1, 6):
        builder.integrate(view(stamp, (HERE, CUP), (FLOOR, TABLE)))
    (merged,) = builder.edit(MergeNodes([1, 2])).nodes
    seen = {item.node: item for item in builder.frames.all(builder.graph) if not item.other}
    assert seen[merged].first_ns == 10**8 and len(seen[merged].clearest) == CLEAREST
