"""RT-DETR and RT-DETRv2: scores, boxes, preprocessing, layers, and checkpoints that are refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.torch_models import (
    CLASSES,
    IMAGENET,
    LAYERS,
    QUERIES,
    WIDTH,
    image,
    random_rtdetr,
    save_rtdetr,
    settings,
    torch,
)

from deworldsg_ros.checkpoints.cards import (
    DETECTOR_CARD,
    CheckpointCard,
    read_detector_card,
    write_detector_card,
)
from deworldsg_ros.perception.backends.rtdetr import RtDetrDetector
from deworldsg_ros.scene.errors import ConfigurationError

pytestmark = pytest.mark.models

SOFTMAX = CheckpointCard(class_scores="softmax")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("rtdetr")
    return {
        "v1": save_rtdetr(root / "v1", 1),
        "v2": save_rtdetr(root / "v2", 2),
        "softmax": save_rtdetr(root / "softmax", 1, card=SOFTMAX, normalise=True),
    }


def detector(folder, **changes):
    return RtDetrDetector(settings(detector_path=str(folder), **changes))


def with_card(folder, tmp_path, **fields):
    """A copy of a checkpoint with another card."""
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    write_detector_card(copy / DETECTOR_CARD, CheckpointCard(**fields))
    return copy


def reference(folder, rgb, *, normalise=False, version=1):
    """Logits and boxes of the network that was saved, by a loop over its own modules."""
    model = random_rtdetr(version)
    pixels = torch.from_numpy(rgb.astype(np.float32)).permute(2, 0, 1)[None]
    pixels = torch.nn.functional.interpolate(
        pixels, size=(64, 64), mode="bilinear", antialias=True, align_corners=False
    )
    pixels = pixels / 255
    if normalise:
        mean, std = (torch.tensor(IMAGENET[key])[:, None, None] for key in IMAGENET)
        pixels = (pixels - mean) / std
    with torch.no_grad():
        return model(pixels)


@pytest.mark.parametrize("version", [1, 2])
def test_all_detections_equal_the_queries_of_the_network(folders, version):
    rgb = image(48, 96)
    found = detector(folders[f"v{version}"]).detect(rgb, 0.0)
    output = reference(folders, rgb, version=version)
    scores = output.logits[0].sigmoid().amax(-1)
    order = torch.argsort(scores, descending=True, stable=True)
    assert len(found) == QUERIES
    # float32: two resizers and two orders of sums, which differ from processor to processor.
    assert np.allclose(found.scores, scores[order].double(), atol=5e-5)
    cx, cy, w, h = output.pred_boxes[0][order].double().unbind(-1)
    corners = torch.stack([(cx - w / 2) * 96, (cy - h / 2) * 48, (cx + w / 2) * 96], -1) - 0.5
    assert np.allclose(found.boxes_xyxy[:, :3], corners, atol=1e-3)
    # The spread that makes this a test.
    assert np.ptp(found.scores) > 0.05 and np.ptp(found.boxes_xyxy[:, 0]) > 5


def test_softmax_scores_are_the_distributions_maxima(folders):
    rgb = image()
    found = detector(folders["softmax"]).detect(rgb, 0.0)
    output = reference(folders, rgb, normalise=True)
    expected = output.logits[0].softmax(-1).amax(-1).sort(descending=True).values
    assert np.allclose(found.scores, expected, atol=1e-5)
    assert np.allclose(found.scores, found.class_probabilities.max(axis=1), atol=1e-6)


def test_temperature_sharpens_the_class_distributions_of_eq_5_and_keeps_the_scores(
    folders, tmp_path
):
    sharp = detector(with_card(folders["v1"], tmp_path, temperature=0.25)).detect(image(), 0.0)
    plain = detector(folders["v1"]).detect(image(), 0.0)
    for found in (sharp, plain):
        assert np.allclose(found.class_probabilities.sum(axis=1), 1, atol=1e-12)
    assert np.array_equal(sharp.scores, plain.scores)
    assert np.array_equal(
        sharp.class_probabilities.argmax(axis=1), plain.class_probabilities.argmax(axis=1)
    )
    assert (sharp.class_probabilities.max(1) >= plain.class_probabilities.max(1)).all()


def test_threshold_keeps_the_best_in_order(folders):
    every = detector(folders["v1"]).detect(image(), 0.0)
    threshold = float(np.median(every.scores))
    kept = detector(folders["v1"]).detect(image(), threshold)
    assert 0 < len(kept) < len(every)
    assert np.array_equal(kept.scores, every.scores[every.scores >= threshold])
    none = detector(folders["v1"]).detect(image(), 1.0)
    assert len(none) == 0 and none.class_probabilities.shape == (0, len(CLASSES))


@pytest.mark.parametrize("layers", [1, 3])
def test_fewer_decoder_layers_give_the_intermediate_output(folders, tmp_path, layers):
    rgb = image()
    folder = with_card(folders["v1"], tmp_path, decoder_layers=layers)
    found = detector(folder).detect(rgb, 0.0)
    inner = reference(folders, rgb).intermediate_logits[0, layers - 1].sigmoid().amax(-1)
    assert np.allclose(found.scores, inner.sort(descending=True).values, atol=1e-5)


@pytest.mark.parametrize(
    ("card", "threshold"),
    [
        ({}, 0.5),
        ({"class_scores": "sigmoid"}, 0.5),
        ({"class_scores": "softmax"}, 0.7),
        ({"class_scores": "softmax", "score_threshold": 0.3}, 0.3),
    ],
)
def test_default_threshold_is_that_of_the_card_or_the_kind_of_scores(
    folders, tmp_path, card, threshold
):
    folder = with_card(folders["v1"], tmp_path, **card)
    assert detector(folder).default_score_threshold == threshold


def test_queries_are_recorded_only_on_request(folders):
    watched = detector(folders["v1"])
    assert watched.detect(image(), 0.0).features is None
    watched.record_queries()
    watched.record_queries()
    found = watched.detect(image(), 0.0)
    assert found.features.shape == (QUERIES, 2 * LAYERS + 1, WIDTH)
    assert found.features.dtype == np.float32
    # The last slot is what the class head reads.
    head = random_rtdetr().model.decoder.class_embed[-1]
    scores = head(torch.from_numpy(found.features[:, -1])).sigmoid().amax(-1)
    assert np.allclose(scores.detach(), found.scores, atol=1e-5)
    kept = found.take(np.array([3, 1]))
    assert np.array_equal(kept.features, found.features[[3, 1]])


def test_read_only_images_and_other_image_sizes_work(folders):
    found = detector(folders["v1"])
    rgb = image(120, 160)
    rgb.flags.writeable = False
    assert len(found.detect(rgb, 0.0)) == QUERIES
    assert len(found.detect(image(33, 47), 0.0)) == QUERIES


def test_half_precision_runs_through(folders):
    found = detector(folders["v1"])
    exact = found.detect(image(), 0.0)
    found.model, found.dtype = found.model.half(), torch.float16
    assert np.allclose(found.detect(image(), 0.0).scores, exact.scores, atol=0.05)


def test_a_checkpoint_of_another_architecture_is_refused(tmp_path):
    from support.torch_models import save_sam

    with pytest.raises(
        ConfigurationError, match="is a checkpoint of sam: expected rt_detr or rt_detr_v2"
    ):
        detector(save_sam(tmp_path))


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("", "detector_path is empty: set it to the folder or hub id"),
        ("/no/such/folder", "there is no such folder; expected a folder with config.json"),
        ("nobody/nothing-of-that-name", "run `hf download nobody/nothing-of-that-name`, or name a"),
    ],
)
def test_a_missing_checkpoint_is_refused(path, message):
    with pytest.raises(ConfigurationError, match=message):
        detector(path)


def test_missing_and_damaged_weights_are_refused(folders, tmp_path):
    (tmp_path / "config.json").write_bytes((folders["v1"] / "config.json").read_bytes())
    with pytest.raises(ConfigurationError, match="cannot be loaded"):
        detector(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"no tensors")
    with pytest.raises(ConfigurationError, match="cannot be loaded"):
        detector(tmp_path)


def test_missing_parameters_are_named(folders, tmp_path):
    from safetensors.torch import load_file, save_file

    for name in ("config.json", "preprocessor_config.json"):
        (tmp_path / name).write_bytes((folders["v1"] / name).read_bytes())
    weights = load_file(folders["v1"] / "model.safetensors")
    gone = next(name for name in weights if name.endswith("enc_score_head.weight"))
    del weights[gone]
    save_file(weights, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(ConfigurationError, match="lacks 1 parameters .*enc_score_head.weight"):
        detector(tmp_path)


def test_missing_cuda_is_refused(folders, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigurationError, match="perception.device is 'cuda' .*'auto' or 'cpu'"):
        detector(folders["v1"], device="cuda")


def test_out_of_memory_at_start_up_names_a_remedy(folders, monkeypatch):
    def full(*arguments):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB")

    monkeypatch.setattr(RtDetrDetector, "_forward", full)
    with pytest.raises(ConfigurationError, match="out of memory .* smaller perception.detector_p"):
        detector(folders["v1"])


def test_more_decoder_layers_than_the_network_has_are_refused(folders, tmp_path):
    message = "decoder_layers in deworldsg.json is 9, expected at most the 4 of the network"
    with pytest.raises(ConfigurationError, match=message):
        detector(with_card(folders["v1"], tmp_path, decoder_layers=9))


def test_unnamed_and_miscounted_classes_are_refused(tmp_path):
    nameless = save_rtdetr(tmp_path / "a", labels=[f"LABEL_{i}" for i in range(3)])
    with pytest.raises(ConfigurationError, match="does not name its 3 classes"):
        detector(nameless)
    short = save_rtdetr(tmp_path / "b", card=CheckpointCard(classes=("bed",)))
    with pytest.raises(ConfigurationError, match="names 1 classes, expected one for each of its 6"):
        detector(short)


def test_damaged_cards_and_preprocessing_are_refused(folders, tmp_path):
    card = tmp_path / "deworldsg.json"
    card.write_text('{"class_scores": "argmax"}')
    with pytest.raises(ConfigurationError, match="deworldsg.json: .*argmax"):
        read_detector_card(card)
    assert read_detector_card(None) == CheckpointCard()
    for name in ("config.json", "model.safetensors"):
        (tmp_path / name).write_bytes((folders["v1"] / name).read_bytes())
    card.unlink()
    wrong = {"size": {"height": 64, "width": 64}, "do_normalize": True, "image_mean": [0.5]}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(wrong))
    with pytest.raises(ConfigurationError, match="preprocessor_config.json: "):
        detector(tmp_path)
