"""Exported detectors: without torch, and equal to torch."""

import base64
import json

import cv2
import numpy as np
import pytest
from support.cli import DEMO_ROOM, invoke, printed, refusal

from deworldsg_ros.checkpoints.cards import ONNX_CARD
from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception import build_perception
from deworldsg_ros.perception.backends.onnx_detector import OnnxDetector, network_input
from deworldsg_ros.scene.errors import ConfigurationError

# One query: its logits are the means of the input's channels, its box is the lower half's middle.
NETWORK = base64.b64decode(
    "CAgSADqHAgokCgxwaXhlbF92YWx1ZXMSAW0iEUdsb2JhbEF2ZXJhZ2VQb29sChcKAW0KAXMSBmxvZ2l0cyIHUmVz"
    "aGFwZQoZCgFjEgpwcmVkX2JveGVzIghJZGVudGl0eRIBZyohCAMQB0IBc0oYAQAAAAAAAAABAAAAAAAAAAMAAAAA"
    "AAAAKh0IAQgBCAQQAUIBY0oQAAAAPwAAAD8AAAA/AACAPlomCgxwaXhlbF92YWx1ZXMSFgoUCAESEAoCCAEKAggD"
    "CgIICAoCCAhiHAoGbG9naXRzEhIKEAgBEgwKAggBCgIIAQoCCANiIAoKcHJlZF9ib3hlcxISChAIARIMCgIIAQoC"
    "CAEKAggEQgQKABAN"
)
CARD = {
    **{"classes": ["red", "blue"], "columns": [0, 2], "height": 8, "width": 8},
    **{"mean": [0.0, 0.0, 0.0], "std": [0.1, 0.1, 0.1], "class_scores": "sigmoid"},
    **{"no_object": False, "temperature": 1.0, "score_threshold": 0.4},
    **{"schema": "deworldsg/onnx_detector", "version": 1},
}


def save(folder, network=NETWORK, **changes):
    folder.mkdir(exist_ok=True)
    (folder / "model.onnx").write_bytes(network)
    (folder / ONNX_CARD).write_text(json.dumps({**CARD, **changes}))
    return PerceptionConfig(detector="onnx", detector_path=str(folder))


def test_a_network_is_read_as_its_card_says(tmp_path):
    rgb = np.zeros((48, 96, 3), np.uint8)
    rgb[..., 0], rgb[..., 2] = 51, 25.5  # logits 2 and 1 after the division by 0.1
    made = build_perception(save(tmp_path))._detector
    assert made.classes == ("red", "blue") and made.default_score_threshold == 0.4
    found = made.detect(rgb, 0.5)
    assert np.allclose(found.boxes_xyxy + 0.5, [[24, 18, 72, 30]])
    assert np.allclose(found.scores, 1 / (1 + np.exp(-2)), atol=1e-6)
    blue = 25 / 51 * 2  # 8 bits cut the half
    assert np.allclose(found.class_probabilities[0, 1], 1 / (1 + np.exp(2 - blue)), atol=1e-6)
    assert len(made.detect(rgb, 0.9)) == 0
    softmax = OnnxDetector(save(tmp_path, class_scores="softmax")).detect(rgb, 0.0)
    assert np.allclose(softmax.scores, softmax.class_probabilities.max())
    # With an output for "no object", which has the logit of green.
    changed = {"columns": [0], "classes": ["red"], "no_object": True}
    found = OnnxDetector(save(tmp_path, **changed)).detect(rgb, 0.0)
    logits = np.exp([2, 0, blue])
    assert np.allclose(found.scores, logits[0] / logits.sum(), atol=1e-6)


