"""What relations of different pairs exclude, against enumeration and hand-made cases."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import softmax
from support.reference_near import near_probabilities

from deworldsg_ros.relations.rules import (
    CARRIED_FIRST,
    CARRIED_SECOND,
    NEAR_CERTAINTY,
    NEAR_FLOOR_M,
    NEAR_LEVEL_M,
    NEAR_SUPPORT_M,
    SEAT_GAP_M,
    one_support,
)
from deworldsg_ros.relations.states import RELATIONS_OF_STATE, STATE_COUNT, SUPPORTS

seeds = st.integers(0, 10_000)
REST = ~(CARRIED_FIRST | CARRIED_SECOND)


def room(seed: int, count: int, scale: float = 3.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State probabilities, pairs and floor odds of some of the pairs of n objects."""
    rng = np.random.default_rng(seed)
    pairs = [p for p in itertools.combinations(range(count), 2) if rng.random() < 0.8]
    states = softmax(rng.normal(0, scale, (len(pairs), STATE_COUNT)), axis=1)
    return states, np.array(pairs, np.int64).reshape(-1, 2), np.exp(rng.normal(0, 2, count))


def supports_of(states: np.ndarray, pairs: np.ndarray, item: int) -> dict[int, float]:
    """Probability of each support of an object."""
    found = {}
    for (first, second), row in zip(pairs.tolist(), states):
        if item in (first, second):
            carried = CARRIED_FIRST if item == first else CARRIED_SECOND
            found[second if item == first else first] = float(row[carried].sum())
    return found


def one_at_most(probabilities: list[float]) -> list[float]:
    """Independent events, given that one at most holds: the probability of each."""
    weights = {}
    for outcome in itertools.product((False, True), repeat=len(probabilities)):
        if sum(outcome) <= 1:
            factors = [p if holds else 1 - p for p, holds in zip(probabilities, outcome)]
            weights[outcome] = np.prod(factors)
    whole = sum(weights.values())
    return [
        sum(weight for outcome, weight in weights.items() if outcome[row]) / whole
        for row in range(len(probabilities))
    ]


def circles(kept: np.ndarray, pairs: np.ndarray, count: int) -> bool:
    """Whether following the likely supports from some object leads back to it."""
    parent = {}
    for (first, second), row in zip(pairs.tolist(), kept.tolist()):
        if row[0] > 0.5:
            parent[first] = second
        if row[1] > 0.5:
            parent[second] = first
    for start in parent:
        item = parent[start]
        for _ in range(count):
            if item == start:
                return True
            item = parent.get(item, -1)
    return False


def test_the_states_in_which_an_object_is_carried() -> None:
    for state, (there, back) in enumerate(RELATIONS_OF_STATE.tolist()):
        assert CARRIED_FIRST[state] == (there in SUPPORTS)
        assert CARRIED_SECOND[state] == (back in SUPPORTS)


@pytest.mark.parametrize("count", [0, 3])
def test_no_pairs(count: int) -> None:
    floor_odds = np.arange(1.0, count + 1)
    states, kept, on_floor = one_support(
        np.zeros((0, STATE_COUNT)), np.zeros((0, 2), np.int64), floor_odds
    )
    assert states.shape == (0, STATE_COUNT) and kept.shape == (0, 2)
    np.testing.assert_allclose(on_floor, floor_odds / (1 + floor_odds))


@settings(max_examples=30, deadline=None)
@given(seed=seeds, count=st.integers(2, 5))
def test_the_supports_of_an_object_are_events_of_which_one_at_most_holds(
    seed: int, count: int
) -> None:
    """With weak supports, no circle and no pair is cut, so that the enumeration is exact."""
    states, pairs, floor_odds = room(seed, count, scale=1.0)
    states[:, ~REST] *= 0.5
    states /= states.sum(axis=1, keepdims=True)
    after, kept, on_floor = one_support(states, pairs, floor_odds)
    for item in range(count):
        before = supports_of(states, pairs, item)
        floor = floor_odds[item] / (1 + floor_odds[item])
        expected = one_at_most([*before.values(), floor])
        assert on_floor[item] == pytest.approx(expected[-1])
        found = supports_of(after, pairs, item)
        for support, probability in zip(before, expected):
            assert found[support] == pytest.approx(probability)
            row = np.flatnonzero((np.sort(pairs, axis=1) == sorted((item, support))).all(axis=1))
            assert kept[row[0], int(pairs[row[0], 1] == item)] == pytest.approx(probability)


