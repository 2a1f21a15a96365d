"""The registry of world models, and the fake one."""

from __future__ import annotations

import numpy as np
import pytest
from support.relations import VOCABULARY

from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations import build_world_model, world_model_names
from deworldsg_ros.relations.world_model import ClipRequest, PairContext
from deworldsg_ros.relations.world_models.fake import FakeWorldModel
from deworldsg_ros.scene.errors import ConfigurationError

BOX = np.array([0.0, 0, 4, 4])


def request(seed=0, classes=((0, 1), (1, 0))):
    clip = np.random.default_rng(seed).integers(0, 256, (16, 6, 8, 3)).astype(np.uint8)
    names = VOCABULARY.classes
    pairs = tuple(PairContext(BOX, BOX, s, o, names[s], names[o]) for s, o in classes)
    return ClipRequest(clip, pairs, VOCABULARY)


def test_world_models_are_chosen_by_name():
    assert {"none", "fake"} <= set(world_model_names())
    assert build_world_model(RelationsConfig()) is None
    model = build_world_model(RelationsConfig(world_model="fake", clip_length=8, seed=3))
    assert isinstance(model, FakeWorldModel) and model.name == "fake" and model.clip_length == 8


@pytest.mark.parametrize("name", ["", "fakes", "__init__", "..evidence"])
def test_unknown_name_is_refused_with_those_that_there_are(name):
    with pytest.raises(ConfigurationError, match="wanted one of .*fake, none"):
        build_world_model(RelationsConfig(world_model=name))


def test_fake_gives_distributions_for_each_pair_of_each_clip():
    answers = FakeWorldModel(16, 0).predict_batch([request(0), request(1, ((0, 0),))])
    assert [answer.shape for answer in answers] == [(2, 4), (1, 4)]
    for answer in answers:
        assert (answer > 0).all()
        np.testing.assert_allclose(answer.sum(axis=1), 1.0)


def test_fake_depends_on_the_clip_the_classes_and_the_seed_and_on_nothing_else():
    (answer,) = FakeWorldModel(16, 0).predict_batch([request()])
    (again,) = FakeWorldModel(16, 0).predict_batch([request()])
    assert (answer == again).all()
    assert not np.allclose(answer[0], answer[1])  # the other direction
    assert not np.allclose(answer, FakeWorldModel(16, 0).predict_batch([request(seed=1)])[0])
    assert not np.allclose(answer, FakeWorldModel(16, 1).predict_batch([request()])[0])


def test_fake_gives_its_recorded_answer():
    """A change here changes every recorded graph that the fake took part in."""
    clip = np.arange(2 * 2 * 2 * 3, dtype=np.uint8).reshape(2, 2, 2, 3)
    pair = PairContext(BOX, BOX, 0, 1, "chair", "table")
    (answer,) = FakeWorldModel(2, 0).predict_batch([ClipRequest(clip, (pair,), VOCABULARY)])
    recorded = [
        0.9795641544637592,
        0.0032131442532744633,
        0.0061277984104028205,
        0.01109490287256345,
    ]
    np.testing.assert_allclose(answer, [recorded], rtol=1e-12)


def test_fakes_class_pair_decides_which_predicate_leads_in_every_clip():
    leaders = set()
    for seed in range(20):
        (answer,) = FakeWorldModel(16, 0).predict_batch([request(seed)])
        leaders.add(tuple(answer.argmax(axis=1).tolist()))
    assert len(leaders) == 1
