"""The EGTR relation head: parity with the naive head, ranking, and checkpoints that are refused."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from support.torch_models import (
    CLASSES,
    LAYERS,
    PREDICATES,
    QUERIES,
    WIDTH,
    image,
    random_head,
    save_paper_checkpoint,
    save_rtdetr,
    save_sam2,
    segmented,
    settings,
    torch,
)

from deworldsg_ros.checkpoints.cards import (
    DETECTOR_CARD,
    CheckpointCard,
    read_detector_card,
    write_detector_card,
)
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
@pytest.mark.parametrize("used", [1, LAYERS - 1, LAYERS])
@torch.no_grad()
def test_relations_of_kept_queries_equal_those_of_all_queries(used, bias):
    network = random_head().double()
    generator = torch.Generator().manual_seed(used)
    features = torch.randn(40, 2 * used + 1, WIDTH, generator=generator, dtype=torch.float64)
    classes = torch.randint(0, len(CLASSES), (40,), generator=generator)
    relations, connectivity = naive(network, features, classes if bias else None)
    kept = torch.tensor([31, 2, 17, 5, 0, 39])
    found = network(features[kept], classes[kept] if bias else None)
    assert torch.allclose(found[0], relations[kept][:, kept], atol=1e-9, rtol=0)
    assert torch.allclose(found[1], connectivity[kept][:, kept], atol=1e-9, rtol=0)
    # A head that ignored its input would pass all of that.
    assert relations.std() > 0.1 and connectivity.std() > 0.01


@torch.no_grad()
def test_the_backend_over_the_detector_equals_the_naive_head_in_float32(folder):
    config = settings(detector_path=str(folder))
    detector = RtDetrDetector(config)
    head = EgtrRelationHead(settings(predicate_set="checkpoint"), detector)
    every = detector.detect(image(), 0.0)
    classes = torch.from_numpy(every.class_probabilities.argmax(axis=1))
    relations, connectivity = naive(random_head(), torch.from_numpy(every.features), classes)
    kept = every.take(np.arange(0, QUERIES, 4))
    names = [CLASSES[c] for c in kept.class_probabilities.argmax(axis=1)]
    count = len(kept)
    top = count * (count - 1)
    found = relate(head, kept, names, top)
    assert len(found.pairs) == top and len(set(map(tuple, found.pairs.tolist()))) == top
    subjects, objects = 4 * found.pairs.T
    # float32: logits reach 20, and the order of the sums differs from processor to processor.
    assert np.allclose(found.logits, relations[subjects, objects].numpy(), rtol=1e-5, atol=5e-5)
    ranks = (relations.sigmoid().amax(-1) * connectivity.sigmoid())[subjects, objects].numpy()
    expected = ranks * every.scores[subjects] * every.scores[objects]
    assert np.abs(found.scores - expected).max() < 1e-6
    assert (np.diff(found.scores) <= 0).all()
    best = relate(head, kept, names, 3)
    assert np.array_equal(best.pairs, found.pairs[:3])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return save_paper_checkpoint(tmp_path_factory.mktemp("paper"))


def relate(head, found, names, top):
    return head.relate(segmented(names, found.scores, found.features), top)


def test_few_objects_and_no_features(folder):
    detector = RtDetrDetector(settings(detector_path=str(folder)))
    head = EgtrRelationHead(settings(predicate_set="checkpoint"), detector)
    found = detector.detect(image(), 0.0)
    names = [CLASSES[c] for c in found.class_probabilities.argmax(axis=1)]
    for count in (0, 1):
        few = found.take(slice(count))
        assert relate(head, few, names[:count], 10).logits.shape == (0, len(PREDICATES))
    two = relate(head, found.take(slice(2)), names[:2], 10)
    assert sorted(two.pairs.tolist()) == [[0, 1], [1, 0]]
    with pytest.raises(ValueError, match="without query features"):
        head.relate(segmented(names, found.scores), 5)


def test_ranking_leaves_out_self_pairs_even_where_all_scores_are_zero():
    logits = np.zeros((3, 3, 2))
    found = best_pairs(logits, np.zeros((3, 3)), np.ones(3), 100)
    assert len(found.pairs) == 6 and (found.pairs[:, 0] != found.pairs[:, 1]).all()
    ranks = np.array([[1.0, 0.2, 0.3], [0.9, 1.0, 0.1], [0.3, 0.4, 1.0]])
    found = best_pairs(logits, ranks, np.array([1.0, 0.5, 1.0]), 3)
    assert found.pairs.tolist() == [[1, 0], [0, 2], [2, 0]]
    assert found.scores.tolist() == [0.45, 0.3, 0.3]


def test_rtdetr_sam2_and_egtr_as_one_stage(folder, tmp_path):
    config = settings(
        detector="rtdetr",
        segmenter="sam2",
        relation_head="egtr",
        detector_path=str(folder),
        segmenter_path=str(save_sam2(tmp_path)),
        predicate_set="checkpoint",
        score_threshold=0.0,
        max_relations=10,
        # Random weights put their boxes anywhere.
        refine_detections=False,
    )
    perception = build_perception(config, world_up="z")
    depth_m = np.full((48, 64), 1.5, np.float32)
    intrinsics = Intrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)
    frame = RgbdFrame(1, image(), depth_m, intrinsics, np.eye(4))
    seen = perception.perceive(frame)
    assert perception.vocabulary.classes == CLASSES
    assert perception.vocabulary.predicates == PREDICATES
    assert 2 <= len(seen.frame_graph) <= QUERIES and "segmenter_error" not in seen.drops
    assert len(seen.frame_graph.relations.pairs) == min(
        10, len(seen.frame_graph) * (len(seen.frame_graph) - 1)
    )
    assert "relation_head_error" not in seen.drops
    again = perception.perceive(frame)
    assert np.array_equal(again.instances, seen.instances)
    assert np.array_equal(again.frame_graph.relations.logits, seen.frame_graph.relations.logits)


def build(folder, **changes):
    config = settings(
        **{"detector": "rtdetr", "detector_path": str(folder), "relation_head": "egtr", **changes}
    )
    return build_perception(config)


def test_another_detector_is_refused():
    with pytest.raises(ConfigurationError, match="reads the queries of the detector 'rtdetr'"):
        build("", detector="nanodet")


def test_a_checkpoint_without_head_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="has no egtr_head.safetensors: make it from"):
        build(save_rtdetr(tmp_path))


def test_another_label_set_is_refused(folder, tmp_path):
    with pytest.raises(ConfigurationError, match="predicate_set is '3dssg'.* set it to 'check"):
        build(folder, predicate_set="3dssg")
    other = save_paper_checkpoint(tmp_path / "a", labels=CLASSES[:4])
    with pytest.raises(ConfigurationError, match="has 4 classes, but .* trained on 7"):
        build(other, predicate_set="checkpoint")
    counted = save_paper_checkpoint(tmp_path / "b", {"predicates": ("on",)})
    with pytest.raises(ConfigurationError, match="deworldsg.json of .* names 1 predicates, exp"):
        build(counted, predicate_set="checkpoint")


def test_another_decoder_is_refused(tmp_path):
    deeper = save_paper_checkpoint(tmp_path, decoder_layers=LAYERS + 1)
    with pytest.raises(ConfigurationError, match="has 5 layers of 32 .* reads 4 layers of 32"):
        build(deeper, predicate_set="checkpoint")
    # The head accepts a detector with fewer layers.
    card = read_detector_card(deeper / DETECTOR_CARD)
    write_detector_card(deeper / DETECTOR_CARD, msgspec.structs.replace(card, decoder_layers=3))
    build(deeper, predicate_set="checkpoint")


def test_missing_class_pair_statistics_are_refused(tmp_path):
    from safetensors.torch import load_file, save_file

    save_paper_checkpoint(tmp_path)
    path = tmp_path / "egtr_head.safetensors"
    parameters = load_file(path)
    del parameters["triplet_dist"], parameters["rel_dist"]
    save_file(parameters, path)
    with pytest.raises(ConfigurationError, match="no class-pair statistics .* `frequency_bias`"):
        build(tmp_path, predicate_set="checkpoint")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"proj_q.1.weight": None}, r"1 missing \(proj_q.1.weight\)"),
        ({"rel_predictor.layers.2.weight": None}, r"1 missing \(rel_predictor.layers.2.weight\)"),
        ({"proj_v.0.weight": torch.zeros(2)}, r"1 unknown \(proj_v.0.weight\)"),
        ({"rel_predictor_gate.bias": torch.zeros(2)}, "size mismatch for rel_predictor_gate.bias"),
        ({"triplet_dist": torch.zeros(2, 2)}, r"triplet_dist has shape \(2, 2\)"),
    ],
)
def test_a_head_with_other_parameters_is_refused_by_name(change, message):
    parameters = {**random_head().state_dict(), **change}
    parameters = {name: value for name, value in parameters.items() if value is not None}
    with pytest.raises(ConfigurationError, match=message):
        EgtrNetwork.for_parameters(parameters, "head.safetensors")


def test_a_damaged_head_file_is_refused(folder, tmp_path):
    save_rtdetr(tmp_path, card=CheckpointCard(predicates=PREDICATES))
    (tmp_path / "egtr_head.safetensors").write_bytes(b"damaged")
    with pytest.raises(ConfigurationError, match=r"egtr_head.safetensors cannot be read \(.*get"):
        build(tmp_path, predicate_set="checkpoint")
