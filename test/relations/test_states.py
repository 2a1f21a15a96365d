"""The physical states of a pair, the predicates that name them, and what of these is said."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deworldsg_ros.relations import states
from deworldsg_ros.relations.paper import entropy_nats
from deworldsg_ros.scene.vocabulary import (
    PREDICATE_SETS,
    REPLICA_SSG_PREDICATES,
    SCANNET_PREDICATES,
)

seeds = st.integers(0, 10_000)


# --- states and their names ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("predicates", "named"),
    [
        (
            REPLICA_SSG_PREDICATES,
            {
                "on": "on, standing on, sitting on, lying on, laying on, parked on, on back of",
                "in": "in",
                "attached to": "attached to, hanging from, mounted on",
                "against": "against",
                "above": "above, over",
                "under": "under",
                "near": "near, with",
            },
        ),
        (
            SCANNET_PREDICATES,
            {
                "on": "standing on, supported by",
                "attached to": "attached to, build in, hanging on",
                "against": "connected to",
            },
        ),
        # Spelling does not matter.
        (("Standing_On", "NEAR", "over", "", "riding"), dict(on="Standing_On", near="NEAR",
                                                             above="over")),
        (("Close_By", "next to"), {"near": "next to, Close_By"}),
        ((), {}),
    ],
)  # fmt: skip
def test_predicates_by_relation(predicates: tuple[str, ...], named: dict[str, str]) -> None:
    of, canonical = (
        states.relation_of_predicates(predicates),
        states.canonical_predicates(predicates),
    )
    for relation, name in enumerate(states.RELATIONS[: states.NONE]):
        wanted = named[name].split(", ") if name in named else []
        found = [predicate for predicate, index in zip(predicates, of) if index == relation]
        assert set(found) == set(wanted)
        chosen = canonical[relation]
        assert (predicates[chosen] == wanted[0]) if wanted else (chosen == -1)


def test_no_name_has_two_relations() -> None:
    names = [name for group in states.PREDICATES for name in group]
    assert len(names) == len(set(names))
    for predicates in PREDICATE_SETS.values():
        canonical = states.canonical_predicates(predicates)
        of = states.relation_of_predicates(predicates)
        assert all(of[index] == row for row, index in enumerate(canonical) if index >= 0)


# --- the probabilities of predicates -------------------------------------------------------------

NAMES = ("on", "standing on", "in", "near", "with", "above", "under", "wearing", "using")
SCALES = np.array([1.2, 3.0, 0.05, 0.2])


def random_beliefs(rng: np.random.Generator, count: int) -> np.ndarray:
    beliefs = np.zeros(count, states.BELIEF)
    relations = rng.dirichlet(np.full(states.NONE + 1, 0.2), (count, 2))
    relations[rng.random(count) < 0.3] = np.arange(states.NONE + 1) == states.NONE
    beliefs["relations"] = relations
    beliefs["with_"] = rng.random((count, 2)) < 0.3
    beliefs["votes_worth"] = rng.choice([1.0, 2.5], count)
    beliefs["other_votes"] = rng.choice([0.0, states.MIN_OTHER_VOTES, 3.0], count)
    return beliefs


def predicates_of(belief: np.void, end: int, votes: np.ndarray, frames: int) -> dict[str, float]:
    """The probabilities by name, a rule a line."""
    relations, with_ = belief["relations"][end].astype(float), belief["with_"][end]
    told = dict(zip(NAMES, votes.tolist()))
    of = dict(zip(NAMES, states.relation_of_predicates(NAMES).tolist()))
    found = dict.fromkeys(NAMES, 0.0)
    for relation in range(states.NONE):
        names = [name for name in NAMES if of[name] == relation]
        if names:
            default = next(name for name in states.PREDICATES[relation] if name in names)
            shares = {name: told[name] for name in names}
            shares["with" if relation == states.NEAR and with_ else default] += states.NAMING_VOTES
            for name, share in shares.items():
                found[name] = relations[relation] * share / sum(shares.values())
    others = [name for name in NAMES if of[name] < 0]
    if max(told[name] for name in others) >= states.MIN_OTHER_VOTES:
        slope, n_half, low, even = SCALES
        worth = frames / (frames + n_half) * slope * belief["votes_worth"]
        ratios = [(told[name] / max(frames, 1e-9) + low) / (even + low) for name in others]
        evidence = np.clip(worth * np.log(ratios), -states.MAX_EVIDENCE, states.MAX_EVIDENCE)
        odds = states.OTHER_ODDS * np.exp(evidence)
        found.update(zip(others, relations[states.NONE] * odds / (1.0 + odds.sum())))
    return found


@given(seed=seeds, count=st.integers(0, 6))
def test_predicates_share_the_probability_of_their_relation(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    beliefs, frames = random_beliefs(rng, count), rng.integers(1, 30, count)
    votes = rng.dirichlet(np.ones(len(NAMES)), (count, 2)) * rng.integers(0, 2, (count, 2, 1))
    votes = (votes * frames[:, None, None]).astype(np.float32)
    names = states.PredicateNames.of(NAMES)
    found, voted = states.predicate_probabilities(beliefs, votes, frames, names, SCALES)
    assert found.shape == votes.shape
    np.testing.assert_array_equal(voted, votes.any(axis=2))
    for row, end in np.ndindex(count, 2):
        expected = predicates_of(beliefs[row], end, votes[row, end], int(frames[row]))
        np.testing.assert_allclose(found[row, end], list(expected.values()), atol=1e-6)
        assert found[row, end].sum() <= 1 + 1e-6
    free = beliefs["relations"][:, :, states.NONE].min(axis=1)
    related = (free < 1 - states.MIN_RELATED) | (beliefs["other_votes"] >= states.MIN_OTHER_VOTES)
    rows = np.arange(count)[::-1].copy()
    np.testing.assert_array_equal(states.related_pairs(beliefs, rows), related[rows])


@given(seed=seeds, threshold_nats=st.sampled_from([0.0, 0.5, 1.0]))
def test_what_is_uncertain(seed: int, threshold_nats: float) -> None:
    rng = np.random.default_rng(seed)
    probabilities = rng.dirichlet(np.full(5, 0.3), (7, 2)) * rng.choice([0.0, 0.3, 1.0], (7, 2, 1))
    sums = probabilities.sum(axis=2, keepdims=True)
    expected = entropy_nats(probabilities / np.maximum(sums, 1e-300)) > threshold_nats
    found = states.uncertain(probabilities, threshold_nats)
    np.testing.assert_array_equal(found, expected & (sums[..., 0] > 0))


# --- what is said --------------------------------------------------------------------------------

SYMMETRIC = np.array([False, True, True, False])


@given(seed=seeds, count=st.integers(0, 6))
def test_said_predicates(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    exact = rng.dirichlet(np.full(4, 0.3), (count, 2)) * rng.random((count, 2, 1))
    exact[::2, 1] = exact[::2, 0] + rng.uniform(-0.004, 0.004, exact[::2, 0].shape)
    exact, sources = exact.clip(0.0), rng.integers(0, 3, (count, 2))
    probabilities = exact.copy()
    said, mutual = states.said_predicates(probabilities, sources, SYMMETRIC)
    np.testing.assert_array_equal(probabilities, exact.round(states.DECIMALS))
    most, best = probabilities.max(axis=2), probabilities.argmax(axis=2)
    both = (most >= states.MIN_PROBABILITY).all(axis=1) & (best[:, 0] == best[:, 1])
    both &= np.ptp(most, axis=1) <= states.SAME_PROBABILITY
    np.testing.assert_array_equal(mutual, both & SYMMETRIC[best[:, 0]])
    np.testing.assert_array_equal(said[:, 0] != 0, most[:, 0] >= states.MIN_PROBABILITY)
    np.testing.assert_array_equal(said[:, 1] != 0, (most[:, 1] >= states.MIN_PROBABILITY) & ~mutual)
    # The number changes with what is said, and with nothing else.
    again, _ = states.said_predicates(exact + 1e-5 * (exact < 0.999), sources, SYMMETRIC)
    same = (exact.round(states.DECIMALS) == (exact + 1e-5).round(states.DECIMALS)).all(axis=(1, 2))
    np.testing.assert_array_equal(said[same], again[same])
    for other in (states.said_predicates(probabilities.copy(), sources + 1, SYMMETRIC)[0],
                  states.said_predicates(probabilities + 1e-3, sources, SYMMETRIC)[0]):  # fmt: skip
        assert (other[said != 0] != said[said != 0]).all()
