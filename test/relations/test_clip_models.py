"""V-JEPA 2 and DINOv2 from checkpoints in the real format, and what they see of a clip."""

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

from deworldsg_ros.checkpoints.cards import IMAGENET_MEAN, IMAGENET_STD  # noqa: E402
from deworldsg_ros.checkpoints.loading import choose_device, choose_dtype  # noqa: E402
from deworldsg_ros.relations import (  # noqa: E402
    RelationReasoner,
    build_world_model,
    clip_models,
)
from deworldsg_ros.relations.clip_models import ClipGeometry, normalise, stretch  # noqa: E402
from deworldsg_ros.scene.errors import ConfigurationError  # noqa: E402

SAVERS = {"vjepa2": save_vjepa2, "dinov2": save_dinov2}
LOADERS = {"vjepa2": clip_models.load_vjepa2, "dinov2": clip_models.load_dinov2}
# The published 224 pixels of DINOv2 are the default; the tests use a smaller input.
SMALL = {"vjepa2": {}, "dinov2": {"image_size": 56}}
IMAGE_SIZES = {"vjepa2": 32, "dinov2": 56}
of_both = pytest.mark.parametrize("family", SAVERS)

# --- features ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    root = tmp_path_factory.mktemp("checkpoints")
    return {family: save(root / family) for family, save in SAVERS.items()}


def load(family, folder, **changes):
    return LOADERS[family](config_of(family, folder, **changes), **SMALL[family])


def backbone_and_probe(checkpoints, family, folder, **probe):
    """The configuration of a backbone with a random probe."""
    config = config_of(family, checkpoints[family], probe_path=str(folder))
    save_random_probe(folder, LOADERS[family](config).identity, **probe)
    return config


@of_both
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
    # The feature depends on the order of the frames.
    assert not np.allclose(backbone.encode([clip()]), backbone.encode([clip()[::-1]]), atol=1e-3)


def test_dinov2_is_the_mean_of_the_frames_class_tokens(checkpoints):
    backbone = load("dinov2", checkpoints["dinov2"])
    model = transformers.Dinov2Model.from_pretrained(checkpoints["dinov2"]).eval()
    images = normalise(stretch(clip(), backbone.geometry), torch.float32)
    with torch.inference_mode():
        frames = model(images).pooler_output
    for frames_of_clip in (clip(), clip()[::-1]):  # in any order
        feature = backbone.encode([frames_of_clip])[0]
        np.testing.assert_allclose(feature, frames.mean(dim=0), atol=1e-5)


@of_both
def test_the_fingerprint_depends_on_the_weights_and_not_on_the_folder(
    checkpoints, family, tmp_path
):
    here = load(family, checkpoints[family]).identity
    assert load(family, SAVERS[family](tmp_path / "same", seed=0)).identity == here
    other = load(family, SAVERS[family](tmp_path / "other", seed=1)).identity
    assert other.fingerprint != here.fingerprint


@of_both
@pytest.mark.parametrize("inputs", ["clip", "clip_and_boxes"])
def test_backbone_and_probe_are_a_world_model(checkpoints, family, inputs, tmp_path):
    config = backbone_and_probe(checkpoints, family, tmp_path, inputs=inputs)
    model = build_world_model(config)
    assert model.name == family and model.predicates == VOCABULARY.predicates
    for asked in (request(0), request(1, height=20)):
        predicted = model.predict(asked)
        assert predicted.shape == (2, 4)
        np.testing.assert_allclose(predicted.sum(axis=1), 1)
        # Without the boxes a probe cannot distinguish the two directions.
        assert np.allclose(predicted[0], predicted[1]) == (inputs == "clip")
    stage = RelationReasoner(config, model)
    for stamp in range(1, 4):
        stage.observe(pair_graph(stamp), picture(stamp))
    evidence = stage.drain()
    assert [item.stamp_ns for item in evidence] == [3, 2, 1] and stage.counters().encoded == 3
    assert all(item.source == family and item.predicted.all() for item in evidence)


# --- refusals ------------------------------------------------------------------------------------

KEY = "encoder.layer.1.mlp.fc1.weight"


def rewrite(folder, keep):
    """Weights without some parameters."""
    save_vjepa2(folder)
    state = load_file(folder / "model.safetensors")
    kept = {name: value for name, value in state.items() if keep(name)}
    assert len(kept) < len(state)
    save_file(kept, folder / "model.safetensors", metadata={"format": "pt"})


def damage(name, content):
    def write(folder):
        save_vjepa2(folder)
        (folder / name).write_text(content)

    return write


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda folder: None, "cannot be loaded"),
        (lambda folder: save_dinov2(folder), "a checkpoint of dinov2: expected vjepa2"),
        (lambda folder: rewrite(folder, lambda name: name != KEY), f"lacks 1 parameters .*{KEY}"),
        (damage("model.safetensors", "not a checkpoint"), "cannot be loaded"),
        (damage("config.json", json.dumps({"model_type": "no_such_model"})), "cannot be loaded"),
    ],
)
def test_what_is_no_such_checkpoint_is_refused(tmp_path, write, message):
    write(tmp_path)
    with pytest.raises(ConfigurationError, match=message):
        clip_models.load_vjepa2(config_of("vjepa2", tmp_path))


