"""Updates between snapshots, and the replica that follows them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from support.merging import VOCABULARY, edit_at_random, seeds
from support.node_states import node_states
from support.reference_updates import diff

from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import GraphReplica, empty_scene_graph
from deworldsg_ros.wire.messages import SceneGraphMessage, SceneGraphUpdateMessage


def snapshot_of(graph: SceneGraph, sequence: int):
    nodes = node_states(graph, 2, with_points=True)
    edges = []
    for subject, object_ in sorted(graph.edges):
        evidence = graph.edges[subject, object_]
        if subject in nodes and object_ in nodes:
            label = VOCABULARY.predicates[int(evidence.visual_logits.argmax())]
            belief = wire.Belief(label, 0.5)
            edges.append(
                wire.EdgeState(
                    subject, object_, label, 0.5, [belief], "visual", 0.1, evidence.frames
                )
            )
    return wire.SceneGraphMessage(
        schema=wire.schema_of(wire.SceneGraphMessage),
        stamp=wire.stamp_from_ns(sequence * 10**8),
        frame_id="world",
        sequence=sequence,
        nodes=list(nodes.values()),
        edges=edges,
    )


@given(seeds)
@settings(max_examples=30)
def test_a_replica_that_missed_nothing_is_the_graph(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = SceneGraph(VOCABULARY, "world", surface_point_capacity=3)
    previous = empty_scene_graph("world")
    from_start, joined_late = GraphReplica(), GraphReplica()
    known: set[int] = set()
    for sequence in range(1, 12):
        edit_at_random(graph, rng, int(rng.integers(0, 8)))
        current = snapshot_of(graph, sequence)
        update = diff(previous, current, graph.take_removals())
        sent = wire.decode(wire.encode(update), wire.SceneGraphUpdateMessage)
        assert sent == update
        assert from_start.apply(sent)
        if sequence == 5:
            joined_late.reset(wire.decode(wire.encode(current), wire.SceneGraphMessage))
        if sequence >= 5:
            assert joined_late.apply(sent) == (sequence > 5)
            assert joined_late.message() == current
        assert from_start.message() == current
        # An update tells nothing that was known, and every node that went.
        assert not {(n.id, n.observations, n.existence) for n in update.nodes} & {
            (n.id, n.observations, n.existence) for n in previous.nodes
        }
        now = {node.id for node in current.nodes}
        assert known - now <= {node.id for node in update.removed_nodes}
        for removed in update.removed_nodes:
            assert removed.merged_into is None or removed.merged_into in graph
        known, previous = now, current


def test_an_update_names_the_successors_of_merged_nodes() -> None:
    graph = SceneGraph(VOCABULARY, "world")
    for x in range(4):
        graph.add_node(np.array([x, 0.0, 0]), np.eye(3), np.full(4, 0.25), 0)
    graph.add_visual(3, 4, np.ones(3), 0)
    first = snapshot_of(graph, 1)
    graph.merge_nodes(3, 2)
    graph.remove_node(1)
    association = wire.Association(wire.Stamp(0, 5), [2, 4])
    update = diff(first, snapshot_of(graph, 2), graph.take_removals(), [association])
    assert update.removed_nodes == [wire.RemovedNode(1, None), wire.RemovedNode(3, 2)]
    assert update.removed_edges == [wire.RemovedEdge(3, 4)]
    assert [node.id for node in update.nodes] == [2]
    assert [(edge.subject, edge.object) for edge in update.edges] == [(2, 4)]
    assert update.associations == [association]


def test_nothing_changed_gives_an_empty_update() -> None:
    graph = SceneGraph(VOCABULARY, "world")
    edit_at_random(graph, np.random.default_rng(0), 30)
    graph.take_removals()
    update = diff(snapshot_of(graph, 3), snapshot_of(graph, 4))
    assert (update.nodes, update.edges, update.removed_nodes, update.removed_edges) == (
        [],
        [],
        [],
        [],
    )


@pytest.mark.parametrize(("before", "after"), [(1, 1), (1, 3), (2, 1)])
def test_only_consecutive_snapshots_have_an_update(before: int, after: int) -> None:
    graph = SceneGraph(VOCABULARY, "world")
    with pytest.raises(ValueError, match="consecutive"):
        diff(snapshot_of(graph, before), snapshot_of(graph, after))


def test_a_lost_update_is_noticed_and_a_snapshot_mends_it() -> None:
    graph = SceneGraph(VOCABULARY, "world")
    snapshots = [empty_scene_graph("world")]
    updates = []
    for sequence in range(1, 5):
        graph.add_node(np.zeros(3), np.eye(3), np.full(4, 0.25), sequence)
        snapshots.append(snapshot_of(graph, sequence))
        updates.append(diff(snapshots[-2], snapshots[-1]))
    replica = GraphReplica()
    replica.apply(updates[0])
    with pytest.raises(RefusedInput, match="update 4 after 1: 2 lost") as refused:
        replica.apply(updates[3])
    assert refused.value.reason == "lost_updates"
    assert replica.message() == snapshots[1]
    replica.reset(snapshots[3])
    assert not replica.apply(updates[1])
    assert replica.sequence == 3
    assert replica.apply(updates[3])
    assert replica.message() == snapshots[4]


def session_of(name: str, nodes: int) -> tuple[list[SceneGraphUpdateMessage], SceneGraphMessage]:
    """The updates and the last snapshot of a session that adds one node each time."""
    graph = SceneGraph(VOCABULARY, "world")
    snapshots, updates = [empty_scene_graph("world")], []
    for sequence in range(1, nodes + 1):
        graph.add_node(np.zeros(3), np.eye(3), np.full(4, 0.25), sequence)
        snapshots.append(snapshot_of(graph, sequence))
        updates.append(diff(snapshots[-2], snapshots[-1]))
        updates[-1].session = snapshots[-1].session = name
    return updates, snapshots[-1]


def test_the_next_number_of_another_session_is_not_applied() -> None:
    old, old_snapshot = session_of("a", 3)
    new, new_snapshot = session_of("b", 4)
    replica = GraphReplica()
    for update in old:
        replica.apply(update)
    assert replica.session == "a"
    with pytest.raises(RefusedInput, match="session 'b'") as refused:
        replica.apply(new[3])
    assert refused.value.reason == "other_session"
    assert replica.message() == old_snapshot
    replica.reset(new_snapshot)
    assert not replica.apply(new[3])
    assert replica.message() == new_snapshot


def test_the_first_update_of_a_session_replaces_the_copy() -> None:
    old, _ = session_of("a", 5)
    new, new_snapshot = session_of("b", 2)
    replica = GraphReplica()
    for update in [*old, *new]:
        assert replica.apply(update)
    assert replica.message() == new_snapshot
