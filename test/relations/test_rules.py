"""What relations of different pairs exclude, against slow references and hand-made cases."""

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, logit, softmax
from support.reference_rules import REST, circle_of, near_probabilities
from support.reference_rules import one_support as reference_support

from deworldsg_ros.graph.pairs import PAIR, link
from deworldsg_ros.relations import rules
from deworldsg_ros.relations.states import (
    BELIEF,
    MIN_OTHER_VOTES,
    NEAR,
    NONE,
    RELATIONS_OF_STATE,
    SHAPE,
    STATE_COUNT,
)

seeds = st.integers(0, 10_000)
Room = tuple[np.ndarray, np.ndarray, np.ndarray]


def room(seed: int, count: int, scale: float = 3.0) -> Room:
    """State probabilities, pairs and floor odds of some of the pairs of n objects."""
    rng = np.random.default_rng(seed)
    pairs = [p for p in itertools.combinations(range(count), 2) if rng.random() < 0.8]
    states = softmax(rng.normal(0, scale, (len(pairs), STATE_COUNT)), axis=1)
    return states, np.array(pairs, np.int64).reshape(-1, 2), np.exp(rng.normal(0, 2, count))


def in_circles(seed: int, count: int) -> Room:
    """Every object is surely carried by the next one, in a circle, if they are a pair."""
    states, pairs, floor_odds = room(seed, count)
    order = np.random.default_rng(seed).permutation(count)
    sure = set(zip(order.tolist(), np.roll(order, 1).tolist()))
    for row, (first, second) in enumerate(pairs.tolist()):
        for end, edge in enumerate(((first, second), (second, first))):
            if edge in sure:
                states[row] = 0.01 / STATE_COUNT
                states[row, 1 + end] += 0.99
    return states, pairs, floor_odds * 1e-3


def scene_of(pairs: np.ndarray, count: int) -> rules.Scene:
    """Objects and their pairs, without a belief."""
    scene = rules.Scene(
        np.zeros(count, SHAPE),
        np.zeros(count, np.int32),
        np.zeros(len(pairs), PAIR),
        np.zeros(len(pairs), BELIEF),
    )
    scene.pairs["slots"], scene.beliefs["known"] = pairs, True
    link(scene.pairs, scene.firsts, np.zeros(count, np.int32), np.arange(len(pairs)))
    return scene


# --- one support an object -----------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    seed=seeds,
    count=st.integers(0, 9),
    scale=st.sampled_from([0.5, 3.0, 12.0]),
    circles=st.booleans(),
)
def test_the_kernel_equals_the_reference(
    seed: int, count: int, scale: float, circles: bool
) -> None:
    states, pairs, floor_odds = in_circles(seed, count) if circles else room(seed, count, scale)
    before = states.copy()
    found = rules.one_support(states, pairs, floor_odds)
    np.testing.assert_array_equal(states, before)
    for one, other in zip(found, reference_support(states, pairs, floor_odds)):
        np.testing.assert_allclose(one, other, atol=1e-6)
    after, kept, _ = found
    assert circle_of(kept, pairs) is None
    for values in found:
        assert (values >= -1e-12).all() and (values <= 1 + 1e-9).all()
    np.testing.assert_allclose(after.sum(axis=1), 1, atol=1e-6)
    # Within the supports of one direction, and within the rest, the shares stay.
    for group in (rules.CARRIED_FIRST, rules.CARRIED_SECOND, REST):
        shares = states[:, group] / states[:, group].sum(axis=1, keepdims=True)
        total = after[:, group].sum(axis=1, keepdims=True)
        np.testing.assert_allclose(after[:, group], shares * total, atol=1e-6)


# --- all rules, around what changed --------------------------------------------------------------


