"""The registry of world models, and the deterministic test double `fake`."""

from __future__ import annotations

import numpy as np
import pytest
from support.relations import VOCABULARY

from deworldsg_ros.config import RelationsConfig, from_mapping
from deworldsg_ros.relations import WORLD_MODELS, build_world_model
from deworldsg_ros.relations.world_model import ClipRequest, FakeWorldModel, PairContext
from deworldsg_ros.scene.errors import ConfigurationError

BOX = np.array([0.0, 0, 4, 4])


def request(seed=0, classes=((0, 1), (1, 0))):
    clip = np.random.default_rng(seed).integers(0, 256, (16, 6, 8, 3)).astype(np.uint8)
    names = VOCABULARY.classes
    pairs = tuple(PairContext(BOX, BOX, s, o, names[s], names[o]) for s, o in classes)
    return ClipRequest(clip, pairs, VOCABULARY)


def test_world_models_are_chosen_by_name():
    assert {"none", "fake"} <= set(WORLD_MODELS)
    assert build_world_model(RelationsConfig()) is None
    model = build_world_model(RelationsConfig(world_model="fake", clip_length=8))
    assert isinstance(model, FakeWorldModel) and model.name == "fake" and model.clip_length == 8


@pytest.mark.parametrize("key", ["encode", "clips_per_s", "model_path", "batch_size", "seed"])
def test_removed_options_are_refused_by_name(key):
    with pytest.raises(ConfigurationError, match=rf"there is no option \w+\.{key}\b"):
        from_mapping({"relations": {key: 1}})


@pytest.mark.parametrize("name", ["", "fakes", "__init__", "..evidence"])
def test_an_unknown_name_is_refused_and_the_known_names_are_listed(name):
    with pytest.raises(ConfigurationError, match="expected one of .*fake, none"):
        build_world_model(RelationsConfig(world_model=name))


def test_the_fake_gives_a_distribution_per_pair():
    for asked, shape in ((request(0), (2, 4)), (request(1, ((0, 0),)), (1, 4))):
        predicted = FakeWorldModel(16).predict(asked)
        assert predicted.shape == shape and (predicted > 0).all()
        np.testing.assert_allclose(predicted.sum(axis=1), 1.0)


def test_the_fake_depends_only_on_clip_classes_and_seed():
    predicted = FakeWorldModel(16).predict(request())
    again = FakeWorldModel(16).predict(request())
    assert (predicted == again).all()
    assert not np.allclose(predicted[0], predicted[1])  # the other direction
    assert not np.allclose(predicted, FakeWorldModel(16).predict(request(seed=1)))
    assert not np.allclose(predicted, FakeWorldModel(16, seed=1).predict(request()))


def test_the_fake_gives_its_recorded_prediction():
    """A change here changes every recorded graph made with the fake."""
    clip = np.arange(2 * 2 * 2 * 3, dtype=np.uint8).reshape(2, 2, 2, 3)
    pair = PairContext(BOX, BOX, 0, 1, "chair", "table")
    predicted = FakeWorldModel(2).predict(ClipRequest(clip, (pair,), VOCABULARY))
    recorded = [
        0.9795641544637592,
        0.0032131442532744633,
        0.0061277984104028205,
        0.01109490287256345,
    ]
    np.testing.assert_allclose(predicted, [recorded], rtol=1e-12)


def test_the_class_pair_decides_the_most_probable_predicate_of_the_fake():
    leaders = set()
    for seed in range(20):
        predicted = FakeWorldModel(16).predict(request(seed))
        leaders.add(tuple(predicted.argmax(axis=1).tolist()))
    assert len(leaders) == 1
