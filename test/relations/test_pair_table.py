"""The table of pairs, kept up to date, against a table made anew; the floor, and the prior."""

from collections.abc import Callable

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
    chair,
    plant,
    room,
    surface,
    table,
    thing,
)

from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.pairs import Pair
from deworldsg_ros.graph_builder import GraphBuilder
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
TABLE, CHAIR, CUP = THINGS[:3]
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
        rows, beliefs, shapes = self.graph.pairs.rows, self.table.beliefs, self.table.shapes
        known = np.flatnonzero(beliefs["known"])
        ids = list(map(tuple, rows["ids"][known].tolist()))
        assert sorted(self.told) == sorted(ids)
        for pair, row in zip(ids, known.tolist()):
            assert_close(self.told[pair], self.content(row), 0.0)
        assert (np.delete(beliefs, known) == np.zeros((), BELIEF)).all()
        nodes = self.graph.nodes
        published = np.flatnonzero(nodes.confirmed)
        assert (shapes["node_id"][published] == nodes.ids[published]).all()
        assert (np.delete(shapes, published) == np.zeros((), SHAPE)).all()
        idle = (rows["shown"] == 0) & (rows["frames"] == 0).all(axis=1)
        idle &= rows["ids"].any(axis=1) & (rows["neighbour_frames"] == 0).all(axis=1)
        assert set(np.flatnonzero(idle).tolist()) <= set(known.tolist())


def assert_close(one: Told, other: Told, error: float = 1e-3) -> None:
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_allclose(values, other[name], atol=error, err_msg=name)


def assert_equal(one: dict[Pair, Told], other: dict[Pair, Told]) -> None:
    assert one.keys() == other.keys()
    for pair, told in one.items():
        assert_close(told, other[pair])


def things_room(count: int = 4, seed: int = 0) -> tuple[GraphBuilder, list[int]]:
    builder, ids = room({str(index): item for index, item in enumerate(THINGS[:count])}, seed=seed)
    return builder, list(ids.values())


def small_room() -> tuple[Followed, GraphBuilder, list[int]]:
    """A cup on a table, with a chair beside it."""
    builder, ids = room({"cup": CUP, "table": TABLE, "chair": CHAIR})
    return Followed(builder.graph), builder, list(ids.values())


