"""The class-pair prior: a running mean that does not depend on the order."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.relations import mean_of

from deworldsg_ros.relations.paper import ClassPairPrior, PriorState
from deworldsg_ros.scene.errors import RefusedInput

CLASSES, PREDICATES = 4, 3


def random_predictions(count, seed):
    generator = np.random.default_rng(seed)
    classes = generator.integers(0, CLASSES, (count, 2))
    return classes, generator.dirichlet(np.ones(PREDICATES), count)


def counts_of(prior: ClassPairPrior) -> dict[tuple[int, int], int]:
    """Number of predictions of each class pair that has some."""
    state = prior.to_state()
    return dict(zip(map(tuple, state.class_pairs), state.counts))


def every_class_pair():
    return np.argwhere(np.ones((CLASSES, CLASSES)))


def test_an_empty_prior_has_no_class_pairs():
    prior = ClassPairPrior(CLASSES, PREDICATES)
    prior.update(np.zeros((0, 2), np.int64), np.zeros((0, PREDICATES)))
    assert len(prior) == 0
    assert mean_of(prior, 0, 1) is None
    priors, has_prior = prior.lookup(every_class_pair())
    assert not has_prior.any() and (priors == 0).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 40), st.integers(0, 10_000), st.integers(1, 7))
def test_is_the_mean_in_any_order_and_any_portions(count, seed, portions):
    classes, predictions = random_predictions(count, seed)
    whole = ClassPairPrior(CLASSES, PREDICATES)
    whole.update(classes, predictions)
    shuffled = ClassPairPrior(CLASSES, PREDICATES)
    order = np.random.default_rng(seed + 1).permutation(count)
    for portion in np.array_split(order, portions):
        shuffled.update(classes[portion], predictions[portion])
    pairs = every_class_pair()
    np.testing.assert_allclose(whole.lookup(pairs)[0], shuffled.lookup(pairs)[0], rtol=1e-12)
    assert counts_of(whole) == counts_of(shuffled)
    for subject, object_ in pairs:
        rows = (classes == [subject, object_]).all(axis=1)
        mean = mean_of(whole, subject, object_)
        if not rows.any():
            assert mean is None
            continue
        np.testing.assert_allclose(mean, predictions[rows].mean(axis=0), rtol=1e-12)
        assert mean.sum() == pytest.approx(1.0)


def test_pairs_without_a_prediction_are_skipped():
    prior = ClassPairPrior(CLASSES, PREDICATES)
    predictions = np.array([[0.2, 0.3, 0.5], [np.nan] * 3])
    prior.update(np.array([[0, 1], [2, 3]]), predictions)
    assert len(prior) == 1
    assert mean_of(prior, 2, 3) is None
    np.testing.assert_allclose(mean_of(prior, 0, 1), predictions[0])


def test_direction_matters():
    prior = ClassPairPrior(CLASSES, PREDICATES)
    prior.update(np.array([[0, 1]]), np.array([[1.0, 0, 0]]))
    assert mean_of(prior, 1, 0) is None


def test_predictions_count_for_their_class_pair_alone():
    prior = ClassPairPrior(CLASSES, PREDICATES)
    pairs = np.array([[0, 1], [1, 0]])
    row = np.array([[0.5, 0.25, 0.25]])
    assert counts_of(prior) == {}
    prior.update(pairs[:1], row)
    prior.update(pairs[:1], row)
    assert counts_of(prior) == {(0, 1): 2}


def test_saved_and_loaded_it_is_the_same_and_goes_on():
    classes, predictions = random_predictions(30, 5)
    prior = ClassPairPrior(CLASSES, PREDICATES)
    prior.update(classes, predictions)
    saved = msgspec.json.encode(prior.to_state())
    loaded = ClassPairPrior.from_state(msgspec.json.decode(saved, type=PriorState))
    for _ in range(2):
        pairs = every_class_pair()
        assert (loaded.lookup(pairs)[0] == prior.lookup(pairs)[0]).all()
        assert counts_of(loaded) == counts_of(prior)
        prior.update(*random_predictions(9, 6))
        loaded.update(*random_predictions(9, 6))


@pytest.mark.parametrize(
    ("classes", "predictions", "message"),
    [
        ([[0, 9]], [[0.2, 0.3, 0.5]], "classes 0 to 9: expected 0 to 3"),
        ([[-1, 0]], [[0.2, 0.3, 0.5]], "classes -1 to 0"),
        ([[0, 1]], [[0.2, 0.3, 0.6]], "sums from 1.1 to 1.1"),
        ([[0, 1]], [[-0.5, 1.0, 0.5]], "minimum of -0.5"),
        ([[0, 1]], [[0.5, 0.5]], r"shape \(1, 2\): expected \(1, 3\)"),
    ],
)
def test_an_invalid_prediction_is_refused_and_changes_nothing(classes, predictions, message):
    prior = ClassPairPrior(CLASSES, PREDICATES)
    with pytest.raises(RefusedInput, match=message) as refused:
        prior.update(np.array(classes), np.array(predictions))
    assert refused.value.reason == "invalid_prediction" and len(prior) == 0


@pytest.mark.parametrize(
    "change",
    [
        {"counts": [1, 2]},
        {"counts": [0]},
        {"class_pairs": [[0, 1], [0, 1]]},
        {"class_pairs": [[0, 7]]},
        {"sums": [[5.0, 0.0, 0.0]]},
    ],
)
def test_refuses_a_saved_state_that_does_not_fit(change):
    prior = ClassPairPrior(CLASSES, PREDICATES)
    prior.update(np.array([[0, 1]]), np.array([[0.2, 0.3, 0.5]]))
    with pytest.raises(ValueError):
        ClassPairPrior.from_state(msgspec.structs.replace(prior.to_state(), **change))


def test_sums_that_differ_from_one_by_float32_rounding_are_normalised():
    prior = ClassPairPrior(CLASSES, PREDICATES)
    prior.update(np.array([[0, 1]]), np.array([[0.2, 0.3, 0.5]]) * 1.0005)
    np.testing.assert_allclose(mean_of(prior, 0, 1), [0.2, 0.3, 0.5], rtol=1e-12)