@settings(max_examples=30, deadline=None)
@given(seed=seeds, count=st.integers(2, 9), scale=st.sampled_from([0.5, 3.0, 12.0]))
def test_probabilities_stay_probabilities(seed: int, count: int, scale: float) -> None:
    states, pairs, floor_odds = room(seed, count, scale)
    before = states.copy()
    after, kept, on_floor = one_support(states, pairs, floor_odds)
    np.testing.assert_array_equal(states, before)
    for values in (after, kept, on_floor):
        assert (values >= -1e-12).all() and (values <= 1 + 1e-9).all()
    np.testing.assert_allclose(after.sum(axis=1), 1, atol=1e-9)
    # Certain supports are taken as slightly less than certain: odds are finite.
    np.testing.assert_allclose(after[:, CARRIED_FIRST].sum(axis=1), kept[:, 0], atol=2e-6)
    np.testing.assert_allclose(after[:, CARRIED_SECOND].sum(axis=1), kept[:, 1], atol=2e-6)
    for item in range(count):
        assert sum(supports_of(after, pairs, item).values()) + on_floor[item] <= 1 + 2e-6
    # Within the supports of one direction, and within the rest, the shares stay.
    for group in (CARRIED_FIRST, CARRIED_SECOND, REST):
        shares = states[:, group] / states[:, group].sum(axis=1, keepdims=True)
        total = after[:, group].sum(axis=1, keepdims=True)
        np.testing.assert_allclose(after[:, group], shares * total, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=seeds, count=st.integers(3, 9))
def test_the_likely_supports_are_a_forest(seed: int, count: int) -> None:
    """Also if every object is surely carried by the next one, in circles."""
    rng = np.random.default_rng(seed)
    states, pairs, floor_odds = room(seed, count)
    order = rng.permutation(count)
    sure = set(zip(order.tolist(), np.roll(order, 1).tolist()))
    for row, (first, second) in enumerate(pairs.tolist()):
        for end, edge in enumerate(((first, second), (second, first))):
            if edge in sure:
                states[row] = 0.01 / STATE_COUNT
                states[row, 1 + end] += 0.99
    after, kept, _ = one_support(states, pairs, floor_odds * 1e-3)
    assert not circles(kept, pairs, count)
    np.testing.assert_allclose(after.sum(axis=1), 1, atol=1e-9)


def test_of_a_circle_the_weakest_support_goes() -> None:
    states = np.full((3, STATE_COUNT), 1e-4)
    pairs = np.array([[0, 1], [1, 2], [0, 2]])
    states[0, 1] = 0.95  # 0 on 1
    states[1, 1] = 0.99  # 1 on 2
    states[2, 2] = 0.9  # 2 on 0
    states[:, 0] = 1 - states[:, 1:].sum(axis=1)
    after, kept, _ = one_support(states, pairs, np.zeros(3))
    assert kept[0, 0] > 0.9 and kept[1, 0] > 0.9
    assert 0.3 < kept[2, 1] < 0.5 and after[2, 0] > 0.5


def test_an_object_between_two_good_supports_has_half_of_each() -> None:
    states = np.zeros((2, STATE_COUNT))
    states[:, 1], states[:, 0] = 0.98, 0.02
    _, kept, on_floor = one_support(states, np.array([[0, 1], [0, 2]]), np.array([0.0, 1e9, 1e9]))
    np.testing.assert_allclose(kept[:, 0], 49 / 99)
    np.testing.assert_allclose(on_floor, [0, 1, 1], atol=1e-6)


