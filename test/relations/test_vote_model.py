"""The evidence of frame votes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deworldsg_ros.relations.physics import (
    VoteScales,
    count_votes,
    load_physics_model,
    near_logits,
    relation_counts,
    vote_logits,
)
from deworldsg_ros.relations.states import (
    ABOVE,
    DIRECTED,
    NEAR,
    NONE,
    ON,
    RELATIONS_OF_STATE,
    STATE_COUNT,
    UNDER,
    relation_of_predicates,
)

SCALES = VoteScales(slope=1.2, n_half=3.0, floor=0.05, even=0.2)
seeds = st.integers(0, 10_000)


def evidence_of(votes: float, frames: float, scales: VoteScales = SCALES) -> float:
    """The formula of the module's docstring."""
    if not frames:
        return 0.0
    told = math.log((votes / frames + scales.floor) / (scales.even + scales.floor))
    return frames / (frames + scales.n_half) * scales.slope * told


def evidence_on_near(fractions: np.ndarray, frames: np.ndarray, scales: VoteScales) -> np.ndarray:
    """Evidence of these fractions of votes, by the relation whose evidence has no other part."""
    counts = np.zeros((len(frames), 2, NONE))
    counts[:, :, NEAR] = (fractions * frames)[:, None]
    return near_logits(counts, frames, scales)


def random_counts(seed: int, count: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    frames = rng.integers(0, 30, count).astype(float)
    counts = rng.dirichlet(np.ones(NONE + 1), (count, 2))[..., :NONE] * frames[:, None, None]
    return counts, frames


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_the_evidence_is_that_of_the_formula(seed: int) -> None:
    counts, frames = random_counts(seed)
    logits = vote_logits(counts, frames, SCALES)
    assert logits.shape == (len(frames), STATE_COUNT) and (logits[:, 0] == 0).all()
    for row, n in enumerate(frames.tolist()):
        for state in range(1, STATE_COUNT):
            votes = [
                counts[row, end, relation]
                for end, relation in enumerate(RELATIONS_OF_STATE[state].tolist())
                if relation != NONE
            ]
            expected = evidence_of(sum(votes) / len(votes), n)
            assert logits[row, state] == pytest.approx(expected, abs=1e-12)
        near = (counts[row, 0, NEAR] + counts[row, 1, NEAR]) / 2
        seen = near_logits(counts[row : row + 1], frames[row : row + 1], SCALES)[0]
        assert seen == pytest.approx(evidence_of(near, n), abs=1e-12)


@pytest.mark.parametrize("scales", [SCALES, load_physics_model().votes])
def test_it_grows_with_the_fraction_and_is_0_at_even(scales: VoteScales) -> None:
    fractions = np.linspace(0, 1, 21)
    for frames in (1.0, 5.0, 100.0):
        values = evidence_on_near(fractions, np.full(21, frames), scales)
        assert (np.diff(values) > 0).all()
        even = evidence_on_near(np.array([scales.even]), np.array([frames]), scales)
        assert even == pytest.approx(0)
        assert values[0] < 0 < values[-1]


@pytest.mark.parametrize("scales", [SCALES, load_physics_model().votes])
@pytest.mark.parametrize("fraction", [0.0, 0.9])
def test_it_saturates_with_the_frames(scales: VoteScales, fraction: float) -> None:
    frames = np.array([1.0, 2, 4, 8, 1000, 1e6])
    values = np.abs(evidence_on_near(np.full(6, fraction), frames, scales))
    assert (np.diff(values) > 0).all()
    assert values[-1] - values[-2] < 0.01 * values[-1]
    (half,) = evidence_on_near(np.array([fraction]), np.array([scales.n_half]), scales)
    assert abs(half) == pytest.approx(values[-1] / 2, rel=1e-3)


@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_the_other_end_sees_the_other_states(seed: int) -> None:
    counts, frames = random_counts(seed)
    one = vote_logits(counts, frames, SCALES)
    other = vote_logits(counts[:, ::-1], frames, SCALES)
    for state in range(1, STATE_COUNT):
        mirrored = 1 + (state - 1 ^ 1)
        np.testing.assert_allclose(other[:, mirrored], one[:, state], atol=1e-12)
    np.testing.assert_allclose(
        near_logits(counts, frames, SCALES), near_logits(counts[:, ::-1], frames, SCALES)
    )


def test_no_frames_are_no_evidence() -> None:
    counts = np.zeros((2, 2, NONE))
    assert (vote_logits(counts, np.zeros(2), SCALES) == 0).all()
    assert (near_logits(counts, np.zeros(2), SCALES) == 0).all()
    assert vote_logits(counts[:0], np.zeros(0), SCALES).shape == (0, STATE_COUNT)


def test_frames_without_votes_speak_against_every_relation() -> None:
    logits = vote_logits(np.zeros((1, 2, NONE)), np.array([5.0]), SCALES)
    assert (logits[0, 1:] < 0).all()
    assert near_logits(np.zeros((1, 2, NONE)), np.array([5.0]), SCALES)[0] < 0


def test_above_and_under_are_one_state() -> None:
    """Half of the frames said that A is above B, the other half that B is under A."""
    counts = np.zeros((1, 2, NONE))
    counts[0, 0, ABOVE] = counts[0, 1, UNDER] = 5.0
    states = vote_logits(counts, np.array([10.0]), SCALES)[0]
    assert states.argmax() == 1 + 2 * DIRECTED.index(ABOVE)
    counts = np.zeros((1, 2, NONE))
    counts[0, 1, ON] = 9.0
    assert vote_logits(counts, np.array([10.0]), SCALES)[0].argmax() == 2


@pytest.mark.parametrize("count", [0, 3])
def test_votes_are_summed_by_relation(count: int) -> None:
    predicates = ("on", "standing on", "riding", "near", "with", "under")
    votes = np.random.default_rng(1).uniform(0, 3, (count, len(predicates)))
    counts = relation_counts(votes, relation_of_predicates(predicates))
    assert counts.shape == (count, NONE)
    np.testing.assert_allclose(counts[:, ON], votes[:, 0] + votes[:, 1])
    np.testing.assert_allclose(counts[:, NEAR], votes[:, 3] + votes[:, 4])
    np.testing.assert_allclose(counts[:, UNDER], votes[:, 5])
    np.testing.assert_allclose(counts.sum(), votes.sum() - votes[:, 2].sum())


@pytest.mark.parametrize("count", [0, 3])
def test_votes_beyond_the_relations(count: int) -> None:
    votes = np.random.default_rng(count).uniform(0, 5, (count, 2, 6))
    relation_of = np.array([ON, -1, NEAR, -1, -1, ABOVE])
    counts, most = np.full((count, 2, NONE), np.nan), np.full(count, np.nan)
    count_votes(np.arange(count), votes, relation_of, counts, most)
    np.testing.assert_array_equal(most, votes[:, :, relation_of < 0].max(axis=(1, 2), initial=0))
    np.testing.assert_array_equal(counts, relation_counts(votes, relation_of))
    count_votes(np.arange(count), votes, np.full(6, ON), counts, most)
    assert (most == 0).all()
