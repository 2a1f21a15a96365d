"""RT-DETR, RT-DETRv2 and EGTR: parity with the networks, and checkpoints that are refused."""

import json
import shutil

import msgspec
import numpy as np
import pytest
from support import torch_models as models
from support.torch_models import (
    CLASSES,
    LAYERS,
    PREDICATES,
    QUERIES,
    image,
    settings,
    torch,
    transformers,
)

from deworldsg_ros.checkpoints import cards
from deworldsg_ros.checkpoints.cards import DETECTOR_CARD, CheckpointCard
from deworldsg_ros.checkpoints.egtr_network import EgtrNetwork
from deworldsg_ros.perception import build_perception
from deworldsg_ros.perception.backends.closed_set import ClosedSetDetector, EgtrRelationHead
from deworldsg_ros.scene.errors import ConfigurationError

pytestmark = pytest.mark.models


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("rtdetr")
    softmax = CheckpointCard(class_scores="softmax")
    return {
        "v1": models.save_rtdetr(root / "v1", 1),
        "v2": models.save_rtdetr(root / "v2", 2),
        "softmax": models.save_rtdetr(root / "softmax", 1, card=softmax, normalise=True),
        "paper": models.save_paper_checkpoint(root / "paper"),
    }


def detector(folder, **changes):
    return ClosedSetDetector(settings(detector_path=str(folder), **changes))


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
    rgb.flags.writeable = False
    found = detector(folders[f"v{version}"]).detect(rgb, 0.0)
    output = reference(rgb, version=version)
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


PROCESSORS = {
    "d_fine": "RTDetr",
    "detr": "Detr",
    "yolos": "Yolos",
    "deformable_detr": "DeformableDetr",
}


@pytest.mark.parametrize("family", ["d_fine", "detr", "yolos", "deformable_detr", "rf_detr"])
def test_a_detector_equals_the_post_processing_of_transformers(tmp_path, family):
    rgb, is_dfine = image(48, 96), family == "d_fine"
    model = models.save_dfine(tmp_path) if is_dfine else models.save_closed_set(tmp_path, family)
    size = (64, 64) if family in ("d_fine", "rf_detr") else (50, 100)
    pixels = torch.from_numpy(rgb.astype(np.float32) / 255).permute(2, 0, 1)[None]
    pixels = torch.nn.functional.interpolate(
        pixels, size=size, mode="bilinear", antialias=True, align_corners=False
    )
    if not is_dfine:
        mean, std = (torch.tensor(models.IMAGENET[key])[:, None, None] for key in models.IMAGENET)
        pixels = (pixels - mean) / std
    with torch.no_grad():
        output = model(pixels)
    queries, least = output.logits.shape[1], 1e-6
    if family not in ("detr", "yolos"):
        # It lists a query once for each class, and as many as there are queries.
        least = float(output.logits.sigmoid().flatten().sort(descending=True).values[queries - 1])
    processor = f"{PROCESSORS.get(family, 'DeformableDetr')}ImageProcessorPil"
    process = getattr(transformers, processor)().post_process_object_detection
    options = {"top_k": queries} if "Deformable" in processor else {}
    (expected,) = process(output, threshold=least - 1e-6, target_sizes=[(48, 96)], **options)
    best: dict[tuple, tuple] = {}
    for box, score, label in zip(
        *(expected[key].tolist() for key in ("boxes", "scores", "labels"))
    ):
        best[tuple(box)] = max(best.get(tuple(box), (0.0, 0)), (score, label))
    ranked = sorted(best.items(), key=lambda item: -item[1][0])
    made = detector(tmp_path)
    found = made.detect(rgb, least - 1e-6)
    assert made.classes == CLASSES and 3 < len(found) == len(ranked)
    labels = [label - (not is_dfine) for _, (_, label) in ranked]
    assert found.class_probabilities.argmax(axis=1).tolist() == labels
    assert np.allclose(found.class_probabilities.sum(axis=1), 1)
    assert np.ptp(found.scores) > 1e-3  # the spread that makes this a test
    assert np.allclose(found.scores, [score for _, (score, _) in ranked], atol=1e-4)
    assert np.allclose(found.boxes_xyxy + 0.5, [box for box, _ in ranked], atol=1e-3)