def test_what_stands_on_the_floor_is_on_nothing_else() -> None:
    states = np.zeros((1, STATE_COUNT))
    states[:, 1], states[:, 0] = 0.8, 0.2
    _, kept, on_floor = one_support(states, np.array([[0, 1]]), np.array([400.0, 1.0]))
    assert kept[0, 0] < 0.01 and on_floor[0] > 0.98


# --- near ----------------------------------------------------------------------------------------


def near(
    gaps: dict[tuple[int, int], float],
    count: int,
    *,
    floor: float = 1.0,
    carried: dict[tuple[int, int], float] | None = None,
    steps: float = 0.0,
    centres: dict[tuple[int, int], float] | None = None,
    unrelated: float = 1.0,
    seats: tuple[tuple[int, int], ...] = (),
) -> dict[tuple[int, int], float]:
    """Near by pair; `carried` are probabilities that the first object rests on the second one."""
    carried = {} if carried is None else carried
    pairs = sorted({*gaps, *((min(pair), max(pair)) for pair in carried)})
    probabilities = near_probabilities(
        np.array(pairs, np.int64).reshape(-1, 2),
        np.array([[carried.get(p, 0.0), carried.get(p[::-1], 0.0)] for p in pairs]).reshape(-1, 2),
        np.full(count, floor),
        np.array([gaps.get(p, np.inf) for p in pairs]),
        np.full(len(pairs), steps),
        np.array([(centres or {}).get(p, 0.0) for p in pairs]),
        np.array([0.0 if p in carried or p[::-1] in carried else unrelated for p in pairs]),
        np.array([p in seats for p in pairs], np.bool_),
    )
    return dict(zip(pairs, probabilities.tolist()))


ON_ONE_TABLE = {(0, 2): 1.0, (1, 2): 1.0}


def test_near_of_no_pairs() -> None:
    assert near({}, 0) == near({}, 3) == {}


@pytest.mark.parametrize(
    ("gap_m", "expected"), [(0.0, 1.0), (NEAR_FLOOR_M, 0.5), (0.8, 0.0), (np.inf, 0.0)]
)
def test_near_on_the_floor(gap_m: float, expected: float) -> None:
    assert near({(0, 1): gap_m}, 2)[0, 1] == pytest.approx(NEAR_CERTAINTY * expected, abs=0.01)


def test_near_needs_one_floor_or_one_support() -> None:
    assert near({(0, 1): 0.05}, 2, floor=0.0)[0, 1] == 0
    elsewhere = {(0, 2): 1.0, (1, 3): 1.0}
    assert near({(0, 1): 0.05}, 4, floor=0.0, carried=elsewhere)[0, 1] == 0
    together = near({(0, 1): 0.05}, 3, floor=0.0, carried=ON_ONE_TABLE)
    assert together[0, 1] > 0.9 and together[0, 2] == together[1, 2] == 0
    half = near({(0, 1): 0.0}, 3, floor=0.0, carried={(0, 2): 0.8, (1, 2): 0.7})
    assert half[0, 1] == pytest.approx(0.56 * NEAR_CERTAINTY, abs=0.02)


@pytest.mark.parametrize(
    ("gap_m", "expected"), [(0.0, 1.0), (NEAR_SUPPORT_M, 0.5), (0.2, 0.0), (0.45, 0.0)]
)
def test_near_on_one_support_is_nearer_than_on_the_floor(gap_m: float, expected: float) -> None:
    found = near({(0, 1): gap_m}, 3, floor=0.0, carried=ON_ONE_TABLE)
    assert found[0, 1] == pytest.approx(NEAR_CERTAINTY * expected, abs=0.03)


@pytest.mark.parametrize(
    ("step_m", "expected"),
    [(0.0, 1.0), (-NEAR_LEVEL_M, 0.5), (NEAR_LEVEL_M, 0.5), (3 * NEAR_LEVEL_M, 0.0)],
)
def test_near_on_one_support_is_on_one_level(step_m: float, expected: float) -> None:
    """Books on two shelves of one bookcase are not near."""
    found = near({(0, 1): 0.0}, 3, floor=0.0, carried=ON_ONE_TABLE, steps=step_m)
    assert found[0, 1] == pytest.approx(NEAR_CERTAINTY * expected, abs=0.03)


