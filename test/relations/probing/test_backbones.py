"""V-JEPA 2 and DINOv2 from checkpoints in the real format; unusable checkpoints are refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")
pytestmark = pytest.mark.models

from safetensors.torch import load_file, save_file  # noqa: E402
from support.checkpoints import (  # noqa: E402  after the guards
    CLIP_LENGTH,
    clip,
    config_of,
    request,
    save_dinov2,
    save_random_probe,
    save_vjepa2,
)
from support.relations import VOCABULARY, pair_graph, picture  # noqa: E402

from deworldsg_ros.checkpoints.loading import choose_device, choose_dtype  # noqa: E402
from deworldsg_ros.relations import (  # noqa: E402
    RelationReasoner,
    build_world_model,
    clip_models,
)
from deworldsg_ros.relations.clip_models import normalise, stretch  # noqa: E402
from deworldsg_ros.scene.errors import ConfigurationError  # noqa: E402

SAVERS = {"vjepa2": save_vjepa2, "dinov2": save_dinov2}
LOADERS = {"vjepa2": clip_models.load_vjepa2, "dinov2": clip_models.load_dinov2}
# The published 224 pixels of DINOv2 are the default; the tests use a smaller input.
SMALL = {"vjepa2": {}, "dinov2": {"image_size": 56}}
IMAGE_SIZES = {"vjepa2": 32, "dinov2": 56}


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    root = tmp_path_factory.mktemp("checkpoints")
    return {family: save(root / family) for family, save in SAVERS.items()}


def load(family, folder, **changes):
    return LOADERS[family](config_of(family, folder, **changes), **SMALL[family])


@pytest.mark.parametrize("family", SAVERS)
def test_a_clip_has_the_same_feature_in_every_batch(checkpoints, family):
    backbone = load(family, checkpoints[family])
    assert backbone.identity.family == family and backbone.identity.feature_dim == 48
    assert backbone.identity.image_size == IMAGE_SIZES[family]
    clips = [clip(0), clip(1, 30, 90), clip(2, 64, 20)]
    features = backbone.encode(clips)
    assert features.shape == (3, 48) and features.dtype == np.float32
    assert backbone.encode([]).shape == (0, 48)
    for row, alone in zip(features, clips):
        np.testing.assert_allclose(row, backbone.encode([alone])[0], atol=1e-5)
    assert not np.allclose(features[0], features[1], atol=1e-3)
    with pytest.raises(ValueError, match="clip of 3 frames: expected 4"):
        backbone.encode([clip(length=3)])


def test_vjepa2_is_the_mean_of_the_encoders_tokens(checkpoints):
    backbone = load("vjepa2", checkpoints["vjepa2"])
    model = transformers.VJEPA2Model.from_pretrained(checkpoints["vjepa2"]).eval()
    images = normalise(stretch(clip(), backbone.geometry), torch.float32)[None]
    assert images.shape == (1, CLIP_LENGTH, 3, 32, 32)
    with torch.inference_mode():
        tokens = model(images, skip_predictor=True).last_hidden_state
    assert tokens.shape[1] == CLIP_LENGTH // 2 * 2 * 2  # T/2 * H/16 * W/16
    np.testing.assert_allclose(backbone.encode([clip()]), tokens.mean(dim=1), atol=1e-5)


def test_dinov2_is_the_mean_of_the_frames_class_tokens(checkpoints):
    backbone = load("dinov2", checkpoints["dinov2"])
    model = transformers.Dinov2Model.from_pretrained(checkpoints["dinov2"]).eval()
    images = normalise(stretch(clip(), backbone.geometry), torch.float32)
    with torch.inference_mode():
        frames = model(images).pooler_output
    np.testing.assert_allclose(backbone.encode([clip()])[0], frames.mean(dim=0), atol=1e-5)
    # The feature does not depend on the order of the frames.
    np.testing.assert_allclose(
        backbone.encode([clip()]), backbone.encode([clip()[::-1]]), atol=1e-5
    )


def test_the_feature_of_vjepa2_depends_on_the_order_of_frames(checkpoints):
    backbone = load("vjepa2", checkpoints["vjepa2"])
    assert not np.allclose(backbone.encode([clip()]), backbone.encode([clip()[::-1]]), atol=1e-3)


@pytest.mark.parametrize("family", SAVERS)
def test_the_fingerprint_depends_on_the_weights_and_not_on_the_folder(
    checkpoints, family, tmp_path
):
    here = load(family, checkpoints[family]).identity
    assert load(family, SAVERS[family](tmp_path / "same", seed=0)).identity == here
    other = load(family, SAVERS[family](tmp_path / "other", seed=1)).identity
    assert other.fingerprint != here.fingerprint


@pytest.mark.parametrize("family", SAVERS)
@pytest.mark.parametrize("inputs", ["clip", "clip_and_boxes"])
def test_backbone_and_probe_are_a_world_model(checkpoints, family, inputs, tmp_path):
    config = config_of(family, checkpoints[family], probe_path=str(tmp_path))
    save_random_probe(tmp_path, LOADERS[family](config).identity, inputs=inputs)
    model = build_world_model(config)
    assert model.name == family and model.predicates == VOCABULARY.predicates
    for asked in (request(0), request(1, height=20)):
        predicted = model.predict(asked)
        assert predicted.shape == (2, 4)
        np.testing.assert_allclose(predicted.sum(axis=1), 1)
        # Without the boxes a probe cannot distinguish the two directions.
        assert np.allclose(predicted[0], predicted[1]) == (inputs == "clip")


def test_the_stage_publishes_the_predictions_of_backbone_and_probe(checkpoints, tmp_path):
    config = config_of("vjepa2", checkpoints["vjepa2"], probe_path=str(tmp_path))
    save_random_probe(tmp_path, clip_models.load_vjepa2(config).identity)
    stage = RelationReasoner(config, build_world_model(config))
    for stamp in range(1, 4):
        stage.observe(pair_graph(stamp), picture(stamp))
    evidence = stage.drain()
    assert [item.stamp_ns for item in evidence] == [3, 2, 1] and stage.counters().encoded == 3
    for item in evidence:
        assert item.source == "vjepa2" and item.predicted.all()


@pytest.mark.parametrize(
    "path, message",
    [
        ("", "relations.world_model_path is empty"),
        ("/no/such/folder", "there is no such folder"),
        ("nobody/no-such-model", "run `hf download nobody/no-such-model`"),
    ],
)
def test_missing_checkpoint_is_one_sentence(path, message):
    with pytest.raises(ConfigurationError, match=message) as refusal:
        clip_models.load_vjepa2(config_of("vjepa2", path))
    assert "\n" not in str(refusal.value)


def test_folder_without_a_model_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="cannot be loaded"):
        clip_models.load_vjepa2(config_of("vjepa2", tmp_path))


@pytest.mark.parametrize("family, other", [("vjepa2", "dinov2"), ("dinov2", "vjepa2")])
def test_other_architecture_is_refused_by_name(checkpoints, family, other):
    with pytest.raises(ConfigurationError, match=f"a checkpoint of {other}: expected {family}"):
        load(family, checkpoints[other])


def test_damaged_or_incomplete_weights_are_refused(checkpoints, tmp_path):
    save_vjepa2(tmp_path)
    weights = tmp_path / "model.safetensors"
    state = load_file(weights)
    key = "encoder.layer.1.mlp.fc1.weight"
    del state[key]
    save_file(state, weights, metadata={"format": "pt"})
    with pytest.raises(ConfigurationError, match=f"lacks 1 parameters of VJEPA2Model.*{key}"):
        clip_models.load_vjepa2(config_of("vjepa2", tmp_path))
    weights.write_bytes(b"not a checkpoint")
    with pytest.raises(ConfigurationError, match="cannot be loaded"):
        clip_models.load_vjepa2(config_of("vjepa2", tmp_path))
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "no_such_model"}))
    with pytest.raises(ConfigurationError, match="cannot be loaded"):
        clip_models.load_vjepa2(config_of("vjepa2", tmp_path))


def test_a_checkpoint_without_the_unused_predictor_is_accepted(checkpoints, tmp_path):
    save_vjepa2(tmp_path)
    weights = tmp_path / "model.safetensors"
    state = load_file(weights)
    kept = {name: value for name, value in state.items() if not name.startswith("predictor.")}
    assert len(kept) < len(state)
    save_file(kept, weights, metadata={"format": "pt"})
    identity = load("vjepa2", checkpoints["vjepa2"]).identity
    assert clip_models.load_vjepa2(config_of("vjepa2", tmp_path)).identity == identity


def test_a_clip_length_that_the_encoder_cannot_split_is_refused(checkpoints):
    with pytest.raises(ConfigurationError, match="a multiple of its tubelet size 2"):
        load("vjepa2", checkpoints["vjepa2"], clip_length=5)


def test_cuda_without_a_device_is_refused(checkpoints, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    chosen = {choose_device("perception.device", choice) for choice in ("auto", "cpu")}
    assert chosen == {torch.device("cpu")}
    with pytest.raises(ConfigurationError, match="finds no CUDA device: set it to 'auto' or 'cpu'"):
        clip_models.load_vjepa2(config_of("vjepa2", checkpoints["vjepa2"]), device="cuda")


def test_half_precision_only_on_cuda():
    assert choose_dtype(torch.device("cpu")) == torch.float32
    assert choose_dtype(torch.device("cuda")) == torch.float16


@pytest.mark.parametrize(
    "error", [MemoryError(), torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")]
)
def test_out_of_memory_is_reported_with_advice_and_the_run_continues(
    checkpoints, tmp_path, monkeypatch, error
):
    identity = load("vjepa2", checkpoints["vjepa2"]).identity
    save_random_probe(tmp_path, identity)
    config = config_of("vjepa2", checkpoints["vjepa2"], probe_path=str(tmp_path))
    reports = []
    stage = RelationReasoner(config, build_world_model(config), reports.append)

    def fail(*_, **__):
        raise error

    monkeypatch.setattr(transformers.VJEPA2Model, "forward", fail)
    for stamp in (1, 2):
        evidence = stage.observe(pair_graph(stamp), picture(stamp))
        assert len(evidence.pairs) == 2
    assert stage.drain() == []
    assert stage.counters().dropped == {"world_model_error": 2}
    assert "out of memory while encoding 1 clip(s): choose a smaller checkpoint" in reports[0]
