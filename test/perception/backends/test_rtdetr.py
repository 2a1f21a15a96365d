"""RT-DETR and RT-DETRv2: scores, boxes, preprocessing, layers, and checkpoints that are refused."""

import json
import shutil

import numpy as np
import pytest
from support import torch_models as models
from support.torch_models import image, settings, torch

from deworldsg_ros.checkpoints import cards
from deworldsg_ros.checkpoints.cards import DETECTOR_CARD, CheckpointCard
from deworldsg_ros.perception.backends.rtdetr import RtDetrDetector
from deworldsg_ros.scene.errors import ConfigurationError

pytestmark = pytest.mark.models

SOFTMAX = CheckpointCard(class_scores="softmax")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("rtdetr")
    return {
        "v1": models.save_rtdetr(root / "v1", 1),
        "v2": models.save_rtdetr(root / "v2", 2),
        "softmax": models.save_rtdetr(root / "softmax", 1, card=SOFTMAX, normalise=True),
    }


def detector(folder, **changes):
    return RtDetrDetector(settings(detector_path=str(folder), **changes))


@pytest.fixture
def copy(folders, tmp_path):
    """A copy of a checkpoint that a test may change."""
    return shutil.copytree(folders["v1"], tmp_path / "copy")


def with_card(folder, **fields):
    cards.write_detector_card(folder / DETECTOR_CARD, CheckpointCard(**fields))
    return folder


def reference(rgb, *, normalise=False, version=1):
    """Logits and boxes of the network that was saved, by a loop over its own modules."""
    model = models.random_rtdetr(version)
    pixels = torch.from_numpy(rgb.astype(np.float32)).permute(2, 0, 1)[None]
    pixels = torch.nn.functional.interpolate(
        pixels, size=(64, 64), mode="bilinear", antialias=True, align_corners=False
    )
    pixels = pixels / 255
    if normalise:
        mean, std = (torch.tensor(models.IMAGENET[key])[:, None, None] for key in models.IMAGENET)
        pixels = (pixels - mean) / std
    with torch.no_grad():
        return model(pixels)


@pytest.mark.parametrize("version", [1, 2])
def test_all_detections_equal_the_queries_of_the_network(folders, version):
    rgb = image(48, 96)
    found = detector(folders[f"v{version}"]).detect(rgb, 0.0)
    output = reference(rgb, version=version)
    scores = output.logits[0].sigmoid().amax(-1)
    order = torch.argsort(scores, descending=True, stable=True)
    assert len(found) == models.QUERIES
    # float32: two resizers and two orders of sums, which differ from processor to processor.
    assert np.allclose(found.scores, scores[order].double(), atol=5e-5)
    cx, cy, w, h = output.pred_boxes[0][order].double().unbind(-1)
    corners = torch.stack([(cx - w / 2) * 96, (cy - h / 2) * 48, (cx + w / 2) * 96], -1) - 0.5
    assert np.allclose(found.boxes_xyxy[:, :3], corners, atol=1e-3)
    # The spread that makes this a test.
    assert np.ptp(found.scores) > 0.05 and np.ptp(found.boxes_xyxy[:, 0]) > 5


def test_softmax_scores_are_the_distributions_maxima(folders):
    found = detector(folders["softmax"]).detect(image(), 0.0)
    output = reference(image(), normalise=True)
    expected = output.logits[0].softmax(-1).amax(-1).sort(descending=True).values
    assert np.allclose(found.scores, expected, atol=1e-5)
    assert np.allclose(found.scores, found.class_probabilities.max(axis=1), atol=1e-6)


def test_temperature_sharpens_the_class_distributions_of_eq_5_and_keeps_the_scores(folders, copy):
    plain = detector(folders["v1"]).detect(image(), 0.0)
    sharp = detector(with_card(copy, temperature=0.25)).detect(image(), 0.0)
    p, q = plain.class_probabilities, sharp.class_probabilities
    assert np.allclose([p.sum(axis=1), q.sum(axis=1)], 1, atol=1e-12)
    assert np.array_equal(sharp.scores, plain.scores)
    assert np.array_equal(q.argmax(axis=1), p.argmax(axis=1))
    assert (q.max(axis=1) >= p.max(axis=1)).all()