def test_a_checkpoint_without_the_unused_predictor_is_accepted(checkpoints, tmp_path):
    rewrite(tmp_path, lambda name: not name.startswith("predictor."))
    identity = load("vjepa2", checkpoints["vjepa2"]).identity
    assert clip_models.load_vjepa2(config_of("vjepa2", tmp_path)).identity == identity


def test_options_that_do_not_fit_are_refused(checkpoints, monkeypatch):
    with pytest.raises(ConfigurationError, match="a multiple of its tubelet size 2"):
        load("vjepa2", checkpoints["vjepa2"], clip_length=5)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    chosen = {choose_device("perception.device", choice) for choice in ("auto", "cpu")}
    assert chosen == {torch.device("cpu")}
    with pytest.raises(ConfigurationError, match="finds no CUDA device"):
        clip_models.load_vjepa2(config_of("vjepa2", checkpoints["vjepa2"]), device="cuda")
    # Half precision only on CUDA.
    assert choose_dtype(torch.device("cpu")) == torch.float32
    assert choose_dtype(torch.device("cuda")) == torch.float16


@pytest.mark.parametrize(
    "error", [MemoryError(), torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")]
)
def test_out_of_memory_is_reported_with_advice_and_the_run_continues(
    checkpoints, tmp_path, monkeypatch, error
):
    config = backbone_and_probe(checkpoints, "vjepa2", tmp_path)
    reports = []
    stage = RelationReasoner(config, build_world_model(config), reports.append)

    def fail(*_, **__):
        raise error

    monkeypatch.setattr(transformers.VJEPA2Model, "forward", fail)
    for stamp in (1, 2):
        assert len(stage.observe(pair_graph(stamp), picture(stamp)).pairs) == 2
    assert stage.drain() == []
    assert stage.counters().dropped == {"world_model_error": 2}
    assert "out of memory while encoding 1 clip(s): choose a smaller checkpoint" in reports[0]


# --- stretching and normalising ------------------------------------------------------------------


def triangle(x):
    return np.maximum(0, 1 - np.abs(x))


def keys_cubic(x, a=-0.5):
    x = np.abs(x)
    near = (a + 2) * x**3 - (a + 3) * x**2 + 1
    far = a * (x**3 - 5 * x**2 + 8 * x - 4)
    return np.where(x < 1, near, np.where(x < 2, far, 0))


def resize_matrix(before, after, kernel):
    """Weights (after, before): the kernel, as wide as a new pixel where that is wider."""
    scale = before / after
    centres = (np.arange(after)[:, None] + 0.5) * scale - 0.5
    weights = kernel((np.arange(before)[None] - centres) / max(scale, 1))
    return weights / weights.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("size", [(60, 80), (80, 60), (7, 25), (32, 32), (500, 300)])
def test_stretching_equals_the_plain_filter(interpolation, size):
    # Away from black and white: the cubic overshoots, and is cut off there between its two passes.
    images = np.random.default_rng(0).integers(80, 176, (2, *size, 3)).astype(np.uint8)
    stretched = stretch(images, ClipGeometry(32, interpolation))
    assert stretched.dtype == torch.uint8 and stretched.shape == (2, 3, 32, 32)
    kernel = triangle if interpolation == "bilinear" else keys_cubic
    rows, columns = (resize_matrix(side, 32, kernel) for side in size)
    expected = np.einsum("yh,thwc,xw->tcyx", rows, images.astype(np.float64), columns)
    # Each of two passes rounds to whole values, and the cubic's weights are fixed-point.
    np.testing.assert_allclose(stretched.numpy(), np.clip(expected, 0, 255), atol=2.5)


def test_geometry_and_normalisation_are_those_of_the_published_processors():
    assert clip_models.vjepa2_geometry(384) == ClipGeometry(384, "bilinear")
    assert clip_models.dinov2_geometry(224) == ClipGeometry(224, "bicubic")
    for size in ((1, 1), (1, 640), (480, 1)):
        stretched = stretch(np.full((2, *size, 3), 77, np.uint8), clip_models.vjepa2_geometry(256))
        assert stretched.shape == (2, 3, 256, 256) and (stretched == 77).all()
    images = torch.tensor([0, 128, 255], dtype=torch.uint8).reshape(1, 1, 3, 1, 1)
    values = normalise(images, torch.float32).flatten().numpy()
    expected = (np.array([0, 128, 255]) / 255 - IMAGENET_MEAN) / IMAGENET_STD
    np.testing.assert_allclose(values, expected, rtol=1e-5)