def test_softmax_scores_are_the_distributions_maxima(folders):
    found = detector(folders["softmax"]).detect(image(), 0.0)
    output = reference(image(), normalise=True)
    expected = output.logits[0].softmax(-1).amax(-1).sort(descending=True).values
    assert np.allclose(found.scores, expected, atol=1e-5)
    assert np.allclose(found.scores, found.class_probabilities.max(axis=1), atol=1e-6)


def test_temperature_sharpens_the_distributions_and_the_threshold_keeps_the_best(folders, copy):
    found = detector(folders["v1"])
    every = found.detect(image(), 0.0)
    assert every.features is None  # without a relation head
    sharp = detector(with_card(copy, temperature=0.25)).detect(image(), 0.0)
    p, q = every.class_probabilities, sharp.class_probabilities
    assert np.allclose([p.sum(axis=1), q.sum(axis=1)], 1, atol=1e-12)
    assert np.array_equal(sharp.scores, every.scores)
    assert np.array_equal(q.argmax(axis=1), p.argmax(axis=1))
    assert (q.max(axis=1) >= p.max(axis=1)).all()
    threshold = float(np.median(every.scores))
    kept = found.detect(image(), threshold)
    assert 0 < len(kept) < len(every)
    assert np.array_equal(kept.scores, every.scores[every.scores >= threshold])
    assert found.detect(image(), 1.0).class_probabilities.shape == (0, len(CLASSES))
    # The default is that of the card or of the kind of scores.
    assert found.default_score_threshold == 0.5
    assert detector(folders["softmax"]).default_score_threshold == 0.7


@pytest.mark.parametrize("layers", [1, 3])
def test_fewer_decoder_layers_give_the_intermediate_output(copy, layers):
    found = detector(with_card(copy, decoder_layers=layers)).detect(image(), 0.0)
    inner = reference(image()).intermediate_logits[0, layers - 1].sigmoid().amax(-1)
    assert np.allclose(found.scores, inner.sort(descending=True).values, atol=1e-5)


def naive(network, features, classes=None):
    """The head as it is printed: every pair's sources side by side, all of them at once."""
    layers = (features.shape[1] - 1) // 2
    count = len(features)
    sources = []
    for slot in range(layers + 1):
        last = slot == layers
        make_q = network.final_sub_proj if last else network.proj_q[slot]
        make_k = network.final_obj_proj if last else network.proj_k[slot]
        q = make_q(features[:, -1 if last else slot])
        k = make_k(features[:, -1 if last else layers + slot])
        pair = torch.cat([q[:, None].expand(-1, count, -1), k[None].expand(count, -1, -1)], -1)
        sources.append(pair)
    sources = torch.stack(sources, dim=2)
    gates = torch.sigmoid(network.rel_predictor_gate(sources))
    pairs = (gates * sources).sum(dim=2)

    def perceptron(part):
        first, second, last = part.layers
        return last(torch.relu(second(torch.relu(first(pairs)))))

    relations = perceptron(network.rel_predictor)
    if classes is not None:
        for i, subject in enumerate(classes):
            for j, target in enumerate(classes):
                relations[i, j] += network.triplet_dist[subject, target]
    return relations, perceptron(network.connectivity_layer)[..., 0]


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("used", [1, LAYERS - 1, LAYERS])
@torch.no_grad()
def test_relations_of_kept_queries_equal_those_of_all_queries(used, bias):
    network = models.random_head().double()
    generator = torch.Generator().manual_seed(used)
    features = torch.randn(40, 2 * used + 1, models.WIDTH, generator=generator, dtype=torch.float64)
    classes = torch.randint(0, len(CLASSES), (40,), generator=generator)
    relations, connectivity = naive(network, features, classes if bias else None)
    kept = torch.tensor([31, 2, 17, 5, 0, 39])
    found = network(features[kept], classes[kept] if bias else None)
    assert torch.allclose(found[0], relations[kept][:, kept], atol=1e-9, rtol=0)
    assert torch.allclose(found[1], connectivity[kept][:, kept], atol=1e-9, rtol=0)
    # A head that ignored its input would pass all of that.
    assert relations.std() > 0.1 and connectivity.std() > 0.01