def test_near_are_the_two_nearest_neighbours() -> None:
    """Object 0 amid three others; each of them has only 0."""
    found = near({(0, 1): 0.1, (0, 2): 0.2, (0, 3): 0.3}, 4)
    assert found[0, 1] > 0.9 and found[0, 2] > 0.9 and found[0, 3] == 0
    # It counts from both ends: 3 would be the nearest one of 0, and has two nearer ones.
    crowd = near({(0, 3): 0.2, (1, 3): 0.1, (2, 3): 0.15}, 4)
    assert crowd[0, 3] == 0 and crowd[1, 3] > 0.9 and crowd[2, 3] > 0.9


def test_of_objects_that_touch_those_with_the_nearest_centres_are_near() -> None:
    """A row of five books: the bounds of each one overlap with those of all others."""
    row = {(a, b): 0.0 for a in range(5) for b in range(a)}
    gaps = {pair[::-1]: gap for pair, gap in row.items()}
    on_shelf = {(book, 5): 1.0 for book in range(5)}
    centres = {(a, b): 0.03 * (b - a) for a, b in gaps}
    found = near(gaps, 6, floor=0.0, carried=on_shelf, centres=centres)
    assert {pair for pair, p in found.items() if p > 0.5} >= {(0, 1), (1, 2), (2, 3), (3, 4)}
    assert not {pair for pair, p in found.items() if p > 0.5} & {(0, 3), (0, 4), (1, 4)}


def test_pairs_that_are_not_near_or_otherwise_related_are_no_neighbours() -> None:
    """Two objects on the table are nearer than the third one, but on it, not beside it."""
    carried = {(1, 0): 1.0, (2, 0): 1.0}
    gaps = {(0, 1): 0.0, (0, 2): 0.0, (0, 3): 0.3}
    assert near(gaps, 4, carried=carried)[0, 3] > 0.9


@pytest.mark.parametrize("others", [0, 3])
def test_a_pair_in_a_more_specific_relation_is_not_near(others: int) -> None:
    """However many other pairs there are."""
    gaps = {(0, 1): 0.1} | {(2, 3 + other): 0.1 for other in range(others)}
    assert near(gaps, 6, unrelated=0.2)[0, 1] == 0


def test_a_seat_is_with_its_table_whatever_else_is_near() -> None:
    gaps = {(0, 1): 0.05, (0, 2): 0.05, (0, 3): 0.2, (0, 4): 0.2}
    found = near(gaps, 5, seats=((0, 3), (0, 4)))
    assert min(found.values()) > 0.9
    far = near({(0, 1): SEAT_GAP_M + 0.2}, 2, seats=((0, 1),))
    assert far[0, 1] < 0.05 < near({(0, 1): SEAT_GAP_M}, 2, seats=((0, 1),))[0, 1]


@settings(max_examples=30, deadline=None)
@given(seed=seeds, count=st.integers(2, 8))
def test_near_is_a_symmetric_probability(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    states, pairs, floor_odds = room(seed, count)
    states, kept, on_floor = one_support(states, pairs, floor_odds)
    lengths = (rng.uniform(0, 0.3, len(pairs)), rng.normal(0, 0.03, len(pairs)))
    args = (*lengths, rng.uniform(0, 1, len(pairs)), states[:, 0])
    seats = rng.random(len(pairs)) < 0.2
    one = near_probabilities(pairs, kept, on_floor, *args, seats)
    other = near_probabilities(pairs[:, ::-1], kept[:, ::-1], on_floor, *args, seats)
    np.testing.assert_allclose(one, other)
    assert (one >= 0).all() and (one <= NEAR_CERTAINTY).all()
    order = rng.permutation(len(pairs))
    moved = near_probabilities(
        pairs[order], kept[order], on_floor, *(values[order] for values in args), seats[order]
    )
    np.testing.assert_allclose(moved, one[order])