def test_threshold_keeps_the_best_in_order(folders, copy):
    found = detector(folders["v1"])
    every = found.detect(image(), 0.0)
    threshold = float(np.median(every.scores))
    kept = found.detect(image(), threshold)
    assert 0 < len(kept) < len(every)
    assert np.array_equal(kept.scores, every.scores[every.scores >= threshold])
    assert found.detect(image(), 1.0).class_probabilities.shape == (0, len(models.CLASSES))
    # The default is that of the card or of the kind of scores.
    assert found.default_score_threshold == 0.5
    assert detector(folders["softmax"]).default_score_threshold == 0.7
    own = with_card(copy, class_scores="softmax", score_threshold=0.3)
    assert detector(own).default_score_threshold == 0.3


@pytest.mark.parametrize("layers", [1, 3])
def test_fewer_decoder_layers_give_the_intermediate_output(copy, layers):
    found = detector(with_card(copy, decoder_layers=layers)).detect(image(), 0.0)
    inner = reference(image()).intermediate_logits[0, layers - 1].sigmoid().amax(-1)
    assert np.allclose(found.scores, inner.sort(descending=True).values, atol=1e-5)


def test_queries_are_recorded_only_on_request(folders):
    watched = detector(folders["v1"])
    assert watched.detect(image(), 0.0).features is None
    for _ in range(2):
        watched.record_queries()
    found = watched.detect(image(), 0.0)
    assert found.features.shape == (models.QUERIES, 2 * models.LAYERS + 1, models.WIDTH)
    assert found.features.dtype == np.float32
    # The last slot is what the class head reads.
    head = models.random_rtdetr().model.decoder.class_embed[-1]
    scores = head(torch.from_numpy(found.features[:, -1])).sigmoid().amax(-1)
    assert np.allclose(scores.detach(), found.scores, atol=1e-5)
    kept = found.take(np.array([3, 1]))
    assert np.array_equal(kept.features, found.features[[3, 1]])


def test_other_images_and_half_precision_run_through(folders):
    found = detector(folders["v1"])
    exact = found.detect(image(), 0.0)
    read_only = image(120, 160)
    read_only.flags.writeable = False
    for rgb in (read_only, image(33, 47)):
        assert len(found.detect(rgb, 0.0)) == models.QUERIES
    found.model, found.dtype = found.model.half(), torch.float16
    assert np.allclose(found.detect(image(), 0.0).scores, exact.scores, atol=0.05)


def refused(match, folder, **changes):
    with pytest.raises(ConfigurationError, match=match):
        detector(folder, **changes)


def test_a_missing_or_foreign_checkpoint_is_refused(tmp_path):
    refused("detector_path is empty", "")
    refused("no such folder", "/no/such/folder")
    refused("hf download nobody/nothing-of-that-name", "nobody/nothing-of-that-name")
    refused("sam: expected rt_detr or rt_detr_v2", models.save_sam(tmp_path))


def test_missing_and_damaged_files_are_refused(copy):
    from safetensors.torch import load_file, save_file

    refused(r"deworldsg\.json is 9, .* 4", with_card(copy, decoder_layers=9))
    (copy / DETECTOR_CARD).write_text('{"class_scores": "argmax"}')
    refused(r"deworldsg\.json: .*argmax", copy)
    (copy / DETECTOR_CARD).unlink()
    assert cards.read_detector_card(None) == CheckpointCard()
    preprocessing = copy / "preprocessor_config.json"
    text = preprocessing.read_text()
    wrong = {**json.loads(text), "do_normalize": True, "image_mean": [0.5]}
    preprocessing.write_text(json.dumps(wrong))
    refused(r"preprocessor_config\.json: ", copy)
    preprocessing.write_text(text)
    model = copy / "model.safetensors"
    weights = load_file(model)
    gone = next(name for name in weights if name.endswith("enc_score_head.weight"))
    del weights[gone]
    save_file(weights, model, metadata={"format": "pt"})
    refused(r"lacks 1 parameters .*enc_score_head\.weight", copy)
    model.write_bytes(b"no tensors")
    refused("cannot be loaded", copy)
    model.unlink()
    refused("cannot be loaded", copy)


def test_unnamed_and_miscounted_classes_are_refused(tmp_path):
    nameless = models.save_rtdetr(tmp_path / "a", labels=[f"LABEL_{i}" for i in range(3)])
    refused("does not name its 3 classes", nameless)
    short = models.save_rtdetr(tmp_path / "b", card=CheckpointCard(classes=("bed",)))
    refused("names 1 classes, .* 6", short)


def test_missing_cuda_and_memory_are_refused_with_a_remedy(folders, monkeypatch):
    def full(*arguments):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    refused("perception.device is 'cuda'", folders["v1"], device="cuda")
    monkeypatch.setattr(RtDetrDetector, "_forward", full)
    refused("out of memory .* smaller perception.detector_p", folders["v1"])
