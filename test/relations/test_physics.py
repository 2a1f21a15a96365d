"""The embedded world model: its file, its inputs, the votes of frames, and what each is worth."""

import math
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import softmax

from deworldsg_ros.relations import physics
from deworldsg_ros.relations.geometry import FEATURES
from deworldsg_ros.relations.paper import entropy_nats
from deworldsg_ros.relations.states import (
    DIRECTED,
    NEAR,
    NONE,
    ON,
    RELATIONS_OF_STATE,
    SHAPE,
    STATE_COUNT,
    UNDER,
    relation_of_predicates,
)
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import (
    COCO_CLASSES,
    VISUAL_GENOME_CLASSES,
    fixed_table,
    kind_table,
)

seeds = st.integers(0, 10_000)
MODEL = physics.load_physics_model()
Arrays = dict[str, np.ndarray]


def shipped() -> Arrays:
    return {field.name: getattr(MODEL, field.name) for field in fields(physics.PhysicsModel)}


# --- the file ------------------------------------------------------------------------------------


def test_the_shipped_file_loads_and_is_small(tmp_path: Path) -> None:
    assert physics.PATH.stat().st_size <= 2 * 1024 * 1024
    assert all(np.isfinite(values).all() for values in shipped().values())
    assert (MODEL.input_scales > 0).all()
    assert 0 < MODEL.votes.even < 1 and MODEL.votes.slope > 0 and MODEL.votes.n_half > 0
    assert physics.load_physics_model() is MODEL
    np.savez(tmp_path / "same.npz", **shipped())
    copy = physics.load_physics_model(tmp_path / "same.npz")
    for name, values in shipped().items():
        np.testing.assert_array_equal(getattr(copy, name), values)


def write_array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(lambda path: None, id="missing"),
        pytest.param(lambda path: path.mkdir(), id="folder"),
        pytest.param(lambda path: path.write_bytes(b""), id="empty"),
        pytest.param(lambda path: path.write_text("hello"), id="text"),
        pytest.param(lambda path: path.write_bytes(physics.PATH.read_bytes()[:20_000]), id="cut"),
        pytest.param(write_array, id="array"),
    ],
)
def test_a_file_that_is_no_model_is_named(tmp_path: Path, write: Callable[[Path], object]) -> None:
    path = tmp_path / "other.npz"
    write(path)
    with pytest.raises(ConfigurationError, match=r"other\.npz"):
        physics.load_physics_model(path)


@pytest.mark.parametrize("name", [field.name for field in fields(physics.PhysicsModel)])
@pytest.mark.parametrize("change", ["missing", "shorter", "flat", "text"])
def test_a_model_of_another_shape_is_named(tmp_path: Path, name: str, change: str) -> None:
    arrays = shipped()
    if change == "missing":
        del arrays[name]
    elif change == "text":
        arrays[name] = np.full(arrays[name].shape, "x")
    else:
        arrays[name] = arrays[name][..., :-1] if change == "shorter" else arrays[name].ravel()[:2]
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(ConfigurationError, match=r"other\.npz"):
        physics.load_physics_model(tmp_path / "other.npz")


# --- the network ---------------------------------------------------------------------------------


