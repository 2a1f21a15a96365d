"""The graph in memory and its published copy give the same answers."""

import math

import msgspec
import pytest
from support.merging import set_confirmed
from support.scripted import PAPER, Scripted, frame

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.relations import LiveGraph, PublishedGraph, RelationReasoner, build_world_model
from deworldsg_ros.wire import messages as wire

SURE, UNSURE = (3.0, -3.0, -3.0), (0.001, 0.0, 0.0)


def answers(view, stamps_ns):
    """All queries on a graph of three nodes."""
    told = {stamp_ns: view.nodes_of_frame(stamp_ns) for stamp_ns in stamps_ns}
    live = {node_id for node_ids in told.values() for node_id in node_ids or () if node_id}
    nodes = {node_id: view.node(node_id) for node_id in live}
    entropies = {(a, b): view.visual_entropy_nats(a, b) for a in live for b in live}
    return told, nodes, entropies


def sent(message):
    """A message after encoding and decoding, as through DDS."""
    return wire.decode(wire.encode(message), type(message))


def running(logits=UNSURE):
    """A pipeline's builder after each of some frames, with its update and its snapshot."""
    pipeline = Pipeline(PAPER, Scripted(logits))
    for index in range(8):
        result = pipeline.process(frame(index))
        builder = pipeline.builder
        yield builder, builder.update(), builder.snapshot(), result.local.stamp_ns


@pytest.mark.parametrize("logits", [SURE, UNSURE])
def test_the_published_graph_gives_the_results_of_the_live_one(logits):
    published, stamps_ns = PublishedGraph(), []
    for builder, update, _, stamp_ns in running(logits):
        stamps_ns.append(stamp_ns)
        published.apply(sent(update))
        assert not published.wants_snapshot and published.generation == 0
        assert published.newest_ns == stamp_ns
        assert answers(published, stamps_ns) == answers(LiveGraph(builder.graph), stamps_ns)
    told, nodes, entropies = answers(published, stamps_ns)
    assert told[stamps_ns[0]] == [1, 2, 3] and nodes[1].label == "cup"
    assert nodes[1].observations == 8 and math.isinf(entropies[1, 3])
    assert (entropies[1, 2] > 1.0) == (logits is UNSURE)


def test_a_tentative_node_has_an_id_and_no_view():
    (builder, update, _, stamp_ns), *_ = running()
    published = PublishedGraph()
    published.apply(msgspec.structs.replace(update, nodes=update.nodes[:2]))
    set_confirmed(builder.graph, 3, False)
    for view in (published, LiveGraph(builder.graph)):
        assert view.nodes_of_frame(stamp_ns) == [1, 2, 3]
        assert view.node(3) is None and view.node(2) is not None


@pytest.mark.parametrize("lost", [{1}, {3}, {2, 3, 4}])
def test_after_lost_updates_a_snapshot_restores_the_graph(lost):
    published, stamps_ns, older = PublishedGraph(), [], None
    for builder, update, snapshot, stamp_ns in running():
        if update.sequence in lost:
            continue
        stamps_ns.append(stamp_ns)
        published.apply(sent(update))
        assert published.wants_snapshot == (update.sequence - 1 in lost)
        if published.wants_snapshot:
            if older is not None:  # than the last update: ignored
                published.reset(older)
                assert published.wants_snapshot
            published.reset(sent(snapshot))
        assert answers(published, stamps_ns) == answers(LiveGraph(builder.graph), stamps_ns)
        older = snapshot
    assert len(stamps_ns) == 8 - len(lost)


def test_a_graph_that_starts_again_replaces_the_old_one():
    published = PublishedGraph()
    for logits in (SURE, UNSURE):
        run = list(running(logits))
        for _, update, _, _ in run:
            published.apply(update)
    builder, _, _, stamp_ns = run[-1]
    assert published.generation == 1
    assert answers(published, [stamp_ns]) == answers(LiveGraph(builder.graph), [stamp_ns])


def test_merged_nodes_are_followed_and_removed_ones_may_return():
    _, update, snapshot, stamp_ns = next(running())
    published = PublishedGraph()
    published.apply(update)
    gone = msgspec.structs.replace(
        update,
        sequence=2,
        removed_nodes=[wire.RemovedNode(1), wire.RemovedNode(3, merged_into=2)],
        nodes=[],
        edges=[],
        associations=[],
    )
    published.apply(gone)
    assert published.nodes_of_frame(stamp_ns) == [0, 2, 2]
    back = msgspec.structs.replace(gone, sequence=3, removed_nodes=[], nodes=[snapshot.nodes[0]])
    published.apply(back)
    assert published.nodes_of_frame(stamp_ns) == [1, 2, 2]


def test_the_number_of_remembered_frames_is_bounded(monkeypatch):
    monkeypatch.setattr("deworldsg_ros.relations.clips.REMEMBERED_FRAMES", 3)
    published, stamps_ns = PublishedGraph(), []
    for _, update, _, stamp_ns in running():
        published.apply(update)
        stamps_ns.append(stamp_ns)
    known = [published.nodes_of_frame(stamp_ns) is not None for stamp_ns in stamps_ns]
    assert known == [False] * 5 + [True] * 3


def test_the_chosen_clips_give_the_edges_of_all_clips():
    told, encoded = [], []
    for budget in ({}, {"max_clips_per_s": 0.0}):
        relations = RelationsConfig(
            world_model="fake", clip_length=4, edge_belief="paper", **budget
        )
        pipeline = Pipeline(msgspec.structs.replace(PAPER, relations=relations), Scripted(UNSURE))
        for index in range(30):
            pipeline.process(frame(index))
        edges = pipeline.graph().edges
        told.append([(edge.subject, edge.predicate, edge.provenance) for edge in edges])
        encoded.append(pipeline.relations.counters().encoded)
    assert encoded == [5, 30]  # seen 1, 2, 4, 8 and 16 times
    assert told[0] == told[1]
    assert [edge[2] for edge in told[0]] == ["fused", "prior"]  # both directions


def test_clips_wait_for_updates_that_come_late_and_in_groups():
    """The graph node publishes a few times a second: clips wait for its next update."""
    relations = RelationsConfig(world_model="fake", clip_length=4, max_clips_per_s=1000.0)
    stage = RelationReasoner(relations, build_world_model(relations))
    pipeline, published, encoded = Pipeline(PAPER, Scripted(UNSURE)), PublishedGraph(), []
    stage.watch(published)
    for index in range(30):
        local = pipeline.process(frame(index)).local
        stage.observe(local, frame(index).rgb)
        if index % 5 == 4:
            published.apply(sent(pipeline.builder.update()))
        encoded += [evidence.stamp_ns for evidence in stage.drain()]
    # Before the first update no graph is known, and all clips are encoded. The updates then show 5,
    # 10 and 20 observations.
    assert encoded == [index * 10**8 for index in (0, 1, 2, 3, 4, 9, 19)]
