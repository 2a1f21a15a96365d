"""The published edges: only changed ones are rebuilt."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.merging import VOCABULARY as VOCABULARY_OF_FRAMES
from support.merging import local_graph, set_confirmed
from support.reference_updates import diff

from deworldsg_ros.config import Config, RelationsConfig
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.wire.follow import GraphReplica
from deworldsg_ros.wire.messages import SceneGraphMessage

VOCABULARY = Vocabulary(("cup", "table", "chair"), ("near", "on", "above", "under"))


def builder_config(robust: bool) -> Config:
    return Config(relations=RelationsConfig(edge_belief="robust" if robust else "paper"))


def builder_of(nodes: int, robust: bool = True) -> GraphBuilder:
    builder = GraphBuilder(builder_config(robust), VOCABULARY, "map")
    for place in range(nodes):
        add_node(builder, float(place))
    return builder


def add_node(builder: GraphBuilder, x_m: float, confirmed: bool = True) -> None:
    classes = np.roll([0.6, 0.3, 0.1], int(x_m))
    builder.graph.add_node(np.array([x_m, 0, 0]), np.eye(3) * 1e-3, classes, 1, confirmed=confirmed)


def see(builder: GraphBuilder, subject: int, object_: int, **certainties: float) -> None:
    logits = [certainties.get(name, 0.0) for name in VOCABULARY.predicates]
    builder.graph.add_visual(subject, object_, np.array(logits), 1)


def stated(message: SceneGraphMessage) -> dict[tuple[int, int], tuple[str, float]]:
    return {
        (edge.subject, edge.object): (edge.predicate, round(edge.probability, 3))
        for edge in message.edges
    }


def vote(builder: GraphBuilder, subject: int, object_: int, name: str, frames: int) -> None:
    """Frames that show both nodes, and say that the subject is `name` the object."""
    counts = np.zeros((2, len(VOCABULARY.predicates)))
    counts[0, VOCABULARY.predicates.index(name)] = 0.9
    for _ in range(frames):
        builder.graph.add_votes(subject, object_, counts)


def test_evidence_of_one_direction_changes_the_other_in_the_updates() -> None:
    builder, replica = builder_of(2), GraphReplica()
    vote(builder, 1, 2, "on", 10)
    for subject, object_, frames in [(1, 2, 0), (2, 1, 10), (2, 1, 40)]:
        vote(builder, subject, object_, "on", frames)
        update = builder.update()
        assert update is not None
        replica.apply(update)
        edges = builder.snapshot().edges
        assert list(replica.edges.values()) == edges
        on = {(edge.subject, edge.object): edge.probability for edge in edges}
        assert sum(on.values()) <= 1.001  # an object cannot lie on what lies on it
        if frames == 0:
            assert set(on) == {(1, 2)} and on[1, 2] > 0.5
        if frames == 40:
            assert max(on, key=lambda pair: on[pair]) == (2, 1)


def test_the_paper_treats_each_direction_by_itself() -> None:
    builder = builder_of(2, robust=False)
    see(builder, 1, 2, on=30)
    see(builder, 2, 1, on=30)
    assert stated(builder.full()) == {(1, 2): ("on", 1.0), (2, 1): ("on", 1.0)}


def test_an_unchanged_edge_is_the_same_object() -> None:
    builder = builder_of(4)
    vote(builder, 1, 2, "on", 10)
    vote(builder, 3, 4, "on", 10)
    before = builder.full().edges
    vote(builder, 3, 4, "near", 3)
    after = builder.full().edges
    assert after[0] is before[0] and after[1] is not before[1]


def change(builder: GraphBuilder, generator: np.random.Generator) -> None:
    """Anything that may change an edge, at random."""
    graph = builder.graph
    one, other = generator.choice(list(graph.nodes.slot_of), 2, replace=False).tolist()
    kind = generator.choice(
        ["see", "near", "predict", "observe", "confirm", "merge", "remove", "move", "add"],
        p=[0.2, 0.2, 0.3, 0.1, 0.04, 0.04, 0.04, 0.04, 0.04],
    )
    if kind == "see":
        graph.add_visual(one, other, generator.normal(0, 3, 4), 1)
    elif kind == "near":
        graph.add_neighbours([(one, other), (other, one)], 1)
    elif kind == "predict":
        builder.prior.update(generator.integers(0, 3, (1, 2)), generator.dirichlet(np.ones(4), 1))
    elif kind == "observe":
        graph.observe(one, np.zeros(3), np.eye(3), generator.dirichlet(np.ones(3)), 2)
    elif kind == "confirm":
        set_confirmed(graph, one, bool(generator.integers(2)))
    elif kind == "add" or len(graph) < 4:
        add_node(builder, float(generator.integers(9)), bool(generator.integers(2)))
    elif kind == "merge":
        graph.merge_nodes(one, other)
    elif kind == "remove":
        graph.remove_node(one)
    else:
        graph.take_over(*sorted((one, other)))


@pytest.mark.parametrize("robust", [True, False])
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_edges_do_not_depend_on_the_history_of_the_builder(robust: bool, seed: int) -> None:
    builder, replica = builder_of(6, robust), GraphReplica()
    generator = np.random.default_rng(seed)
    for _ in range(40):
        change(builder, generator)
        update = builder.update()
        if update is not None:
            replica.apply(update)
        fresh = GraphBuilder(
            builder_config(robust), VOCABULARY, "map", builder.graph, builder.prior
        )
        assert builder.full().edges == fresh.full().edges
        assert replica.edges == {(e.subject, e.object): e for e in fresh.full().edges}


@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_an_update_is_what_two_snapshots_differ_in(
    robust: bool, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    builder, generator = builder_of(6, robust), np.random.default_rng(seed)
    removals: list[dict[int, int | None]] = []
    take = builder.graph.take_removals
    monkeypatch.setattr(
        builder.graph, "take_removals", lambda: removals.append(take()) or removals[-1]
    )
    previous, told = builder.snapshot(), 0
    for _ in range(40):
        change(builder, generator)
        update = builder.update()
        current = builder.snapshot()
        if update is None:
            assert current is previous and not removals[-1]
            continue
        assert update == diff(previous, current, removals[-1])
        previous, told = current, told + 1
    assert told > 5


def test_a_clock_that_was_set_back_does_not_end_the_graph() -> None:
    means, covariances = np.zeros((1, 3)), 0.01 * np.eye(3)[None]
    builder = GraphBuilder(builder_config(robust=True), VOCABULARY_OF_FRAMES, "world")

    def seen_at(stamp_ns: int) -> list[int]:
        classes = np.full((1, 4), 0.25)
        return builder.integrate(local_graph(stamp_ns, means, covariances, classes))

    hour_ns = 3600 * 10**9
    seen_at(hour_ns)
    with pytest.raises(RefusedInput, match="came after"):
        seen_at(hour_ns - 10**9)
    assert seen_at(10**9)
    assert seen_at(2 * 10**9)
    builder.update()
    assert builder.snapshot().stamp.sec == 2