def moved(**metres: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = [metres.get(axis, 0.0) for axis in "xyz"]
    return T


# --- following a graph ---------------------------------------------------------------------------


def change(builder: GraphBuilder, rng: np.random.Generator) -> None:
    """Anything that may change a pair, at random."""
    graph = builder.graph
    ids = list(graph.nodes.slot_of)
    kind = rng.choice(
        ["votes", "observe", "confirm", "add", "merge", "remove", "move", "take over"],
        p=[0.34, 0.2, 0.1, 0.12, 0.06, 0.06, 0.06, 0.06],
    )
    item = THINGS[rng.integers(len(THINGS))]
    if kind == "add" or len(ids) < 4:
        node_id = add_node(builder, item, rng, frames=1)
        if rng.integers(2):  # too few points, or just enough
            slot, count = graph.nodes.slot(node_id), int(rng.integers(2 * MIN_SHAPE_POINTS))
            graph.nodes.set_surface(slot, graph.nodes.surface(slot)[:count].copy())
        set_confirmed(graph, node_id, bool(rng.integers(3)))
        return
    one, other = rng.choice(ids, 2, replace=False).tolist()
    if kind == "votes":
        graph.add_votes(one, other, rng.uniform(0, 0.02, (2, WIDTH)) if rng.integers(3) else None)
    elif kind == "observe":
        classes = rng.dirichlet(np.ones(len(VOCABULARY.classes)))
        points = surface(item.parts, rng, int(rng.integers(0, 60)))
        graph.observe(one, np.zeros(3), np.eye(3), classes, 5, points)
    elif kind == "confirm":
        set_confirmed(graph, one, bool(rng.integers(2)))
    elif kind == "merge":
        graph.merge_nodes(one, other)
    elif kind == "remove":
        graph.remove_node(one)
    elif kind == "move":
        x, y, z = rng.normal(0, 0.5, 3)
        graph.move_node(one, moved(x=x, y=y, z=z))
    else:
        graph.take_over(*sorted((one, other)))


@pytest.mark.parametrize("geometry", [True, False])
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_a_table_that_follows_equals_one_made_anew(geometry: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    builder, _ = things_room(seed=seed)
    followed, up = Followed(builder.graph, geometry), Z
    for step in range(25):
        change(builder, rng)
        if rng.random() < 0.3:  # what is left waits
            followed.refresh(up, 2, 1)
        if rng.integers(3) and step < 24:
            continue  # several changes at once
        if rng.random() < 0.1:
            up = rng.normal(0, 0.1, 3) + Z
        followed.refresh(up)
        followed.check()
        fresh = Followed(GlobalGraph.from_state(builder.graph.state()), geometry)
        assert_equal(followed.told, fresh.refresh(up))
        assert followed.table.floor_m == fresh.table.floor_m
        assert followed.table.pairs_waiting == followed.table.nodes_waiting == 0


def test_only_what_changed_is_measured_again(monkeypatch: pytest.MonkeyPatch) -> None:
    builder, ids = things_room()
    followed, slots = Followed(builder.graph), builder.graph.nodes.slots_of(ids).tolist()
    measured: list[int] = []
    original: Callable[..., None] = pairs.measure

    def measure(shapes: np.ndarray, which: np.ndarray, *args: np.ndarray) -> None:
        measured.extend(which.tolist())
        original(shapes, which, *args)

    monkeypatch.setattr(pairs, "measure", measure)
    for change_, up, expected in (
        (None, [0.0, -0.9, -0.44], slots),
        (None, [0.0, -0.9, -0.44], []),
        (ids[2], [0.0, -0.9, -0.44], slots[2:3]),
        (None, [0.001, -0.9, -0.439], []),  # a small turn
        (None, [0.0, -0.9, -0.41], slots),
    ):
        if change_ is not None:
            builder.graph.observe(change_, np.zeros(3), np.eye(3), np.ones(80), 9)
        followed.refresh(np.array(up))
        assert sorted(measured) == expected
        measured.clear()


def test_the_steps_of_the_up_direction() -> None:
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        np.testing.assert_array_equal(stepped_up(3.0 * axis), axis)
    ups = np.random.default_rng(0).normal(size=(1000, 3))
    for up in ups / np.linalg.norm(ups, axis=1, keepdims=True):
        stepped = stepped_up(up)
        assert np.degrees(np.arccos(stepped @ up / np.linalg.norm(stepped))) < 0.5


def test_votes_on_hidden_nodes_hold_up_no_other_pair() -> None:
    followed, builder, (cup, _, chair_) = small_room()
    for seed in range(4):
        hidden = add_node(builder, THINGS[5], np.random.default_rng(seed), frames=1)
        set_confirmed(builder.graph, hidden, False)
        builder.graph.add_votes(hidden, chair_, None)
    followed.refresh()
    builder.graph.add_votes(cup, chair_, None)
    followed.refresh(Z, 1)
    assert followed.table.pairs_waiting == 0


def test_pairs_out_of_reach_are_not_related() -> None:
    far = thing("refrigerator", 5.0, 0, 0, 0.6, 0.6, 1.7)
    builder, ids = room({"table": TABLE, "far": far, "cup": CUP})
    followed, apart = Followed(builder.graph), (ids["far"], ids["cup"])
    assert set(followed.refresh()) == {(ids["table"], ids["cup"])}
    # It is known of those that were seen together, and judged to be apart.
    builder.graph.add_votes(ids["far"], ids["cup"], np.ones((2, WIDTH)))
    told = followed.refresh()[apart]
    assert told["judged"] and np.isinf(told["gap_m"])
    assert softmax(told["state_logits"])[0] > 0.999
    builder.graph.move_node(ids["cup"], moved(x=4.6))
    told = followed.refresh()
    assert set(told) == {apart} and np.isfinite(told[apart]["gap_m"])


def test_a_large_graph_turns_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairs, "NEW_A_CALL", 4)
    followed = Followed(things_room(len(THINGS))[0].graph)
    followed.refresh()
    tilted, calls, seen = np.array([0.6, 0.0, 0.8]), 0, followed.table
    while not calls or seen.nodes_waiting:
        followed.refresh(tilted, 10, 4)
        assert seen.begun == (not seen.nodes_waiting)
        calls += 1
    assert calls == len(THINGS) / 4 and seen.begun
    # A turn that comes before the other one is done waits for it.
    followed.refresh(np.array([0.0, 0.6, 0.8]), 10, 4)
    for _ in range(len(THINGS) // 4 - 1):
        assert not seen.begun
        followed.refresh(tilted, 10, 4)
    assert seen.begun
    assert_equal(followed.refresh(tilted), Followed(followed.graph).refresh(tilted))


# --- the prior of class pairs --------------------------------------------------------------------


def predicted_prior(followed: Followed) -> PredictedPrior:
    """The prior of all pairs of a table."""
    prior = PredictedPrior(VOCABULARY)
    prior.follow(followed.table, np.flatnonzero(followed.table.beliefs["known"]).tolist())
    return prior


def test_the_prior_is_the_mean_of_the_predictions_that_say_something() -> None:
    things = {str(index): item for index, item in enumerate(THINGS)}
    builder, _ = room({**things, "second cup": thing("cup", -0.1, 0.2, 0.74, 0.08, 0.08, 0.1)})
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
    prior = predicted_prior(followed)
    assert len(prior) == len(expected) >= 3
    for pair, rows in expected.items():
        priors, has_prior = prior.lookup(np.array([pair]))
        assert has_prior[0]
        np.testing.assert_allclose(priors[0], np.mean(rows, axis=0), atol=1e-6)


def test_a_prior_that_follows_is_that_of_all_pairs() -> None:
    rng, (builder, _) = np.random.default_rng(0), things_room(len(THINGS))
    followed, prior, most = Followed(builder.graph), PredictedPrior(VOCABULARY), 0
    for _ in range(30):
        change(builder, rng)
        followed.table.refresh(Z)
        prior.follow(followed.table, followed.table.changed_rows)
        followed.refresh()
        fresh = predicted_prior(followed)
        assert prior._sums.keys() == fresh._sums.keys()
        pair_classes = np.array(sorted(fresh._sums), np.int64).reshape(-1, 2)
        for one, other in zip(prior.lookup(pair_classes), fresh.lookup(pair_classes)):
            np.testing.assert_array_equal(one, other)
        most = max(most, len(prior))
    assert most >= 3


# --- the floor -----------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(seed=seeds, count=st.integers(1, 60))
def test_the_floor_is_a_quantile_of_the_bottoms(seed: int, count: int) -> None:
    bottoms = np.sort(np.random.default_rng(seed).normal(0, 1, count))
    exact = np.quantile(bottoms, FLOOR_QUANTILE)
    assert floor_height(bottoms.tolist()) == pytest.approx(exact, abs=FLOOR_STEP_M / 2 + 1e-9)


def test_the_floor_without_objects_is_at_0() -> None:
    assert floor_height([]) == 0.0
    builder, _ = room({})
    followed = Followed(builder.graph)
    assert followed.refresh() == {} and len(predicted_prior(followed)) == 0
    points = np.random.default_rng(0).uniform(0.7, 0.8, (MIN_SHAPE_POINTS - 1, 3))
    builder.graph.add_node(np.zeros(3), np.eye(3), np.ones(80), 1, points.astype(np.float32))
    followed.refresh()
    assert followed.table.floor_m == 0.0
