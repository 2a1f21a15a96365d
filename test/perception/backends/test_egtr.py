"""The EGTR relation head: parity with the naive head, ranking, and checkpoints that are refused."""

import msgspec
import numpy as np
import pytest
from support import torch_models as models
from support.torch_models import image, settings, torch

from deworldsg_ros.checkpoints import cards
from deworldsg_ros.checkpoints.cards import DETECTOR_CARD, CheckpointCard
from deworldsg_ros.checkpoints.egtr_network import EgtrNetwork
from deworldsg_ros.perception import build_perception
from deworldsg_ros.perception.backends.rtdetr import EgtrRelationHead, RtDetrDetector, best_pairs
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError

pytestmark = pytest.mark.models


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
@pytest.mark.parametrize("used", [1, models.LAYERS - 1, models.LAYERS])
@torch.no_grad()
def test_relations_of_kept_queries_equal_those_of_all_queries(used, bias):
    network = models.random_head().double()
    generator = torch.Generator().manual_seed(used)
    features = torch.randn(40, 2 * used + 1, models.WIDTH, generator=generator, dtype=torch.float64)
    classes = torch.randint(0, len(models.CLASSES), (40,), generator=generator)
    relations, connectivity = naive(network, features, classes if bias else None)
    kept = torch.tensor([31, 2, 17, 5, 0, 39])
    found = network(features[kept], classes[kept] if bias else None)
    assert torch.allclose(found[0], relations[kept][:, kept], atol=1e-9, rtol=0)
    assert torch.allclose(found[1], connectivity[kept][:, kept], atol=1e-9, rtol=0)
    # A head that ignored its input would pass all of that.
    assert relations.std() > 0.1 and connectivity.std() > 0.01


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return models.save_paper_checkpoint(tmp_path_factory.mktemp("paper"))


@torch.no_grad()
def test_the_backend_over_the_detector_equals_the_naive_head_in_float32(folder):
    detector = RtDetrDetector(settings(detector_path=str(folder)))
    head = EgtrRelationHead(settings(predicate_set="checkpoint"), detector)
    every = detector.detect(image(), 0.0)
    classes = every.class_probabilities.argmax(axis=1)
    features = torch.from_numpy(every.features)
    relations, connectivity = naive(models.random_head(), features, torch.from_numpy(classes))

    def relate(kept, top):
        names = [models.CLASSES[c] for c in kept.class_probabilities.argmax(axis=1)]
        return head.relate(models.segmented(names, kept.scores, kept.features), top)

    kept = every.take(np.arange(0, models.QUERIES, 4))
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
        assert relate(every.take(slice(count)), 10).logits.shape == (0, len(models.PREDICATES))
    assert sorted(relate(every.take(slice(2)), 10).pairs.tolist()) == [[0, 1], [1, 0]]
    with pytest.raises(ValueError, match="without query features"):
        head.relate(models.segmented(models.CLASSES[:2], every.scores[:2]), 5)


def test_ranking_leaves_out_self_pairs_even_where_all_scores_are_zero():
    logits = np.zeros((3, 3, 2))
    found = best_pairs(logits, np.zeros((3, 3)), np.ones(3), 100)
    assert len(found.pairs) == 6 and (found.pairs[:, 0] != found.pairs[:, 1]).all()
    ranks = np.array([[1.0, 0.2, 0.3], [0.9, 1.0, 0.1], [0.3, 0.4, 1.0]])
    found = best_pairs(logits, ranks, np.array([1.0, 0.5, 1.0]), 3)
    assert found.pairs.tolist() == [[1, 0], [0, 2], [2, 0]]
    assert found.scores.tolist() == [0.45, 0.3, 0.3]


def build(folder, world_up="auto", **changes):
    names = {"detector": "rtdetr", "relation_head": "egtr", "predicate_set": "checkpoint"}
    config = settings(**{**names, "detector_path": str(folder), **changes})
    return build_perception(config, world_up=world_up)