class Followed:
    """A scene of random pairs; `settle` follows what changed."""

    def __init__(self, rng: np.random.Generator, count: int) -> None:
        self.pairs = np.array(list(itertools.combinations(range(count), 2)), np.int64)
        self.pairs = self.pairs[rng.random(len(self.pairs)) < 0.6]
        self.scene = scene_of(self.pairs, count)
        self.scene.shapes["floor_odds"] = np.exp(rng.normal(0, 3, count))
        self.scene.shapes["seating"] = rng.random((count, 2)) < 0.3
        for low, high in (("low", "high"), ("slant_low", "slant_high")):
            ends = rng.uniform(0, 1, (2, *self.scene.shapes[low].shape))
            self.scene.shapes[low], self.scene.shapes[high] = np.sort(ends, axis=0)
        self.logits, self.votes = np.zeros((2, len(self.pairs), STATE_COUNT))
        self.near_logits, self.worth = np.zeros((len(self.pairs), 2)), np.zeros(len(self.pairs))
        self.circles: list[set[int]] = []

    def change(self, rng: np.random.Generator, rows: np.ndarray) -> None:
        """Other evidence on pairs."""
        beliefs, count = self.scene.beliefs, len(rows)
        gaps_m = np.where(rng.random(count) < 0.2, np.inf, rng.uniform(-0.1, 0.6, count))
        beliefs["judged"][rows] = rng.random(count) < 0.9
        beliefs["gap_m"][rows] = np.where(beliefs["judged"][rows], gaps_m, np.inf)
        beliefs["bottom_step_m"][rows] = rng.normal(0, 0.08, count)
        beliefs["centre_step_m"][rows] = rng.uniform(0, 1, count)
        beliefs["other_votes"][rows] = rng.choice([0.0, MIN_OTHER_VOTES], count)
        self.logits[rows] = np.log(rng.dirichlet(np.full(STATE_COUNT, 0.15), count) + 1e-9)
        self.votes[rows] = rng.choice([-1.0, 0.0, 1.0], (count, STATE_COUNT), p=[0.4, 0.58, 0.02])
        self.near_logits[rows] = rng.choice([-1.0, 0.0, 0.7], (count, 2))
        self.worth[rows] = rng.choice([1.0, 2.5], count)
        evidence = (self.logits, self.votes, self.near_logits, self.worth)
        rules.take_in(self.scene, rows, *(values[rows] for values in evidence))

    def settle(self, rows: np.ndarray) -> np.ndarray:
        """As `RobustBeliefs` does; returns the rows whose relations changed."""
        slots = np.unique(self.pairs[rows])
        for circle in self.circles:
            if circle & set(slots.tolist()):
                slots = np.union1d(slots, np.array(sorted(circle)))
        cut, changed = rules.settle(self.scene, slots)
        for place in cut.tolist():
            # More objects than those of the circle do no harm.
            self.circles.append(set(range(len(self.scene.shapes))))
            assert self.scene.beliefs["kept"][place >> 1, place & 1] <= 0.5
        assert not self.scene.shapes["mark"].any() and not self.scene.shapes["share"].any()
        assert len(set(changed.tolist())) == len(changed)
        return changed

    def reference(self) -> np.ndarray:
        """The relations of all pairs, by the rules for all pairs at once."""
        beliefs, shapes = self.scene.beliefs, self.scene.shapes
        states, kept, on_floor = reference_support(
            softmax(self.logits, axis=1), self.pairs, shapes["floor_odds"]
        )
        apart = beliefs["judged"] & np.isinf(beliefs["gap_m"])
        told = (self.votes > 0).any(axis=1) | (self.near_logits[:, 0] > 0)
        live = told | (beliefs["other_votes"] >= MIN_OTHER_VOTES) | ~apart
        tables, seats = (shapes["seating"][self.pairs, kind] > 0 for kind in range(2))
        with_ = (tables & seats[:, ::-1]).any(axis=1) & beliefs["judged"]
        with_ &= beliefs["gap_m"] <= rules.SEAT_GAP_M
        near, floor = near_probabilities(self.pairs, kept, shapes, on_floor, beliefs, with_)
        floor = np.where(with_, 0.0, floor)
        votes = (self.near_logits * np.column_stack([1.0 - floor, floor])).sum(axis=1)
        near = expit(logit(near) + self.worth * votes)
        relations = np.zeros((len(self.pairs), 2, NONE + 1))
        for end in (0, 1):
            for state in range(1, STATE_COUNT):
                relations[:, end, RELATIONS_OF_STATE[state, end]] += states[:, state]
            relations[:, end, NEAR] = states[:, 0] * near
            relations[:, end, NONE] += states[:, 0] * (1.0 - near)
        relations[~live] = np.arange(NONE + 1) == NONE
        return relations


@settings(max_examples=60, deadline=None)
@given(seed=seeds, count=st.integers(2, 9))
def test_relations_that_follow_are_those_of_all_pairs_at_once(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    followed = Followed(rng, count)
    every = np.arange(len(followed.pairs))
    relations = followed.scene.beliefs["relations"]
    for part in (1.0, *[0.2] * 8):
        rows = every[rng.random(len(every)) < part]
        before = relations.copy()
        followed.change(rng, rows)
        changed = followed.settle(rows)
        np.testing.assert_allclose(relations, followed.reference(), atol=1e-5)
        differs = np.flatnonzero((relations != before).any(axis=(1, 2)))
        taken_in = rows[~followed.scene.beliefs["live"][rows]]
        assert set(differs.tolist()) <= {*changed.tolist(), *taken_in.tolist()}


def outline(x: float, y: float, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    """Outline (5, 2) of a square of 1 m around a place."""
    corners = np.array([[x + a, y + b] for a in (-0.5, 0.5) for b in (-0.5, 0.5)])
    slant = corners @ np.array([[1, -1], [1, 1]]) * 0.5**0.5
    ends = [np.array([part.min(axis=0), part.max(axis=0)]).T for part in (corners, slant)]
    return np.concatenate([*ends, [[low, high]]])


def test_what_stands_between_two_things() -> None:
    here, there = outline(0, 0), outline(3, 0)
    for third, part in (
        (outline(1.5, 0), 1.0),
        (outline(1.5, 0.75), 0.25),
        (outline(1.5, 1.1), 0.0),  # beside the corridor
        (outline(-1.2, 0), 0.0),  # behind one of them
        (outline(1.5, 0, 0.0, 0.2), 0.0),  # lower than a quarter
        (outline(1.5, 0, 1.0, 2.0), 0.0),  # on a board above
    ):
        for ends in ((here, there), (there, here)):
            assert rules._covered(*ends, third) == part
    # Two that stand askew have their corridor along a diagonal.
    assert rules._covered(here, outline(2, 2), outline(1, 1)) == 1.0
