"""The table of pairs, kept up to date, against a table made anew."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import softmax
from support.merging import set_confirmed
from support.room_nodes import (
    VOCABULARY,
    add_node,
    bowl,
    box,
    chair,
    plant,
    room,
    surface,
    table,
    thing,
)

from deworldsg_ros.config import Config
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.graph.pairs import key
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.relations import pairs
from deworldsg_ros.relations.beliefs import MIN_RELATED, PredictedPrior
from deworldsg_ros.relations.geometry import NodeShapes
from deworldsg_ros.relations.pairs import (
    FLOOR_QUANTILE,
    FLOOR_STEP_M,
    PairTable,
    floor_height,
    stepped_up,
)
from deworldsg_ros.relations.physics import load_physics_model, relation_counts
from deworldsg_ros.relations.reach import MIN_SHAPE_POINTS
from deworldsg_ros.relations.states import (
    NONE,
    RELATIONS_OF_STATE,
    canonical_predicates,
    relation_of_predicates,
)

seeds = st.integers(0, 10_000)
Z = np.array([0.0, 0.0, 1.0])
WIDTH = len(VOCABULARY.predicates)
THINGS = [
    table(0, 0, 0.9, 0.6),
    chair(0, 0.5),
    thing("cup", 0.1, 0.1, 0.74, 0.09, 0.09, 0.1),
    bowl(-0.2, 0, 0.74),
    plant(0.3, 0.1, 0.74),
    thing("book", 0.1, -0.1, 0.74, 0.2, 0.28, 0.03),
    thing("refrigerator", 0.9, 0, 0, 0.6, 0.6, 1.7),
    thing("couch", -1.2, 0, 0, 0.8, 1.2, 0.8),
]


def table_of(graph: SceneGraph, geometry: bool = True) -> PairTable:
    return PairTable(graph, load_physics_model(), geometry=geometry)


def predicted_prior(table: PairTable) -> PredictedPrior:
    """The prior of all pairs of a table."""
    prior = PredictedPrior(VOCABULARY)
    prior.follow(table, table.ids.tolist())
    return prior


Pairs = dict[tuple[int, int], dict[str, np.ndarray]]


def pairs_of(table: PairTable) -> Pairs:
    """What a table says of each pair that is judged or has votes."""
    rows: Pairs = {}
    for row, (first, second) in enumerate(table.nodes.tolist()):
        assert first < second and table.row(key(first, second)) == row
        names: tuple[str, ...] = ("state_logits", "gaps_m") if table.judged[row] else ()
        if table.judged[row] and np.isfinite(table.gaps_m[row]):
            names += ("bottom_steps_m", "centre_steps_m")
        names += ("frames", "counts", "other_votes") if table.frames[row] else ()
        if names:
            rows[first, second] = {name: getattr(table, name)[row].copy() for name in names}
    return rows


def assert_equal(one: Pairs, other: Pairs) -> None:
    assert one.keys() == other.keys()
    for pair, told in one.items():
        assert told.keys() == other[pair].keys(), pair
        for name, values in told.items():
            np.testing.assert_allclose(values, other[pair][name], atol=1e-3, err_msg=name)


def change(builder: GraphBuilder, rng: np.random.Generator) -> None:
    """Anything that may change a pair, at random."""
    graph = builder.graph
    ids = list(graph.nodes.slot_of)
    kind = rng.choice(
        ["votes", "observe", "confirm", "add", "merge", "remove", "move", "take over"],
        p=[0.34, 0.2, 0.1, 0.12, 0.06, 0.06, 0.06, 0.06],
    )
    if kind == "add" or len(ids) < 4:
        parts = THINGS[rng.integers(len(THINGS))]
        node_id = add_node(builder, parts, rng, frames=1)
        set_confirmed(graph, node_id, bool(rng.integers(3)))
        return
    one, other = rng.choice(ids, 2, replace=False).tolist()
    if kind == "votes":
        graph.add_votes(one, other, rng.uniform(0, 0.02, (2, WIDTH)) if rng.integers(3) else None)
    elif kind == "observe":
        parts = THINGS[rng.integers(len(THINGS))].parts
        classes = rng.dirichlet(np.ones(len(VOCABULARY.classes)))
        points = surface(parts, rng, int(rng.integers(0, 60)))
        graph.observe(one, np.zeros(3), np.eye(3), classes, 5, points)
    elif kind == "confirm":
        set_confirmed(graph, one, bool(rng.integers(2)))
    elif kind == "merge":
        graph.merge_nodes(one, other)
    elif kind == "remove":
        graph.remove_node(one)
    elif kind == "move":
        T = np.eye(4)
        T[:3, 3] = rng.normal(0, 0.5, 3)
        graph.move_node(one, T)
    else:
        graph.take_over(*sorted((one, other)))


@pytest.mark.parametrize("geometry", [True, False])
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_a_table_that_follows_equals_one_made_anew(geometry: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    builder, _ = room({str(index): item for index, item in enumerate(THINGS[:4])}, seed=seed)
    followed = table_of(builder.graph, geometry)
    up = Z
    for step in range(25):
        change(builder, rng)
        if rng.integers(3) and step < 24:
            continue  # several changes at once
        if rng.random() < 0.1:
            up = rng.normal(0, 0.1, 3) + Z
        followed.refresh(up)
        fresh = table_of(builder.graph, geometry)
        fresh.refresh(up)
        assert_equal(pairs_of(followed), pairs_of(fresh))
        assert followed.floor_m == fresh.floor_m
        assert sorted(followed.shapes.ids) == sorted(fresh.shapes.ids)
        # Pairs without a trace of evidence take part in no belief.
        assert sorted(followed.ids) == sorted(fresh.ids)


def test_what_did_not_change_is_not_judged_again(monkeypatch: pytest.MonkeyPatch) -> None:
    builder, ids = room({str(index): item for index, item in enumerate(THINGS[:4])})
    followed = table_of(builder.graph)
    followed.refresh(Z)
    put: list[int] = []
    original = NodeShapes.put
    monkeypatch.setattr(
        NodeShapes,
        "put",
        lambda self, rows, *args: (put.extend(rows.tolist()), original(self, rows, *args)),
    )
    followed.refresh(Z)
    assert put == []
    builder.graph.observe(ids["2"], np.zeros(3), np.eye(3), np.ones(80), 9)
    followed.refresh(Z)
    assert put == [followed.shapes.row(ids["2"])]


def test_a_small_change_of_the_up_direction_judges_nothing_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    builder, _ = room({str(index): item for index, item in enumerate(THINGS[:4])})
    followed = table_of(builder.graph)
    followed.refresh(np.array([0.0, -0.9, -0.44]))
    put: list[int] = []
    original = NodeShapes.put
    monkeypatch.setattr(
        NodeShapes,
        "put",
        lambda self, rows, *args: (put.extend(rows.tolist()), original(self, rows, *args)),
    )
    followed.refresh(np.array([0.001, -0.9, -0.439]))
    assert put == []
    followed.refresh(np.array([0.0, -0.9, -0.41]))
    assert sorted(put) == sorted(followed.shapes.row(node_id) for node_id in followed.shapes.ids)


def test_the_steps_of_the_up_direction() -> None:
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        np.testing.assert_array_equal(stepped_up(3.0 * axis), axis)
    ups = np.random.default_rng(0).normal(size=(1000, 3))
    for up in ups / np.linalg.norm(ups, axis=1, keepdims=True):
        stepped = stepped_up(up)
        assert np.degrees(np.arccos(stepped @ up / np.linalg.norm(stepped))) < 0.5


def test_an_empty_graph() -> None:
    builder, _ = room({})
    followed = table_of(builder.graph)
    followed.refresh(Z)
    assert len(followed) == 0 and followed.floor_m == 0 and len(predicted_prior(followed)) == 0


def test_votes_are_those_of_the_graph_in_both_directions() -> None:
    builder, ids = room({"cup": THINGS[2], "table": THINGS[0]})
    votes = np.random.default_rng(0).uniform(0, 1, (2, WIDTH)).astype(np.float32)
    builder.graph.add_votes(ids["table"], ids["cup"], votes.astype(float))
    builder.graph.add_votes(ids["cup"], ids["table"], None)
    followed = table_of(builder.graph)
    followed.refresh(Z)
    row = followed.row(key(ids["cup"], ids["table"]))
    assert followed.frames[row] == 2
    relation_of = relation_of_predicates(VOCABULARY.predicates)
    for end in (0, 1):
        expected = relation_counts(votes[::-1][end : end + 1].astype(float), relation_of)[0]
        np.testing.assert_allclose(followed.counts[row, end], expected, rtol=1e-6)
    assert followed.counts.shape == (1, 2, NONE)


def test_hidden_nodes_take_no_part() -> None:
    builder, ids = room({"cup": THINGS[2], "table": THINGS[0], "chair": THINGS[1]})
    graph = builder.graph
    set_confirmed(graph, ids["cup"], False)
    graph.add_votes(ids["cup"], ids["chair"], None)
    graph.add_votes(ids["table"], ids["chair"], None)
    followed = table_of(graph)
    followed.refresh(Z)
    assert followed.nodes.tolist() == [[ids["table"], ids["chair"]]]
    assert sorted(followed.shapes.ids) == [ids["table"], ids["chair"]]
    set_confirmed(graph, ids["cup"], True)
    followed.refresh(Z)
    assert {tuple(pair) for pair in followed.nodes.tolist()} == {(1, 2), (1, 3), (2, 3)}
    assert followed.frames[followed.row(key(ids["cup"], ids["chair"]))] == 1
    set_confirmed(graph, ids["table"], False)
    followed.refresh(Z)
    assert {tuple(pair) for pair in followed.nodes.tolist()} == {(ids["cup"], ids["chair"])}


def test_votes_on_hidden_nodes_hold_up_no_other_pair() -> None:
    builder, ids = room({"cup": THINGS[2], "table": THINGS[0], "chair": THINGS[1]})
    graph = builder.graph
    followed = table_of(graph)
    followed.refresh(Z)
    hidden = [add_node(builder, THINGS[5], np.random.default_rng(i), frames=1) for i in range(4)]
    for node_id in hidden:
        set_confirmed(graph, node_id, False)
        graph.add_votes(node_id, ids["chair"], None)
    graph.add_votes(ids["cup"], ids["chair"], None)
    followed.refresh(Z, at_most=1)
    assert followed.pairs_waiting == 0
    assert followed.frames[followed.row(key(ids["cup"], ids["chair"]))] == 1
    set_confirmed(graph, hidden[0], True)  # its votes count from now on
    followed.refresh(Z)
    assert followed.frames[followed.row(key(ids["chair"], hidden[0]))] == 1


def test_pairs_of_nodes_that_go_wait_no_more() -> None:
    builder, ids = room({"cup": THINGS[2], "table": THINGS[0], "chair": THINGS[1]})
    followed = table_of(builder.graph)
    followed.refresh(Z)
    for name in ("cup", "table", "chair"):
        builder.graph.move_node(ids[name], np.eye(4))
    followed.refresh(Z, at_most=0)
    assert followed.pairs_waiting == 3
    set_confirmed(builder.graph, ids["cup"], False)
    followed.refresh(Z, at_most=0)
    assert followed.pairs_waiting == 1
    set_confirmed(builder.graph, ids["cup"], True)
    followed.refresh(Z)
    assert followed.pairs_waiting == 0 and len(followed) == 3


def test_pairs_out_of_reach_are_not_related() -> None:
    far = thing("refrigerator", 5.0, 0, 0, 0.6, 0.6, 1.7)
    builder, ids = room({"table": THINGS[0], "far": far, "cup": THINGS[2]})
    followed = table_of(builder.graph)
    followed.refresh(Z)
    assert followed.nodes.tolist() == [[ids["table"], ids["cup"]]]
    # It is known of those that were seen together, and judged to be apart.
    builder.graph.add_votes(ids["far"], ids["cup"], np.ones((2, WIDTH)))
    followed.refresh(Z)
    apart = followed.row(key(ids["far"], ids["cup"]))
    assert followed.judged[apart] and np.isinf(followed.gaps_m[apart])
    assert softmax(followed.state_logits[apart])[0] > 0.999
    T = np.eye(4)
    T[0, 3] = 4.6  # the cup moves to the refrigerator
    builder.graph.move_node(ids["cup"], T)
    followed.refresh(Z)
    assert followed.nodes.tolist() == [[ids["far"], ids["cup"]]]
    assert np.isfinite(followed.gaps_m).all()


def test_nodes_with_few_points_are_not_judged() -> None:
    builder, ids = room({"table": THINGS[0]})
    points = surface([box(0, 0, 0.74, 0.1, 0.1, 0.1)], np.random.default_rng(0), 20)
    for count in (0, MIN_SHAPE_POINTS - 1, MIN_SHAPE_POINTS):
        builder.graph.add_node(np.zeros(3), np.eye(3), np.ones(80), 1, points[:count])
    builder.graph.add_votes(3, ids["table"], np.ones((2, WIDTH)))  # too few points: frames alone
    followed = table_of(builder.graph)
    followed.refresh(Z)
    assert followed.nodes[followed.judged].tolist() == [[ids["table"], 4]]
    assert followed.nodes[~followed.judged].tolist() == [[ids["table"], 3]]


def test_without_geometry_no_pair_is_judged() -> None:
    builder, ids = room({"table": THINGS[0], "cup": THINGS[2]})
    builder.graph.add_votes(ids["table"], ids["cup"], np.ones((2, WIDTH)) / WIDTH)
    followed = table_of(builder.graph, geometry=False)
    followed.refresh(Z)
    assert not followed.judged.any() and followed.frames.tolist() == [1]
    assert len(predicted_prior(followed)) == 0


def test_another_up_direction_turns_all_pairs() -> None:
    """A world whose y axis is up: the same room, turned."""
    builder, ids = room({str(index): item for index, item in enumerate(THINGS[:4])})
    followed = table_of(builder.graph)
    followed.refresh(Z)
    upright = pairs_of(followed)
    followed.refresh(np.array([0.0, 1.0, 0.0]))
    lying = pairs_of(followed)
    assert any(abs(lying[pair]["gaps_m"] - told["gaps_m"]) > 0.05 for pair, told in upright.items())
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # z to y
    for node_id in ids.values():
        builder.graph.move_node(node_id, turn)
    followed.refresh(np.array([0.0, 1.0, 0.0]))
    again = pairs_of(followed)
    assert again.keys() == upright.keys()
    for pair, told in upright.items():
        assert again[pair]["gaps_m"] == pytest.approx(told["gaps_m"], abs=0.01)
        np.testing.assert_allclose(again[pair]["state_logits"], told["state_logits"], atol=1.0)


# --- the prior of class pairs --------------------------------------------------------------------


def test_a_large_graph_turns_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairs, "NEW_A_CALL", 4)
    graph = room({str(index): item for index, item in enumerate(THINGS)})[0].graph
    followed = table_of(graph)
    followed.refresh(Z)
    tilted = np.array([0.6, 0.0, 0.8])
    calls = 0
    while not calls or followed.nodes_waiting:
        followed.refresh(tilted, 10, 4)
        assert followed.begun == (not followed.nodes_waiting)
        calls += 1
    assert calls == len(THINGS) / 4 and followed.begun
    # A turn that comes before the other one is done waits for it.
    other = np.array([0.0, 0.6, 0.8])
    followed.refresh(other, 10, 4)
    for _ in range(len(THINGS) // 4 - 1):
        assert not followed.begun
        followed.refresh(tilted, 10, 4)
    assert followed.begun
    followed.refresh(tilted)
    anew = table_of(graph)
    anew.refresh(tilted)
    assert_equal(pairs_of(followed), pairs_of(anew))


def test_the_prior_is_the_mean_of_the_predictions_that_say_something() -> None:
    things = {str(index): item for index, item in enumerate(THINGS)}
    builder, _ = room({**things, "second cup": thing("cup", -0.1, 0.2, 0.74, 0.08, 0.08, 0.1)})
    followed = table_of(builder.graph)
    followed.refresh(Z)
    canonical = canonical_predicates(VOCABULARY.predicates)
    nodes, classes = builder.graph.nodes, {}
    for row, node_id in enumerate(nodes.ids.tolist()):
        classes[node_id] = int(nodes.class_probabilities[row].argmax())
    expected: dict[tuple[int, int], list[np.ndarray]] = {}
    for row in np.flatnonzero(followed.judged):
        states = softmax(followed.state_logits[row])
        first, second = (classes[end] for end in followed.nodes[row].tolist())
        for end, pair in enumerate([(first, second), (second, first)]):
            told = np.zeros(WIDTH)
            for probability, relation in zip(states, RELATIONS_OF_STATE[:, end]):
                if relation != NONE:
                    told[canonical[relation]] += probability
            if told.sum() > MIN_RELATED:
                expected.setdefault(pair, []).append(told / told.sum())
    prior = predicted_prior(followed)
    assert len(prior) == len(expected) >= 3
    for pair, rows in expected.items():
        priors, has_prior = prior.lookup(np.array([pair]))
        assert has_prior[0]
        np.testing.assert_allclose(priors[0], np.mean(rows, axis=0), atol=1e-9)


def test_cups_on_the_table_are_a_prior_of_cups_and_tables() -> None:
    builder, _ = room({"table": THINGS[0], "cup": THINGS[2], "chair": THINGS[1]})
    followed = table_of(builder.graph)
    followed.refresh(Z)
    names = VOCABULARY.classes
    cup, dining_table = names.index("cup"), names.index("dining table")
    priors, has_prior = predicted_prior(followed).lookup(
        np.array([[cup, dining_table], [dining_table, cup]])
    )
    assert has_prior.tolist() == [True, False]
    assert VOCABULARY.predicates[int(priors[0].argmax())] == "on"
    # The model abstains on the chair beside the table: it says that they are not related.
    assert len(predicted_prior(followed)) == 1


# --- the floor -----------------------------------------------------------------------------------


@pytest.mark.parametrize("floor", [-1.36, 0.0, 0.5])
def test_the_floor_is_where_the_lowest_objects_stand(floor: float) -> None:
    bottoms = [floor] * 3 + [floor + 0.7] * 8
    assert floor_height(bottoms) == pytest.approx(floor, abs=FLOOR_STEP_M / 2 + 1e-6)
    # One node of many reaches below it.
    below = [floor - 1.5] + [floor] * 20 + [floor + 0.7] * 20
    assert floor_height(below) == pytest.approx(floor, abs=FLOOR_STEP_M / 2 + 1e-6)


@settings(max_examples=50, deadline=None)
@given(seed=seeds, count=st.integers(1, 60))
def test_the_floor_is_a_quantile_of_the_bottoms(seed: int, count: int) -> None:
    bottoms = np.sort(np.random.default_rng(seed).normal(0, 1, count))
    exact = np.quantile(bottoms, FLOOR_QUANTILE)
    assert floor_height(bottoms.tolist()) == pytest.approx(exact, abs=FLOOR_STEP_M / 2 + 1e-9)


def test_the_floor_without_objects_is_at_0() -> None:
    assert floor_height([]) == 0.0
    builder, _ = room({})
    points = np.random.default_rng(0).uniform(0.7, 0.8, (MIN_SHAPE_POINTS - 1, 3))
    builder.graph.add_node(np.zeros(3), np.eye(3), np.ones(80), 1, points.astype(np.float32))
    followed = table_of(builder.graph)
    followed.refresh(Z)
    assert followed.floor_m == 0.0


def test_pairs_have_different_keys() -> None:
    ids = [1, 2, 3, 1000, 2**31 - 1]
    keys = {key(first, second) for first, second in itertools.combinations(ids, 2)}
    assert len(keys) == 10 and max(keys) < 2**63


def test_the_defaults_use_geometry_and_confirmed_nodes() -> None:
    config = Config()
    assert config.relations.world_model == "physics"