@torch.no_grad()
def test_the_backend_over_the_detector_equals_the_naive_head_in_float32(folders):
    found_by = detector(folders["paper"])
    head = EgtrRelationHead(settings(predicate_set="checkpoint"), found_by)
    every = found_by.detect(image(), 0.0)
    assert every.features.shape == (QUERIES, 2 * LAYERS + 1, models.WIDTH)
    # The last slot is what the class head reads.
    logits = found_by.model.model.decoder.class_embed[-1](torch.from_numpy(every.features[:, -1]))
    assert np.allclose(logits.softmax(-1).amax(-1), every.scores, atol=1e-5)
    classes = every.class_probabilities.argmax(axis=1)
    features = torch.from_numpy(every.features)
    relations, connectivity = naive(models.random_head(), features, torch.from_numpy(classes))

    def relate(kept, top):
        names = [CLASSES[c] for c in kept.class_probabilities.argmax(axis=1)]
        return head.relate(models.segmented(names, kept.scores, kept.features), top)

    kept = every.take(np.arange(0, QUERIES, 4))
    top = len(kept) * (len(kept) - 1)
    found = relate(kept, top)
    assert len(found.pairs) == top and len(set(map(tuple, found.pairs.tolist()))) == top
    subjects, objects = 4 * found.pairs.T
    # float32: logits reach 20, and the order of the sums differs from processor to processor.
    expected = relations[subjects, objects].numpy()
    assert np.allclose(found.logits, expected, rtol=1e-5, atol=5e-5)
    ranks = (relations.sigmoid().amax(-1) * connectivity.sigmoid())[subjects, objects].numpy()
    expected = ranks * every.scores[subjects] * every.scores[objects]
    assert np.abs(found.scores - expected).max() < 1e-6
    assert (np.diff(found.scores) <= 0).all()
    assert np.array_equal(relate(kept, 3).pairs, found.pairs[:3])
    # Few objects, and no features.
    for count in (0, 1):
        assert relate(every.take(slice(count)), 10).logits.shape == (0, len(PREDICATES))
    assert sorted(relate(every.take(slice(2)), 10).pairs.tolist()) == [[0, 1], [1, 0]]
    with pytest.raises(ValueError, match="without query features"):
        head.relate(models.segmented(CLASSES[:2], every.scores[:2]), 5)


def stage(folder, world_up="auto", **changes):
    names = {"detector": "rtdetr", "relation_head": "egtr", "predicate_set": "checkpoint"}
    config = settings(**{**names, "detector_path": str(folder), **changes})
    return build_perception(config, world_up=world_up)


def refused(match, build, *arguments, **changes):
    with pytest.raises(ConfigurationError, match=match):
        build(*arguments, **changes)


def test_a_checkpoint_that_does_not_fit_is_refused(folders, tmp_path, monkeypatch):
    refused("detector_path is empty", detector, "")
    refused("no such folder", detector, "/no/such/folder")
    refused("hf download nobody/nothing", detector, "nobody/nothing")
    refused("sam: expected conditional_detr or d_fine", detector, models.save_sam(tmp_path / "sam"))
    nameless = models.save_rtdetr(tmp_path / "a", labels=[f"LABEL_{i}" for i in range(3)])
    refused("does not name its 3 classes", detector, nameless)
    short = models.save_rtdetr(tmp_path / "b", card=CheckpointCard(classes=("bed",)))
    refused("names 1 classes, .* 6", detector, short)

    def full(*arguments):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    refused("perception.device is 'cuda'", detector, folders["v1"], device="cuda")
    monkeypatch.setattr(ClosedSetDetector, "_forward", full)
    refused("out of memory .* smaller perception.detector_p", detector, folders["v1"])