def random_inputs(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return MODEL.input_means + MODEL.input_scales * rng.normal(0, 2, (count, physics.INPUT_COUNT))


@pytest.mark.parametrize("count", [0, 1, 5])
def test_logits_are_the_mean_of_the_networks(count: int) -> None:
    inputs = random_inputs(count, count)
    inputs[:1] = MODEL.input_means + 1e9 * MODEL.input_scales  # far outside of the training
    logits = MODEL.relation_logits(inputs)
    assert logits.shape == (count, len(DIRECTED)) and logits.dtype == np.float64
    x = np.clip(
        (inputs - MODEL.input_means) / MODEL.input_scales, -physics.MAX_INPUT, physics.MAX_INPUT
    )
    members = []
    for member in range(len(MODEL.weights_1)):
        hidden = np.maximum(x @ MODEL.weights_1[member] + MODEL.biases_1[member], 0)
        hidden = np.maximum(hidden @ MODEL.weights_2[member] + MODEL.biases_2[member], 0)
        members.append(hidden @ MODEL.weights_3[member] + MODEL.biases_3[member])
    np.testing.assert_allclose(logits, np.mean(members, axis=0), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("classes", [COCO_CLASSES, VISUAL_GENOME_CLASSES, ("cup",)])
@pytest.mark.parametrize("count", [0, 3])
def test_inputs(classes: tuple[str, ...], count: int) -> None:
    rng = np.random.default_rng(count)
    probabilities = rng.dirichlet(np.ones(len(classes)), 4)
    observations = np.array([1, 5, 20, 400])
    features = rng.normal(size=(count, len(FEATURES)))
    subjects, objects = np.array([0, 1, 3])[:count], np.array([2, 0, 1])[:count]
    made = physics.PairInputs(classes).make(
        features, probabilities, observations, subjects, objects
    )
    assert made.shape == (count, physics.INPUT_COUNT) and np.isfinite(made).all()
    kinds, fixed = kind_table(classes), fixed_table(classes)
    for row, (a, b) in enumerate(zip(subjects.tolist(), objects.tolist())):
        p, q = probabilities[a], probabilities[b]
        expected = [
            *features[row],
            *(p @ kinds),
            *(q @ kinds),
            sum(p[i] * q[j] for i, j in np.argwhere(fixed)),
            sum(q[i] * p[j] for i, j in np.argwhere(fixed)),
            sum(p * q),
            *np.maximum(entropy_nats(np.array([p, q])), physics.LEAST_ENTROPY_NATS),
            *np.log(observations[[a, b]]),
        ]
        np.testing.assert_allclose(made[row], expected, atol=1e-12)


def test_what_stands_on_the_floor() -> None:
    """Objects of 0.8 m, and a floor at 1 m."""
    bottoms = np.array([0.0, 0.03, 0.2, 0.74, 1.5, -0.2, 0.0])
    shapes = np.zeros(len(bottoms), SHAPE)
    shapes["low"][:, 2], shapes["high"][:, 2] = bottoms + 1.0, bottoms + 1.8
    shapes["count"], shapes["floor_odds"] = [9] * 6 + [0], 7.0
    physics.floor_odds(shapes, np.arange(1, len(shapes)), 1.0, MODEL.floor)
    assert shapes["floor_odds"][0] == 7.0  # it was not asked for
    physics.floor_odds(shapes, np.arange(1), 1.0, MODEL.floor)
    offset, by_bottom, by_height = MODEL.floor
    logits = offset + by_bottom * np.abs(bottoms) + by_height * np.log(0.81)
    expected = np.exp(np.clip(logits, -physics.MAX_FLOOR_LOGIT, physics.MAX_FLOOR_LOGIT)) * (
        shapes["count"] > 0
    )
    np.testing.assert_allclose(shapes["floor_odds"], expected, rtol=1e-12)
    assert (np.diff(expected[:5]) < 0).all() and expected[0] > 1.0 > expected[3]


# --- the evidence of votes -----------------------------------------------------------------------

SCALES = physics.VoteScales(slope=1.2, n_half=3.0, floor=0.05, even=0.2)


def evidence_of(votes: float, frames: float, scales: physics.VoteScales = SCALES) -> float:
    """The formula of the module's comment."""
    if not frames:
        return 0.0
    told = math.log((votes / frames + scales.floor) / (scales.even + scales.floor))
    return frames / (frames + scales.n_half) * scales.slope * told


@given(seed=seeds, count=st.integers(0, 5))
def test_the_evidence_is_that_of_the_formula(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    frames = rng.integers(0, 30, count)
    counts = rng.dirichlet(np.ones(NONE + 1), (count, 2))[..., :NONE] * frames[:, None, None]
    logits, near = physics.vote_logits(counts, frames, SCALES)
    assert logits.shape == (count, STATE_COUNT) and (logits[:, 0] == 0).all()
    for row, n in enumerate(frames.tolist()):
        for state in range(1, STATE_COUNT):
            votes = [
                counts[row, end, relation]
                for end, relation in enumerate(RELATIONS_OF_STATE[state].tolist())
                if relation != NONE
            ]
            expected = evidence_of(sum(votes) / len(votes), n)
            assert logits[row, state] == pytest.approx(expected, abs=1e-12)
        votes = counts[row, :, NEAR].mean()
        expected = [evidence_of(votes * by, n) for by in (1.0, physics.NEAR_FLOOR_WORTH)]
        assert near[row] == pytest.approx(expected, abs=1e-12)


def told(rate: physics.VoteRate, rows: list[int], said: float, sure: bool = True) -> bool:
    """Let pairs, seen in 20 frames each, have votes for "on" in a fraction of them."""
    logits, counts = np.full((len(rows), STATE_COUNT), -8.0), np.zeros((len(rows), 2, NONE))
    logits[:, int(sure)] = 0.0
    counts[:, 0, ON] = 20 * said
    judged, frames = np.ones(len(rows), np.bool_), np.full(len(rows), 20)
    return rate.follow(np.array(rows, np.int64), logits, judged, counts, frames)


def test_votes_of_a_source_that_leaves_much_out_are_worth_more() -> None:
    rate = physics.VoteRate()
    assert told(rate, list(range(40)), said=0.2) and rate.worth == 2.5
    counts, frames = np.zeros((3, 2, NONE)), np.array([20, 20, 20])
    counts[:, 0, ON] = 0, 4, 18
    # Silence stays silence, and no vote is worth less than before.
    assert rate.worthy(counts, frames)[:, 0, ON].tolist() == [0, 10, 18]
    assert told(rate, list(range(40)), said=0.7) and rate.worth == 1.0
    assert told(rate, list(range(40)), said=0.2) and rate.worth == 2.5
    assert told(rate, list(range(40)), said=0.2, sure=False) and rate.worth == 1.0  # they left


def test_a_source_that_says_most_or_pairs_of_unsure_geometry_change_nothing() -> None:
    for said, sure in ((0.9, True), (0.6, True), (0.2, False), (0.0, True)):
        rate = physics.VoteRate()
        assert not told(rate, list(range(40)), said, sure) and rate.worth == 1.0


@given(seed=seeds)
def test_the_worth_of_votes_depends_on_no_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    said = rng.uniform(0, 0.5, 30)
    one, other = physics.VoteRate(), physics.VoteRate()
    for row in range(30):
        told(one, [row], said[row])
    for row in rng.integers(0, 30, 50).tolist():  # what they say later replaces it
        told(other, [row], rng.uniform())
    for row in rng.permutation(30).tolist():
        told(other, [row], said[row])
    assert one.worth == other.worth


@pytest.mark.parametrize("count", [0, 3])
@pytest.mark.parametrize("others", ["riding", "on"])
def test_votes_are_summed_by_relation(count: int, others: str) -> None:
    predicates = ("on", "standing on", others, "near", "with", "under")
    votes = np.random.default_rng(1).uniform(0, 3, (count, 2, len(predicates))).astype(np.float32)
    counts, most = physics.relation_counts(votes, relation_of_predicates(predicates))
    assert counts.shape == (count, 2, NONE)
    beyond = votes[:, :, 2]
    on = votes[:, :, 0] + votes[:, :, 1] + (beyond if others == "on" else 0)
    np.testing.assert_allclose(counts[:, :, ON], on, rtol=1e-6)
    np.testing.assert_allclose(counts[:, :, NEAR], votes[:, :, 3] + votes[:, :, 4], rtol=1e-6)
    np.testing.assert_allclose(counts[:, :, UNDER], votes[:, :, 5])
    expected = beyond.max(axis=1) if others == "riding" else np.zeros(count)
    np.testing.assert_allclose(most, expected)


# --- both sources --------------------------------------------------------------------------------


@given(seed=seeds, scale=st.sampled_from([0.0, 1.0, 30.0, 1000.0]), count=st.sampled_from([0, 6]))
def test_geometry_never_excludes_a_state_and_votes_add_to_it(
    seed: int, scale: float, count: int
) -> None:
    """Independent votes by their weight. Without a source the prior is believed."""
    rng = np.random.default_rng(seed)
    geometry, votes = rng.normal(0, scale, (2, count, STATE_COUNT))
    geometry[:, 0] = votes[:, 0] = 0
    independent = rng.random(count) < 0.5
    for model in (MODEL, replace(MODEL, source_weights=np.array([2.0, 1.0, 0.3]))):
        by_geometry, by_votes, broken = model.source_weights
        prior = softmax(np.concatenate([[0.0], np.repeat(model.prior, 2)]))
        assert 0 < broken < 0.5 and prior[0] > 0.5  # most pairs are not related
        sound = softmax(by_geometry * geometry, axis=1) if scale else prior
        worth = np.where(independent, by_votes, 1.0)[:, None] * votes
        expected = softmax(np.log((1 - broken) * sound + broken * prior) + worth, axis=1)
        logits = physics.believed_logits(model, geometry, votes, independent)
        np.testing.assert_allclose(softmax(logits, axis=1), expected, atol=1e-9)
