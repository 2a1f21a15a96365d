"""Half precision is compared with single precision at start-up, and NaN is named.

A CPU stands in for a GPU: it computes in float16 and bfloat16, too. CUDA itself is not tested.
"""

import numpy as np
import pytest
from support.checkpoints import clip, config_of, request, save_random_probe, save_vjepa2
from support.torch_models import image, save_rtdetr, save_sam2, save_sam3, settings, torch

from deworldsg_ros.checkpoints.loading import in_best_precision
from deworldsg_ros.perception.backends import sam
from deworldsg_ros.perception.backends.closed_set import ClosedSetDetector
from deworldsg_ros.perception.backends.sam import Sam2Segmenter, Sam3Segmenter
from deworldsg_ros.relations import clip_models
from deworldsg_ros.relations.clip_models import build_probed
from deworldsg_ros.relations.stage import ClipEncoder
from deworldsg_ros.scene.errors import RefusedInput

pytestmark = pytest.mark.models

CPU = torch.device("cpu")
HALF, BRAIN, SINGLE = torch.float16, torch.bfloat16, torch.float32


def squared_norm(model, dtype):
    """(100 x 4)² = 160 000 is beyond float16, and within bfloat16."""
    return model(torch.full((1, 4), 100.0, dtype=dtype)) ** 2


def unstable(model, dtype):
    return torch.full((3,), 1.0 if dtype == SINGLE else 1.2)


def unsupported(model, dtype):
    if dtype != SINGLE:
        raise RuntimeError('"kernel" not implemented for Half')
    return torch.ones(3)


def not_run(model, dtype):
    raise AssertionError("single precision is not compared")


@pytest.mark.parametrize(
    ("scale", "wanted", "run", "used", "words"),
    [
        (0.01, HALF, squared_norm, HALF, ""),
        (1.0, BRAIN, squared_norm, BRAIN, ""),
        (1.0, HALF, squared_norm, SINGLE, "the network: float16 gives NaN or infinity"),
        (1.0, HALF, unstable, SINGLE, "a relative error of 20.0%"),
        (1.0, HALF, unsupported, SINGLE, "not supported"),
        (1.0, SINGLE, not_run, SINGLE, ""),
    ],
)
def test_half_precision_is_kept_where_it_is_exact_enough(scale, wanted, run, used, words, caplog):
    model = torch.nn.Linear(4, 3)
    torch.nn.init.constant_(model.weight, scale)
    model, dtype = in_best_precision(model, CPU, wanted, run, "the network")
    assert dtype == used and model.weight.dtype == used
    assert words in caplog.text and bool(words) == bool(caplog.messages)


@pytest.mark.parametrize(
    ("family", "save"), [(Sam2Segmenter, save_sam2), (Sam3Segmenter, save_sam3)]
)
def test_sam_in_bfloat16_gives_nearly_the_masks_of_float32(tmp_path, monkeypatch, family, save):
    config = settings(segmenter_path=str(save(tmp_path)))
    boxes = np.array([[5.0, 5, 30, 40], [20, 10, 70, 50]])
    exact = family(config)._masks(image(60, 80), boxes)
    monkeypatch.setattr(sam, "choose_dtype", lambda device, **_: BRAIN)
    reduced = family(config)
    assert reduced.dtype == BRAIN
    assert (reduced._masks(image(60, 80), boxes) != exact).mean() < 0.05


def test_a_backbone_in_half_precision_gives_nearly_its_features(tmp_path, monkeypatch):
    config = config_of("vjepa2", save_vjepa2(tmp_path))
    exact = clip_models.load_vjepa2(config).encode([clip()])
    monkeypatch.setattr(clip_models, "choose_dtype", lambda device: HALF)
    reduced = clip_models.load_vjepa2(config)
    assert reduced.dtype == HALF
    found = reduced.encode([clip()])
    assert np.linalg.norm(found - exact) < 0.02 * np.linalg.norm(exact)


def test_nan_in_features_is_counted_by_name(tmp_path, monkeypatch):
    folder = save_vjepa2(tmp_path / "model")
    identity = clip_models.load_vjepa2(config_of("vjepa2", folder)).identity
    probe = save_random_probe(tmp_path / "probe", identity)
    config = config_of("vjepa2", folder, probe_path=str(probe))
    model = build_probed(config, clip_models.load_vjepa2, "cpu")
    nan = torch.full((1, identity.feature_dim), float("nan"))
    object.__setattr__(model._backbone, "features", lambda videos: nan)
    with pytest.raises(RefusedInput, match="48 of 48 values of a feature of vjepa2 are NaN"):
        model.predict(request())
    reports = []
    encoder = ClipEncoder(model, reports.append)
    monkeypatch.setattr("deworldsg_ros.relations.stage.clip_request", lambda *_: request())
    assert encoder.encode(None, []) is None
    assert encoder.failure == "nan_features"
    assert "are NaN or infinite in float32" in reports[0]


def test_nan_of_a_detector_is_an_error_and_not_an_empty_image(tmp_path):
    detector = ClosedSetDetector(settings(detector_path=str(save_rtdetr(tmp_path))))
    with torch.no_grad():
        for head in detector.model.model.decoder.class_embed:
            head.bias.fill_(float("nan"))
    with pytest.raises(RefusedInput, match="the class logits are NaN") as refused:
        detector.detect(image(), 0.1)
    assert refused.value.reason == "detector_error"
