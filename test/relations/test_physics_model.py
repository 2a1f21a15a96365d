"""The embedded world model: its file, its inputs, and the weight of its sources."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import softmax

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations.geometry import FEATURES
from deworldsg_ros.relations.paper import entropy_nats
from deworldsg_ros.relations.physics import (
    INPUT_COUNT,
    MAX_INPUT,
    PATH,
    PairInputs,
    PhysicsModel,
    believed_logits,
    floor_odds,
    load_physics_model,
)
from deworldsg_ros.relations.registry import WORLD_MODELS, build_world_model
from deworldsg_ros.relations.states import DIRECTED, STATE_COUNT
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import (
    COCO_CLASSES,
    KINDS,
    VISUAL_GENOME_CLASSES,
    fixed_table,
    kind_table,
)

seeds = st.integers(0, 10_000)
MODEL = load_physics_model()
Arrays = dict[str, np.ndarray]


def shipped() -> Arrays:
    return {field.name: getattr(MODEL, field.name) for field in fields(PhysicsModel)}


def random_inputs(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return MODEL.input_means + MODEL.input_scales * rng.normal(0, 2, (count, INPUT_COUNT))


# --- the file ------------------------------------------------------------------------------------


def test_the_shipped_file_loads_and_is_small() -> None:
    assert PATH.stat().st_size <= 2 * 1024 * 1024
    assert all(np.isfinite(values).all() for values in shipped().values())
    assert (MODEL.input_scales > 0).all()
    assert 0 < MODEL.votes.even < 1 and MODEL.votes.slope > 0 and MODEL.votes.n_half > 0
    assert load_physics_model() is MODEL


def test_it_is_a_world_model_that_needs_no_clips() -> None:
    assert "physics" in WORLD_MODELS
    assert build_world_model(RelationsConfig(world_model="physics")) is None
    assert RelationsConfig().world_model == "physics"


def cut(path: Path) -> None:
    path.write_bytes(PATH.read_bytes()[:20_000])


def array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(lambda path: None, id="missing"),
        pytest.param(lambda path: path.mkdir(), id="folder"),
        pytest.param(lambda path: path.write_bytes(b""), id="empty"),
        pytest.param(lambda path: path.write_text("hello"), id="text"),
        pytest.param(cut, id="cut"),
        pytest.param(array, id="array"),
    ],
)
def test_a_file_that_is_no_model_is_named(tmp_path: Path, write: Callable[[Path], object]) -> None:
    path = tmp_path / "other.npz"
    write(path)
    with pytest.raises(ConfigurationError, match=r"other\.npz .*reinstall the package"):
        load_physics_model(path)


@pytest.mark.parametrize("name", [field.name for field in fields(PhysicsModel)])
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
    with pytest.raises(ConfigurationError, match=r"other\.npz .*reinstall the package"):
        load_physics_model(tmp_path / "other.npz")


def test_a_copy_of_the_shipped_file_is_the_same_model(tmp_path: Path) -> None:
    np.savez(tmp_path / "same.npz", **shipped())
    copy = load_physics_model(tmp_path / "same.npz")
    for name, values in shipped().items():
        np.testing.assert_array_equal(getattr(copy, name), values)


# --- logits --------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 5])
def test_logits_are_the_mean_of_the_networks(count: int) -> None:
    inputs = random_inputs(count, count)
    logits = MODEL.relation_logits(inputs)
    assert logits.shape == (count, len(DIRECTED)) and logits.dtype == np.float64
    x = np.clip((inputs - MODEL.input_means) / MODEL.input_scales, -MAX_INPUT, MAX_INPUT)
    members = []
    for member in range(len(MODEL.weights_1)):
        hidden = np.maximum(x @ MODEL.weights_1[member] + MODEL.biases_1[member], 0)
        hidden = np.maximum(hidden @ MODEL.weights_2[member] + MODEL.biases_2[member], 0)
        members.append(hidden @ MODEL.weights_3[member] + MODEL.biases_3[member])
    np.testing.assert_allclose(logits, np.mean(members, axis=0), rtol=1e-3, atol=1e-3)


def test_inputs_far_outside_of_the_training_are_limited() -> None:
    extreme = MODEL.input_means + 1e9 * MODEL.input_scales
    at_limit = MODEL.input_means + MAX_INPUT * MODEL.input_scales
    np.testing.assert_allclose(
        MODEL.relation_logits(extreme[None]), MODEL.relation_logits(at_limit[None]), rtol=1e-5
    )


@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_the_states_of_a_swapped_pair_are_swapped(seed: int) -> None:
    there, back = random_inputs(seed, 4), random_inputs(seed + 1, 4)
    one, other = MODEL.state_logits(there, back), MODEL.state_logits(back, there)
    assert one.shape == (4, STATE_COUNT) and (one[:, 0] == 0).all()
    np.testing.assert_array_equal(other[:, 1::2], one[:, 2::2])
    np.testing.assert_array_equal(other[:, 2::2], one[:, 1::2])


def odds_of(bottoms_m: np.ndarray, points: int = 9) -> np.ndarray:
    """Odds that objects of 0.8 m with these bottoms stand on a floor at 1 m."""
    low = np.column_stack([np.zeros((len(bottoms_m), 2)), bottoms_m]) + 1.0
    high, counts = low + 0.8, np.full(len(low), points)
    return floor_odds(np.arange(len(low)), low, high, counts, 1.0, MODEL.floor)


def test_what_stands_on_the_floor() -> None:
    bottoms = np.array([0.0, 0.03, 0.2, 0.74, 1.5])
    odds = odds_of(bottoms)
    assert (np.diff(odds) < 0).all() and odds[0] > 1.0 > odds[3]
    offset, by_bottom, by_height = MODEL.floor
    logits = offset + by_bottom * bottoms + by_height * np.log(0.81)
    np.testing.assert_allclose(odds, np.exp(np.clip(logits, -20, 20)), rtol=1e-12)
    np.testing.assert_array_equal(odds_of(-bottoms), odds)
    assert odds_of(np.zeros(0)).shape == (0,)
    assert (odds_of(bottoms, points=0) == 0).all()


# --- inputs --------------------------------------------------------------------------------------


@pytest.mark.parametrize("classes", [COCO_CLASSES, VISUAL_GENOME_CLASSES, ("cup",)])
@pytest.mark.parametrize("count", [0, 3])
def test_inputs(classes: tuple[str, ...], count: int) -> None:
    rng = np.random.default_rng(count)
    nodes = 4
    probabilities = rng.dirichlet(np.ones(len(classes)), nodes)
    observations = np.array([1, 5, 20, 400])
    features = rng.normal(size=(count, len(FEATURES)))
    subjects, objects = np.array([0, 1, 3])[:count], np.array([2, 0, 1])[:count]
    made = PairInputs(classes).make(features, probabilities, observations, subjects, objects)
    assert made.shape == (count, INPUT_COUNT) and np.isfinite(made).all()
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
            *entropy_nats(np.array([p, q])),
            *np.log(observations[[a, b]]),
        ]
        np.testing.assert_allclose(made[row], expected, atol=1e-12)
        assert len(expected) == len(FEATURES) + 2 * len(KINDS) + 7


# --- both sources --------------------------------------------------------------------------------


def logits_of(state: int, value: float) -> np.ndarray:
    logits = np.zeros((1, STATE_COUNT))
    logits[0, state] = value
    return logits


def prior_of(model: PhysicsModel) -> np.ndarray:
    return softmax(np.concatenate([[0.0], np.repeat(model.prior, 2)]))


@pytest.mark.parametrize("count", [0, 3])
def test_without_any_source_the_prior_is_believed(count: int) -> None:
    zeros = np.zeros((count, STATE_COUNT))
    believed = softmax(believed_logits(MODEL, zeros, zeros, np.zeros(count, bool)), axis=1)
    assert believed.shape == (count, STATE_COUNT)
    np.testing.assert_allclose(believed, np.tile(prior_of(MODEL), (count, 1)), atol=1e-9)
    assert (believed[:, 0] > 0.5).all()  # most pairs are not related


@settings(max_examples=30, deadline=None)
@given(seed=seeds, scale=st.sampled_from([1.0, 30.0, 1000.0]))
def test_geometry_never_excludes_a_state(seed: int, scale: float) -> None:
    geometry = np.random.default_rng(seed).normal(0, scale, (6, STATE_COUNT))
    geometry[:, 0] = 0
    none = np.zeros((6, STATE_COUNT))
    believed = softmax(believed_logits(MODEL, geometry, none, np.zeros(6, bool)), axis=1)
    broken = MODEL.source_weights[2]
    assert 0 < broken < 0.5
    assert (believed >= broken * prior_of(MODEL) * (1 - 1e-9)).all()
    sound = softmax(MODEL.source_weights[0] * geometry, axis=1)
    np.testing.assert_allclose(believed, (1 - broken) * sound + broken * prior_of(MODEL), atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_votes_add_to_the_logits_and_independent_ones_by_their_weight(seed: int) -> None:
    rng = np.random.default_rng(seed)
    geometry, votes = rng.normal(0, 3, (2, 4, STATE_COUNT))
    geometry[:, 0] = votes[:, 0] = 0
    independent = np.array([True, False, True, False])
    without = believed_logits(MODEL, geometry, np.zeros_like(votes), independent)
    added = believed_logits(MODEL, geometry, votes, independent) - without
    np.testing.assert_allclose(added[1::2], votes[1::2])
    np.testing.assert_allclose(added[::2], MODEL.source_weights[1] * votes[::2])


def test_votes_of_an_independent_head_count_more() -> None:
    assert MODEL.source_weights[1] > 1
    geometry, votes = logits_of(1, -2.0), logits_of(1, 1.0)
    own, independent = (
        softmax(believed_logits(MODEL, geometry, votes, np.array([flag])))[0, 1]
        for flag in (False, True)
    )
    alone = softmax(believed_logits(MODEL, geometry, 0 * votes, np.array([False])))[0, 1]
    assert independent > own > alone


def test_the_weight_of_geometry_is_that_of_the_model() -> None:
    trusting = replace(MODEL, source_weights=np.array([2.0, 1.0, 1e-9]))
    geometry = logits_of(3, 1.5)
    believed = believed_logits(trusting, geometry, 0 * geometry, np.array([False]))
    assert believed[0, 3] - believed[0, 0] == pytest.approx(3.0, abs=1e-6)