def test_missing_and_damaged_files_are_refused(copy):
    from safetensors.torch import load_file, save_file

    refused(r"deworldsg\.json is 9, .* 4", detector, with_card(copy, decoder_layers=9))
    (copy / DETECTOR_CARD).write_text('{"class_scores": "argmax"}')
    refused(r"deworldsg\.json: .*argmax", detector, copy)
    (copy / DETECTOR_CARD).unlink()
    assert cards.read_detector_card(None) == CheckpointCard()
    preprocessing = copy / "preprocessor_config.json"
    text = preprocessing.read_text()
    preprocessing.unlink()
    detector(copy)  # with the default values
    wrong = {**json.loads(text), "do_normalize": True, "image_mean": [0.5]}
    preprocessing.write_text(json.dumps(wrong))
    refused(r"preprocessor_config\.json: ", detector, copy)
    preprocessing.write_text(text)
    model = copy / "model.safetensors"
    weights = load_file(model)
    gone = next(name for name in weights if name.endswith("enc_score_head.weight"))
    del weights[gone]
    save_file(weights, model, metadata={"format": "pt"})
    refused(r"lacks 1 parameters .*enc_score_head\.weight", detector, copy)
    model.write_bytes(b"no tensors")
    refused("cannot be loaded", detector, copy)
    model.unlink()
    refused("cannot be loaded", detector, copy)


def test_a_relation_head_that_does_not_fit_is_refused(folders, copy, tmp_path):
    from safetensors.torch import save_file

    refused("'rtdetr'", stage, "", detector="nanodet")
    refused("no egtr_head.safetensors", stage, folders["v1"])
    refused("'3dssg'", stage, folders["paper"], predicate_set="3dssg")
    fewer = models.save_paper_checkpoint(tmp_path / "a", labels=CLASSES[:4])
    refused("has 4 classes.* 7", stage, fewer)
    counted = models.save_paper_checkpoint(tmp_path / "b", {"predicates": ("on",)})
    refused("deworldsg.json of .* names 1 predicates", stage, counted)
    deeper = models.save_paper_checkpoint(tmp_path / "c", decoder_layers=LAYERS + 1)
    refused("has 5 layers of 32 .* 4 layers of 32", stage, deeper)
    # The head accepts a detector with fewer layers.
    card = cards.read_detector_card(deeper / DETECTOR_CARD)
    card = msgspec.structs.replace(card, decoder_layers=3)
    cards.write_detector_card(deeper / DETECTOR_CARD, card)
    stage(deeper)
    with_card(copy, predicates=PREDICATES, frequency_bias=True)
    (copy / "egtr_head.safetensors").write_bytes(b"damaged")
    refused(r"egtr_head\.safetensors cannot be read", stage, copy)
    parameters = models.random_head().state_dict()
    del parameters["triplet_dist"], parameters["rel_dist"]
    save_file(parameters, copy / "egtr_head.safetensors")
    refused("no class-pair statistics .* `frequency_bias`", stage, copy)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rel_predictor.layers.2.weight", None, r"missing \(rel_predictor.layers.2.weight\)"),
        ("proj_v.0.weight", torch.zeros(2), r"unknown \(proj_v.0.weight\)"),
        ("rel_predictor_gate.bias", torch.zeros(2), "size mismatch for rel_predictor_gate.bias"),
        ("triplet_dist", torch.zeros(2, 2), r"triplet_dist has shape \(2, 2\)"),
    ],
)
def test_a_head_with_other_parameters_is_refused_by_name(name, value, message):
    parameters = {**models.random_head().state_dict(), name: value}
    parameters = {name: value for name, value in parameters.items() if value is not None}
    refused(message, EgtrNetwork.for_parameters, parameters, "head.safetensors")
