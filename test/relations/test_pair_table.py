"""The table of pairs, kept up to date, against a table made anew; the floor, and the prior."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import softmax
from support.merging import move_node, set_confirmed
from support.room_nodes import DESK, DINNER, VOCABULARY, change, room, thing

from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.relations import pairs
from deworldsg_ros.relations.beliefs import MIN_RELATED, PredictedPrior
from deworldsg_ros.relations.geometry import MIN_SHAPE_POINTS
from deworldsg_ros.relations.pairs import (
    FLOOR_QUANTILE,
    FLOOR_STEP_M,
    PairTable,
    floor_height,
    stepped_up,
)
from deworldsg_ros.relations.physics import load_physics_model
from deworldsg_ros.relations.states import (
    BELIEF,
    NONE,
    RELATIONS_OF_STATE,
    SHAPE,
    canonical_predicates,
)

seeds = st.integers(0, 10_000)
Z = np.array([0.0, 0.0, 1.0])
WIDTH = len(VOCABULARY.predicates)
Told = dict[str, np.ndarray]


class Followed:
    """A table of a graph, and a reader that knows what the table tells of changes alone."""

    def __init__(self, graph: GlobalGraph, geometry: bool = True) -> None:
        self.graph = graph
        self.table = PairTable(graph, load_physics_model(), geometry=geometry)
        self.told: dict[Pair, Told] = {}

    def refresh(self, up: np.ndarray = Z, *limits: int) -> dict[Pair, Told]:
        self.table.refresh(up, *limits)
        for ids in self.table.gone:
            self.told.pop(ids, None)
        for row in self.table.changed_rows:
            ids = tuple(self.graph.pairs.rows["ids"][row].tolist())
            self.told.pop(ids, None)
            if self.table.beliefs["known"][row]:
                self.told[ids] = self.content(row)
        self.table.gone.clear()
        self.table.changed_rows.clear()
        return self.told

    def content(self, row: int) -> Told:
        """What the table says of a pair."""
        belief, names = self.table.beliefs[row], ["judged", "gap_m"]
        names += ["state_logits"] if belief["judged"] else []
        if np.isfinite(belief["gap_m"]):
            names += ["bottom_step_m", "centre_step_m"]
        return {name: belief[name].copy() for name in names}

    def check(self) -> None:
        """The reader knows all, and nothing is left of what is not followed."""
        beliefs, shapes = self.table.beliefs, self.table.shapes
        known = np.flatnonzero(beliefs["known"])
        ids = list(map(tuple, self.graph.pairs.rows["ids"][known].tolist()))
        assert sorted(self.told) == sorted(ids)
        for pair, row in zip(ids, known.tolist()):
            assert_close(self.told[pair], self.content(row), 0.0)
        assert (np.delete(beliefs, known) == np.zeros((), BELIEF)).all()
        published = np.flatnonzero(self.graph.nodes.confirmed)
        assert (np.delete(shapes, published) == np.zeros((), SHAPE)).all()


def assert_close(one: Told, other: Told, error: float = 1e-3) -> None:
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_allclose(values, other[name], atol=error, err_msg=name)


def assert_equal(one: dict[Pair, Told], other: dict[Pair, Told]) -> None:
    assert one.keys() == other.keys()
    for pair, told in one.items():
        assert_close(told, other[pair])


# --- following a graph ---------------------------------------------------------------------------


@pytest.mark.parametrize("geometry", [True, False])
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_a_table_that_follows_equals_one_made_anew(geometry: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    builder, _ = room(DINNER, seed=seed)
    followed, up = Followed(builder.graph, geometry), Z
    for step in range(30):
        change(builder, rng)
        if rng.random() < 0.3:  # what is left waits
            followed.refresh(up, 2, 1)
        if rng.integers(3) and step < 29:
            continue  # several changes at once
        if rng.random() < 0.1:
            up = rng.normal(0, 0.1, 3) + Z
        followed.refresh(up)
        followed.check()
        fresh = Followed(GlobalGraph.from_state(builder.graph.state()), geometry)
        assert_equal(followed.told, fresh.refresh(up))
        assert followed.table.floor_m == fresh.table.floor_m
        assert followed.table.pairs_waiting == followed.table.nodes_waiting == 0


def test_the_steps_of_the_up_direction() -> None:
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        np.testing.assert_array_equal(stepped_up(3.0 * axis), axis)
    ups = np.random.default_rng(0).normal(size=(1000, 3))
    for up in ups / np.linalg.norm(ups, axis=1, keepdims=True):
        stepped = stepped_up(up)
        assert np.degrees(np.arccos(stepped @ up / np.linalg.norm(stepped))) < 0.5


def test_votes_on_hidden_nodes_hold_up_no_other_pair() -> None:
    builder, ids = room(DINNER)
    followed, graph = Followed(builder.graph), builder.graph
    set_confirmed(graph, ids["book"], False)
    graph.add_votes(ids["book"], ids["chair"], None)
    followed.refresh()
    graph.add_votes(ids["cup"], ids["chair"], None)
    followed.refresh(Z, 1)
    assert followed.table.pairs_waiting == 0


def test_pairs_out_of_reach_are_not_related() -> None:
    far = thing("refrigerator", 5.0, 0, 0, 0.6, 0.6, 1.7)
    builder, ids = room({**DESK, "far": far})
    followed, apart = Followed(builder.graph), (ids["cup"], ids["far"])
    nodes, slot = builder.graph.nodes, builder.graph.nodes.slot(ids["far"])
    points = nodes.surface(slot).copy()
    nodes.set_surface(slot, points[:3].copy())
    assert set(followed.refresh()) == {(ids["table"], ids["cup"])}
    # It is known of those that were seen together, and judged to be apart when it has points.
    builder.graph.add_votes(*apart, np.ones((2, WIDTH)))
    assert not followed.refresh()[apart]["judged"]
    builder.graph.observe(ids["far"], np.zeros(3), np.eye(3), np.ones(80), 9, points)
    told = followed.refresh()[apart]
    assert told["judged"] and np.isinf(told["gap_m"])
    assert softmax(told["state_logits"])[0] > 0.999
    T = np.eye(4)
    T[0, 3] = 4.4
    move_node(builder.graph, ids["cup"], T)
    told = followed.refresh()
    assert set(told) == {apart} and np.isfinite(told[apart]["gap_m"])


def test_a_large_graph_turns_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairs, "NEW_A_CALL", 2)
    followed = Followed(room(DINNER)[0].graph)
    followed.refresh()
    tilted, calls, seen = np.array([0.6, 0.0, 0.8]), 0, followed.table
    while not calls or seen.nodes_waiting:
        followed.refresh(tilted, 10, 2)
        assert seen.begun == (not seen.nodes_waiting)
        calls += 1
    assert calls == 4 and seen.begun  # for 7 nodes
    # A turn that comes before the other one is done waits for it.
    followed.refresh(np.array([0.0, 0.6, 0.8]), 10, 2)
    for _ in range(3):
        assert not seen.begun
        followed.refresh(tilted, 10, 2)
    assert seen.begun
    assert_equal(followed.refresh(tilted), Followed(followed.graph).refresh(tilted))


# --- the prior of class pairs --------------------------------------------------------------------


def test_the_prior_is_the_mean_of_the_predictions_that_say_something() -> None:
    builder, _ = room({**DINNER, "second cup": thing("cup", -0.1, 0.2, 0.74, 0.08, 0.08, 0.1)})
    followed, nodes = Followed(builder.graph), builder.graph.nodes
    canonical = canonical_predicates(VOCABULARY.predicates)
    expected: dict[Pair, list[np.ndarray]] = {}
    for ids, item in followed.refresh().items():
        states = softmax(item["state_logits"].astype(float))
        first, second = nodes.class_probabilities[nodes.slots_of(ids)].argmax(axis=1).tolist()
        for end, pair in enumerate([(first, second), (second, first)]):
            told = np.zeros(WIDTH)
            for probability, relation in zip(states, RELATIONS_OF_STATE[:, end]):
                if relation != NONE:
                    told[canonical[relation]] += probability
            if told.sum() > MIN_RELATED:
                expected.setdefault(pair, []).append(told / told.sum())
    prior = PredictedPrior(VOCABULARY)
    prior.follow(followed.table, np.flatnonzero(followed.table.beliefs["known"]).tolist())
    assert len(prior) == len(expected) >= 3
    for pair, rows in expected.items():
        priors, has_prior = prior.lookup(np.array([pair]))
        assert has_prior[0]
        np.testing.assert_allclose(priors[0], np.mean(rows, axis=0), atol=1e-6)


# --- the floor -----------------------------------------------------------------------------------


@given(seed=seeds, count=st.integers(1, 60))
def test_the_floor_is_a_quantile_of_the_bottoms(seed: int, count: int) -> None:
    bottoms = np.sort(np.random.default_rng(seed).normal(0, 1, count))
    exact = np.quantile(bottoms, FLOOR_QUANTILE)
    assert floor_height(bottoms.tolist()) == pytest.approx(exact, abs=FLOOR_STEP_M / 2 + 1e-9)


def test_the_floor_without_objects_is_at_0() -> None:
    followed = Followed(room({})[0].graph)
    assert followed.refresh() == {}
    points = np.random.default_rng(0).uniform(0.7, 0.8, (MIN_SHAPE_POINTS - 1, 3))
    followed.graph.add_node(np.zeros(3), np.eye(3), np.ones(80), 1, points.astype(np.float32))
    followed.refresh()
    assert followed.table.floor_m == 0.0
