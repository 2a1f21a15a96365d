"""Half precision is compared with single precision at start-up, and NaN is named.

A CPU stands in for a GPU: it computes in float16 and bfloat16, too. CUDA itself is not tested.
"""

from __future__ import annotations

import numpy as np
import pytest
from support.checkpoints import clip, config_of, request, save_random_probe, save_vjepa2
from support.torch_models import image, save_rtdetr, save_sam2, save_sam3, settings, torch

from deworldsg_ros.checkpoints import loading
from deworldsg_ros.checkpoints.loading import choose_dtype, in_best_precision, require_finite
from deworldsg_ros.perception.backends import sam
from deworldsg_ros.perception.backends.rtdetr import RtDetrDetector
from deworldsg_ros.perception.backends.sam import Sam2Segmenter, Sam3Segmenter
from deworldsg_ros.relations import clip_models
from deworldsg_ros.relations.clip_models import build_probed
from deworldsg_ros.scene.errors import RefusedInput

pytestmark = pytest.mark.models

CPU = torch.device("cpu")


def squared_norm(model, dtype):
    return model(torch.full((1, 4), 100.0, dtype=dtype)) ** 2


def linear(scale):
    model = torch.nn.Linear(4, 3)
    torch.nn.init.constant_(model.weight, scale)
    return model


def test_half_precision_is_kept_where_it_is_exact_enough(caplog) -> None:
    for half in (torch.float16, torch.bfloat16):
        model, dtype = in_best_precision(linear(0.01), CPU, half, squared_norm, "the network")
        assert dtype == half and model.weight.dtype == half
    assert not caplog.messages


def test_an_overflow_in_half_precision_falls_back_with_a_word(caplog) -> None:
    """(100 x 4)² = 160 000 is beyond float16, and within bfloat16."""
    model, dtype = in_best_precision(linear(1.0), CPU, torch.float16, squared_norm, "the network")
    assert dtype == torch.float32 and model.weight.dtype == torch.float32
    assert "the network: float16 gives NaN or infinity" in caplog.text
    assert "runs in float32" in caplog.text
    _, dtype = in_best_precision(linear(1.0), CPU, torch.bfloat16, squared_norm, "the network")
    assert dtype == torch.bfloat16


def test_a_large_error_and_an_unsupported_operation_fall_back(caplog) -> None:
    def unstable(model, dtype):
        return torch.full((3,), 1.0 if dtype == torch.float32 else 1.2)

    def unsupported(model, dtype):
        if dtype != torch.float32:
            raise RuntimeError('"kernel" not implemented for Half')
        return torch.ones(3)

    for run, words in ((unstable, "a relative error of 20.0%"), (unsupported, "not supported")):
        _, dtype = in_best_precision(linear(1.0), CPU, torch.float16, run, "the network")
        assert dtype == torch.float32 and words in caplog.text


def test_single_precision_is_not_compared() -> None:
    def fails(model, dtype):
        raise AssertionError("must not run")

    assert in_best_precision(linear(1.0), CPU, torch.float32, fails, "it")[1] == torch.float32


class Device:
    """Stands in for a GPU, of which only the type is read."""

    type = "cuda"


@pytest.mark.parametrize("native", [True, False])
def test_sam_prefers_bfloat16_where_the_device_has_it(monkeypatch, native) -> None:
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: native)
    assert choose_dtype(Device()) == torch.float16
    expected = torch.bfloat16 if native else torch.float16
    assert choose_dtype(Device(), wide_range=True) == expected
    assert choose_dtype(CPU, wide_range=True) == torch.float32


@pytest.mark.parametrize(
    ("family", "save"), [(Sam2Segmenter, save_sam2), (Sam3Segmenter, save_sam3)]
)
def test_sam_in_bfloat16_gives_nearly_the_masks_of_float32(
    tmp_path, monkeypatch, family, save
) -> None:
    config = settings(segmenter_path=str(save(tmp_path)))
    boxes = np.array([[5.0, 5, 30, 40], [20, 10, 70, 50]])
    exact = family(config)._masks(image(60, 80), boxes)
    monkeypatch.setattr(sam, "choose_dtype", lambda device, **_: torch.bfloat16)
    reduced = family(config)
    assert reduced.dtype == torch.bfloat16
    assert (reduced._masks(image(60, 80), boxes) != exact).mean() < 0.05


def test_a_segmenter_that_overflows_runs_in_single_precision(tmp_path, monkeypatch, caplog) -> None:
    config = settings(segmenter_path=str(save_sam2(tmp_path)))
    monkeypatch.setattr(sam, "choose_dtype", lambda device, **_: torch.float16)
    logits = Sam2Segmenter._test_logits

    def overflowing(self, model, dtype):
        return logits(self, model, dtype) * (1.0 if dtype == torch.float32 else float("inf"))

    monkeypatch.setattr(Sam2Segmenter, "_test_logits", overflowing)
    segmenter = Sam2Segmenter(config)
    assert segmenter.dtype == torch.float32
    assert next(segmenter.model.parameters()).dtype == torch.float32
    assert "the segmenter: float16 gives NaN" in caplog.text


def test_a_backbone_in_half_precision_gives_nearly_its_features(tmp_path, monkeypatch) -> None:
    config = config_of("vjepa2", save_vjepa2(tmp_path))
    exact = clip_models.load_vjepa2(config).encode([clip()])
    monkeypatch.setattr(clip_models, "choose_dtype", lambda device: torch.float16)
    reduced = clip_models.load_vjepa2(config)
    assert reduced.dtype == torch.float16
    found = reduced.encode([clip()])
    assert np.linalg.norm(found - exact) < 0.02 * np.linalg.norm(exact)


def test_nan_in_features_is_counted_by_name(tmp_path, monkeypatch) -> None:
    from deworldsg_ros.relations.stage import ClipEncoder

    config = config_of("vjepa2", save_vjepa2(tmp_path / "model"))
    identity = clip_models.load_vjepa2(config).identity
    probe = save_random_probe(tmp_path / "probe", identity)
    config = config_of("vjepa2", tmp_path / "model", probe_path=str(probe))
    model = build_probed(config, clip_models.load_vjepa2, "cpu")
    broken = lambda videos: torch.full((1, identity.feature_dim), float("nan"))  # noqa: E731
    object.__setattr__(model._backbone, "features", broken)
    with pytest.raises(RefusedInput, match="48 of 48 values of a feature of vjepa2 are NaN"):
        model.predict(request())
    reports: list[str] = []
    encoder = ClipEncoder(model, reports.append)
    monkeypatch.setattr("deworldsg_ros.relations.stage.clip_request", lambda *_: request())
    assert encoder.encode(None, []) is None
    assert encoder.failure == "nan_features"
    assert "are NaN or infinite in float32" in reports[0]


def test_nan_of_a_detector_is_an_error_and_not_an_empty_image(tmp_path) -> None:
    detector = RtDetrDetector(settings(detector_path=str(save_rtdetr(tmp_path))))
    with torch.no_grad():
        for head in detector.model.model.decoder.class_embed:
            head.bias.fill_(float("nan"))
    with pytest.raises(RefusedInput, match="the class logits are NaN") as refused:
        detector.detect(image(), 0.1)
    assert refused.value.reason == "detector_error"


def test_finite_values_pass() -> None:
    require_finite(torch.ones(3), "nan_features", "a feature")
    assert torch.equal(loading.noise_pattern(4, 4), loading.noise_pattern(4, 4))
