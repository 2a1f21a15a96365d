"""The published graph: what it says depends on no history, and updates are what differs."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.merging import VOCABULARY as VOCABULARY_OF_FRAMES
from support.merging import local_graph
from support.reference_updates import diff
from support.room_nodes import DINNER, VOCABULARY, change, room
from support.spaces import BOARD, ON_BOARD, walk_round

from deworldsg_ros.config import Config, InputsConfig, MergingConfig, OutputConfig, RelationsConfig
from deworldsg_ros.graph.edits import SetLabel
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence, Vocabulary, derived
from deworldsg_ros.wire.follow import GraphReplica

RULES = {
    "physics": RelationsConfig(),
    "votes": RelationsConfig(world_model="none"),
    "paper": RelationsConfig(world_model="fake", edge_belief="paper"),
    "paper, physics": RelationsConfig(edge_belief="paper"),
}
of_all = pytest.mark.parametrize("relations", RULES.values(), ids=list(RULES))


@of_all
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_edges_do_not_depend_on_the_history(relations: RelationsConfig, seed: int) -> None:
    """Things are seen, moved and merged; a new builder of the same graph says the same."""
    rng, config = np.random.default_rng(seed), Config(relations=relations)
    builder, replica = room(DINNER, config, seed)[0], GraphReplica()
    for _ in range(30):
        change(builder, rng)
        update = builder.update()
        if update is not None:
            replica.apply(update)
        if rng.random() < 0.6:
            continue  # several changes at once
        told = {(edge.subject, edge.object): edge for edge in builder.full().edges}
        assert list(told) == sorted(told)
        fresh = GraphBuilder(config, VOCABULARY, "map", builder.graph, builder.prior)
        again = {(edge.subject, edge.object): edge for edge in fresh.full().edges}
        assert told.keys() == again.keys()
        for pair, edge in told.items():
            assert (edge.predicate, edge.mutual) == (again[pair].predicate, again[pair].mutual)
            assert edge.probability == pytest.approx(again[pair].probability, abs=0.0011)
        while builder.waiting:
            replica.apply(builder.update())
        if (update := builder.update()) is not None:
            replica.apply(update)
        assert replica.edges == told


@of_all
@pytest.mark.parametrize("seed", range(3))
def test_an_update_is_what_two_snapshots_differ_in(
    relations: RelationsConfig, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = OutputConfig(include_surface_points=seed == 1)
    builder, _ = room(DINNER, Config(relations=relations, output=output))
    rng = np.random.default_rng(seed)
    removals: list[dict[int, int | None]] = []
    take = builder.graph.take_removals
    monkeypatch.setattr(
        builder.graph, "take_removals", lambda: removals.append(take()) or removals[-1]
    )
    previous, told = builder.snapshot(), 0
    for _ in range(40):
        change(builder, rng)
        update = builder.update()
        current = builder.snapshot()
        if update is None:
            assert current is previous and not removals[-1]
            continue
        assert update == diff(previous, current, removals[-1])
        for node in (*update.nodes, *current.nodes):
            assert (node.surface_mm is not msgspec.UNSET) == (seed == 1)
        previous, told = current, told + 1
    assert told > 5 and max(removals, key=len)


@of_all
def test_names_may_come_at_any_time(relations: RelationsConfig, tmp_path: Path) -> None:
    """500 names, each frame with its own in an order of its own; a map is read in between."""
    rng, count, predicates = np.random.default_rng(0), 500, VOCABULARY_OF_FRAMES.predicates
    config = Config(relations=relations, output=OutputConfig(min_existence=0.0))
    everything = tuple(f"thing {index}" for index in range(count))
    builder = GraphBuilder(config, Vocabulary(("room",), predicates), "world")
    knowing = GraphBuilder(config, Vocabulary(everything, predicates), "world")
    prediction, cube = np.array([[0.8, 0.1, 0.1]]), rng.random((60, 3)) * 0.2
    for stamp in range(2 * count - 2):
        seen = np.array([stamp // 2, stamp // 2 + 1])
        means = np.stack([seen % 20 * 0.6, seen // 20 * 0.6, np.ones(2)], axis=1).astype(float)
        points = tuple((mean + cube).astype(np.float32) for mean in means)
        names, classes = rng.permutation(seen), np.full((2, 2), 0.1)
        classes[names == seen[:, None]] = 0.9
        vocabulary = Vocabulary(tuple(everything[name] for name in names), predicates)
        known = np.zeros((2, count))
        known[:, names] = classes
        fields = {"points": points, "pairs": [(0, 1)], "logits": np.array([[4.0, 0.0, 0.0]])}
        boxes = stamp + 1, means, np.tile(0.003 * np.eye(3), (2, 1, 1))
        local = local_graph(*boxes, classes, vocabulary=vocabulary, **fields)
        for one, frame in ((builder, local), (knowing, local_graph(*boxes, known,
                           vocabulary=knowing.graph.vocabulary, **fields))):  # fmt: skip
            one.integrate(frame)
            rows = frame.class_probabilities.argmax(axis=1)[None]
            shown = (frame.stamp_ns, frame.vocabulary, np.array([[0, 1]]), rows, np.ones(1))
            one.add_evidence(RelationEvidence(*shown, prediction, "fake"))
        if stamp == count:
            write_map(builder, tmp_path / "half.map")
            builder = read_map(config, tmp_path / "half.map")
        if stamp % 100 == 0:
            builder.update()
    told, expected = builder.full(), knowing.full()
    assert [node.label for node in told.nodes] == list(everything)
    assert [node.label for node in expected.nodes] == list(everything)
    assert len(builder.prior) == len(knowing.prior) == count - 1
    said = [
        {(edge.subject, edge.object): edge.predicate for edge in graph.edges}
        for graph in (told, expected)
    ]
    assert said[0] == said[1] and said[0]


def test_a_clock_that_was_set_back_does_not_end_the_graph() -> None:
    builder = GraphBuilder(Config(), VOCABULARY_OF_FRAMES, "world")

    def seen_at(stamp_ns: int) -> list[int]:
        seen = np.zeros((1, 3)), 0.01 * np.eye(3)[None], np.full((1, 4), 0.25)
        return builder.integrate(local_graph(stamp_ns, *seen))

    hour_ns = 3600 * 10**9
    seen_at(hour_ns)
    with pytest.raises(RefusedInput) as refused:
        seen_at(hour_ns - 10**9)
    assert refused.value.reason == "out_of_order"
    assert seen_at(10**9)
    assert seen_at(2 * 10**9)
    builder.update()
    assert builder.snapshot().stamp.sec == 2


def frames_with(frames: list[LocalGraph], label: str, box: object) -> list[LocalGraph]:
    """The frames with a detection: points on the top and the sides of a box (2, 3)."""
    low, high = np.array(box)
    points = np.random.default_rng(0).uniform(low, high, (1500, 3))
    points[:500, 2] = high[2]
    points[500:1000, 0] = np.where(points[500:1000, 1] > low[1:2].mean(), low[0], high[0])
    points[1000:, 1] = np.where(points[1000:, 0] > (low[0] + high[0]) / 2, low[1], high[1])
    classes = np.full((1, 4), 0.04)
    classes[0, VOCABULARY_OF_FRAMES.classes.index(label)] = 0.88
    seen = points.mean(axis=0)[None], np.cov(points.T)[None], classes
    surface = (points.astype(np.float32),)
    return [
        local_graph(
            frame.stamp_ns,
            *seen,
            points=surface,
            depth_grid=frame.depth_grid,
            T_world_camera=frame.T_world_camera,
        )
        for frame in frames
    ]


def test_what_no_detector_fires_at_is_a_node_without_a_name(tmp_path: Path) -> None:
    frames = frames_with(walk_round(BOARD, ON_BOARD, steps=36), "table", BOARD)
    nodes = {}
    for rule in ("surface", "things"):
        config = Config(merging=MergingConfig(association=rule), inputs=InputsConfig(world_up="z"))
        builder = GraphBuilder(config, VOCABULARY_OF_FRAMES, "world")
        for frame in frames:
            builder.integrate(frame)
        builder.update()
        builder.find_things()
        nodes[rule] = builder.full().nodes
    table, thing = nodes["things"]
    assert nodes["surface"] == [table] and table.label == "table"
    assert (thing.label, thing.named) == ("object", False) and 3 <= thing.observations <= 36
    assert 0.7 < thing.existence < 0.95 and thing.classes[0].probability < 0.5
    low, high = np.array(ON_BOARD)
    np.testing.assert_allclose(thing.box.center_m, (low + high) / 2, atol=0.02)
    np.testing.assert_allclose(thing.box.size_m, high - low, atol=0.03)
    said = {(edge.subject, edge.object): edge.predicate for edge in builder.full().edges}
    assert said[thing.id, table.id] == "on"
    assert [node.id for node in builder.update().nodes] == [thing.id]
    # It is found once, and stays while nothing is seen through it.
    again = [derived(frame, stamp_ns=frame.stamp_ns + 10**10) for frame in frames]
    for frame in again:
        builder.integrate(frame)
    builder.find_things()
    assert [node.id for node in builder.full().nodes] == [table.id, thing.id]
    path = tmp_path / "room.map"
    write_map(builder, path)
    kept = read_map(config, path)
    assert kept.full().nodes == builder.full().nodes
    # A detector that fires at it names it.
    for frame in frames_with(again[:18], "cup", ON_BOARD):
        builder.integrate(derived(frame, stamp_ns=frame.stamp_ns + 10**10))
    named = {node.id: node.label for node in builder.full().nodes}
    assert named == {table.id: "table", thing.id: "cup"}
    # Carried away.
    for frame in walk_round(BOARD, steps=36):
        kept.integrate(derived(frame, stamp_ns=frame.stamp_ns + 2 * 10**10))
    assert [node.id for node in kept.full().nodes] == [table.id]


def test_a_thing_that_its_own_views_do_not_show_any_more_goes() -> None:
    config = Config(merging=MergingConfig(association="things"), inputs=InputsConfig(world_up="z"))
    builder = GraphBuilder(config, VOCABULARY_OF_FRAMES, "world")
    for frame in walk_round(BOARD, ON_BOARD, steps=36):
        builder.integrate(frame)
    found = builder.things.find((0.0, 0.0, 1.0), [])
    assert (found.since_ns, found.moves) == (10**8, 0)
    (thing,) = found.things
    assert found.since_ns <= thing.first_ns < thing.last_ns <= 36 * 10**8
    assert thing.views >= 3
    ghost = thing._replace(points_world=thing.points_world - np.float32((0.5, 0.1, 0.0)))
    builder.add_things(found._replace(things=[thing, ghost]))
    assert [(node.id, node.observations) for node in builder.full().nodes] == [
        (1, thing.views), (2, thing.views),
    ]  # fmt: skip
    # These views are newer than the ghost: they cannot tell.
    builder.add_things(found._replace(things=[thing], since_ns=thing.first_ns + 1))
    assert [node.id for node in builder.full().nodes] == [1, 2]
    # Of a thing that is found again, the newest surface counts.
    more = thing._replace(points_world=thing.points_world + np.float32((0.03, 0.0, 0.0)))
    before = builder.full().nodes[0].mean_m[0]
    builder.add_things(found._replace(things=[more]))
    (node,) = builder.full().nodes
    assert node.id == 1 and node.mean_m[0] - before == pytest.approx(0.03, abs=1e-3)
    builder.edit(SetLabel(1, "jar"))
    builder.add_things(found._replace(things=[]))
    assert [node.label for node in builder.full().nodes] == ["jar"]


def test_things_follow_a_corrected_trajectory() -> None:
    config = Config(merging=MergingConfig(association="things"), inputs=InputsConfig(world_up="z"))
    builder = GraphBuilder(config, VOCABULARY_OF_FRAMES, "world")
    for frame in walk_round(BOARD, ON_BOARD, steps=36):
        builder.integrate(frame)
    builder.find_things()
    (before,) = builder.full().nodes
    found = builder.things.find((0.0, 0.0, 1.0), [])
    T = np.eye(4)
    T[:3, 3] = (1.0, 0.5, 0.0)
    assert builder.apply_correction(T, 0) == 1
    (after,) = builder.full().nodes
    np.testing.assert_allclose(np.subtract(after.mean_m, before.mean_m), T[:3, 3], atol=2e-3)
    builder.find_things()
    assert len(builder.full().nodes) == 1
    builder.add_things(found)  # found where they were before the correction
    assert len(builder.full().nodes) == 1