def test_rtdetr_sam2_and_egtr_as_one_stage(folder, tmp_path):
    # Random weights put their boxes anywhere: they are not refined.
    limits = {"score_threshold": 0.0, "max_relations": 10, "refine_detections": False}
    segmenter = {"segmenter": "sam2", "segmenter_path": str(models.save_sam2(tmp_path))}
    perception = build(folder, "z", **segmenter, **limits)
    depth_m = np.full((48, 64), 1.5, np.float32)
    frame = RgbdFrame(1, image(), depth_m, Intrinsics(60.0, 60.0, 31.5, 23.5, 64, 48), np.eye(4))
    seen, again = perception.perceive(frame), perception.perceive(frame)
    assert perception.vocabulary.classes == models.CLASSES
    assert perception.vocabulary.predicates == models.PREDICATES
    count = len(seen.frame_graph)
    assert 2 <= count <= models.QUERIES
    assert len(seen.frame_graph.relations.pairs) == min(10, count * (count - 1))
    assert not seen.drops.keys() & {"segmenter_error", "relation_head_error"}
    assert np.array_equal(again.instances, seen.instances)
    assert np.array_equal(again.frame_graph.relations.logits, seen.frame_graph.relations.logits)


def refused(match, folder, **changes):
    with pytest.raises(ConfigurationError, match=match):
        build(folder, **changes)


def test_a_detector_or_label_set_that_does_not_fit_is_refused(folder, tmp_path):
    refused("'rtdetr'", "", detector="nanodet")
    refused("no egtr_head.safetensors", models.save_rtdetr(tmp_path / "headless"))
    refused("'3dssg'", folder, predicate_set="3dssg")
    refused(
        "has 4 classes.* 7", models.save_paper_checkpoint(tmp_path / "a", labels=models.CLASSES[:4])
    )
    counted = models.save_paper_checkpoint(tmp_path / "b", {"predicates": ("on",)})
    refused("deworldsg.json of .* names 1 predicates", counted)
    deeper = models.save_paper_checkpoint(tmp_path / "c", decoder_layers=models.LAYERS + 1)
    refused("has 5 layers of 32 .* 4 layers of 32", deeper)
    # The head accepts a detector with fewer layers.
    card = cards.read_detector_card(deeper / DETECTOR_CARD)
    cards.write_detector_card(
        deeper / DETECTOR_CARD, msgspec.structs.replace(card, decoder_layers=3)
    )
    build(deeper)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"proj_q.1.weight": None}, r"missing \(proj_q.1.weight\)"),
        ({"rel_predictor.layers.2.weight": None}, r"missing \(rel_predictor.layers.2.weight\)"),
        ({"proj_v.0.weight": torch.zeros(2)}, r"unknown \(proj_v.0.weight\)"),
        ({"rel_predictor_gate.bias": torch.zeros(2)}, "size mismatch for rel_predictor_gate.bias"),
        ({"triplet_dist": torch.zeros(2, 2)}, r"triplet_dist has shape \(2, 2\)"),
    ],
)
def test_a_head_with_other_parameters_is_refused_by_name(change, message):
    parameters = {**models.random_head().state_dict(), **change}
    parameters = {name: value for name, value in parameters.items() if value is not None}
    with pytest.raises(ConfigurationError, match=message):
        EgtrNetwork.for_parameters(parameters, "head.safetensors")


def test_a_head_file_that_is_damaged_or_incomplete_is_refused(tmp_path):
    from safetensors.torch import save_file

    models.save_rtdetr(
        tmp_path, card=CheckpointCard(predicates=models.PREDICATES, frequency_bias=True)
    )
    head = tmp_path / "egtr_head.safetensors"
    head.write_bytes(b"damaged")
    refused(r"egtr_head\.safetensors cannot be read", tmp_path)
    parameters = models.random_head().state_dict()
    del parameters["triplet_dist"], parameters["rel_dist"]
    save_file(parameters, head)
    refused("no class-pair statistics .* `frequency_bias`", tmp_path)