def test_an_image_is_stretched_as_opencv_and_torch_do(tmp_path):
    card = OnnxDetector(save(tmp_path, height=8, width=8, std=[1.0] * 3)).card
    rng = np.random.default_rng(0)
    small = rng.integers(0, 256, (5, 6, 3)).astype(np.uint8)
    larger = cv2.resize(small.astype(np.float32) / 255, (8, 8), interpolation=cv2.INTER_LINEAR)
    assert np.allclose(network_input(small, card)[0].transpose(1, 2, 0), larger, atol=1e-5)
    # Halved, a triangle of four pixels: the inner of one row are an eighth and three eighths.
    wide = rng.integers(0, 256, (8, 16, 3)).astype(np.uint8)
    values = wide[3, 3:7].astype(float).T @ [0.125, 0.375, 0.375, 0.125] / 255
    assert np.allclose(network_input(wide, card)[0, :, 3, 2], values, atol=1e-6)


@pytest.mark.parametrize(
    ("network", "changes", "says"),
    [
        (NETWORK, {"columns": [0, 3]}, "expected at least 4 columns"),
        (NETWORK, {"columns": [0]}, "2 classes and 1 columns"),
        (NETWORK, {"height": 16}, "cannot be run"),
        (NETWORK, {"temperature": 0}, "temperature"),
        (NETWORK, {"colour": "red"}, "colour"),
        (NETWORK[:100], {}, "cannot be run"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, network, changes, says):
    with pytest.raises(ConfigurationError, match="has no model.onnx"):
        OnnxDetector(PerceptionConfig(detector="onnx", detector_path=str(tmp_path)))
    with pytest.raises(ConfigurationError, match=says):
        OnnxDetector(save(tmp_path, network, **changes))


@pytest.mark.models
@pytest.mark.timeout(300)
@pytest.mark.parametrize("family", ["d_fine", "rf_detr"])
def test_an_export_equals_torch(tmp_path, family):
    pytest.importorskip("onnxscript")
    from support import torch_models as models

    from deworldsg_ros.perception.backends.closed_set import ClosedSetDetector

    folder = tmp_path / "model"
    folder.mkdir()
    models.save_dfine(folder) if family == "d_fine" else models.save_closed_set(folder, family)
    shown = printed("models", "export", folder, tmp_path / "out")
    assert "6 classes" in shown and "perception.detector=onnx" in shown
    on_torch = ClosedSetDetector(models.settings(detector_path=str(folder)))
    exported = OnnxDetector(PerceptionConfig(detector_path=str(tmp_path / "out")))
    assert exported.classes == on_torch.classes
    rgb = models.image(100, 150)
    expected, found = on_torch.detect(rgb, 0.0), exported.detect(rgb, 0.0)
    assert np.allclose(found.scores, expected.scores, atol=1e-3)
    assert np.allclose(found.class_probabilities, expected.class_probabilities, atol=1e-3)
    assert np.allclose(found.boxes_xyxy, expected.boxes_xyxy, atol=1e-3 * 150)
    if family == "d_fine":
        measured = printed("models", "measure", tmp_path / "out", DEMO_ROOM)
        assert measured.count(" of 61") == 2  # the embedded one, too
        return
    shown = printed("models", "export", folder, tmp_path / "int8", "--int8", DEMO_ROOM)
    assert "8 bits in its convolutions" in shown
    small = OnnxDetector(PerceptionConfig(detector_path=str(tmp_path / "int8")))
    size = (tmp_path / "int8" / "model.onnx").stat().st_size
    assert size < 0.5 * (tmp_path / "out" / "model.onnx").stat().st_size
    difference = np.abs(small.detect(rgb, 0.0).scores - expected.scores)
    assert 0 < difference.mean() < 0.1


@pytest.mark.models
def test_what_cannot_be_exported_is_named(tmp_path):
    pytest.importorskip("onnxscript")
    from support import torch_models as models

    models.save_closed_set(tmp_path, "yolos")
    refused = refusal("models", "export", tmp_path, tmp_path / "out")
    assert "takes images of any size" in refused and not (tmp_path / "out").exists()
    assert invoke("models", "export", "no/such", tmp_path / "out").exit_code == 2
