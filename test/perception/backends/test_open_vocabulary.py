"""Detectors of free text: parity with transformers' post-processing, and words that change."""

from importlib import import_module

import numpy as np
import pytest
from support.torch_models import image, settings, torch, transformers

pytest.importorskip("tokenizers")

from support.text_models import WORDS, save_text_network

from deworldsg_ros.perception import build_perception
from deworldsg_ros.perception.backends.open_vocabulary import OpenVocabularyDetector
from deworldsg_ros.scene.errors import ConfigurationError

pytestmark = pytest.mark.models
FAMILIES = ("owlv2", "grounding_dino", "omdet_turbo", "sam3")
SIZE = [(48, 96)]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("text")
    return {name: save_text_network(root / name, name) for name in FAMILIES}


def detector(folder, words=WORDS):
    return OpenVocabularyDetector(settings(detector_path=str(folder), words=words))


def owlv2(network, tokenizer, pixels):
    processor = transformers.Owlv2Processor(transformers.Owlv2ImageProcessorPil(), tokenizer)
    texts = [[f"a photo of a {word}" for word in WORDS]]
    prompt = processor(text=texts, return_tensors="pt")
    output = network(pixel_values=pixels, **prompt)
    (found,) = processor.post_process_grounded_object_detection(output, -1.0, target_sizes=SIZE)
    return found["boxes"], found["scores"], found["labels"]


def grounding_dino(network, tokenizer, pixels):
    images = transformers.GroundingDinoImageProcessorPil()
    processor = transformers.GroundingDinoProcessor(images, tokenizer)
    prompt = tokenizer(processor._preprocess_input_text(list(WORDS)), return_tensors="pt")
    ids = prompt["input_ids"]
    output = network(pixel_values=pixels, **prompt)
    # A trained network never finds what separates words.
    separators = torch.isin(ids[0], torch.tensor([101, 102, 1012]))
    output.logits[..., : len(separators)][..., separators] = -torch.inf
    (found,) = processor.post_process_grounded_object_detection(
        output, ids, threshold=-1.0, target_sizes=SIZE
    )
    word_of_token = [0, 0, 0, 1, 1, 0, 2, 0, 3, 0, 0]  # [CLS] mug . red mug . drill . sofa . [SEP]
    best = output.logits[0].argmax(dim=1).tolist()
    return found["boxes"], found["scores"], torch.tensor([word_of_token[token] for token in best])


def omdet_turbo(network, tokenizer, pixels):
    # Only its suppression needs torchvision, which the whole module seems to.
    processing = import_module("transformers.models.omdet_turbo.processing_omdet_turbo")
    options = {"padding": "max_length", "truncation": True, "max_length": 77}
    texts = {"classes": list(WORDS), "tasks": [f"Detect {', '.join(WORDS)}."]}
    made = {key: tokenizer(text, return_tensors="pt", **options) for key, text in texts.items()}
    prompt = {
        f"{key}_{name}": made[key][name] for key in made for name in ("input_ids", "attention_mask")
    }
    output = network(pixel_values=pixels, classes_structure=torch.tensor([len(WORDS)]), **prompt)
    boxes, logits = output.decoder_coord_logits[0], output.decoder_class_logits
    (scores,), labels = processing.compute_score(logits)
    processing.batched_nms = lambda boxes, *rest: torch.arange(len(boxes))
    options = {"threshold": -1.0, "nms_threshold": 1.0, "max_num_det": scores.numel()}
    found = processing._post_process_boxes_for_image(
        boxes, scores, labels, len(WORDS), SIZE[0], **options
    )
    order = found[1].argsort(descending=True)
    return _first_of_each_box(*(part[order] for part in found))


def _first_of_each_box(boxes, scores, labels):
    first = {}
    for row, box in enumerate(boxes.tolist()):
        first.setdefault(tuple(box), row)
    rows = list(first.values())
    return boxes[rows], scores[rows], labels[rows]


@pytest.mark.parametrize("reference", [owlv2, grounding_dino, omdet_turbo])
@torch.no_grad()
def test_all_candidates_equal_the_post_processing_of_transformers(folders, reference):
    folder = folders[reference.__name__]
    family = transformers.AutoModelForZeroShotObjectDetection
    network, rgb = detector(folder).network, image(48, 96)
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder)
    boxes, scores, labels = reference(
        family.from_pretrained(folder).eval(), tokenizer, network.pixels(rgb)
    )
    found = network.find(rgb, network.encode(WORDS), 0.0)
    order = np.argsort(-found.scores.max(axis=1), kind="stable")
    expected = scores.argsort(descending=True, stable=True)
    assert len(found.scores) == len(scores) > 8
    assert np.allclose(found.scores.max(axis=1)[order], scores[expected], atol=1e-4)
    assert found.scores.argmax(axis=1)[order].tolist() == labels[expected].tolist()
    clipped = found.boxes_xyxy[order] + 0.5
    if reference is omdet_turbo:  # which cuts boxes at the image
        clipped = np.clip(clipped, 0, [96, 48, 96, 48])
    assert np.allclose(clipped, boxes[expected], atol=1e-3)
    assert np.ptp(found.scores) > 0.01 and np.ptp(found.boxes_xyxy[:, 0]) > 2
    # The text is encoded once: a second image gives its own result.
    other = image(48, 96, seed=1)
    again, _, _ = reference(family.from_pretrained(folder).eval(), tokenizer, network.pixels(other))
    found = network.find(other, network.encode(WORDS), 0.0)
    assert len(again) == len(found.scores)
    assert not np.allclose(again.sum(), boxes.sum(), atol=1e-3)


@torch.no_grad()
def test_concepts_of_sam3_equal_those_of_the_network(folders):
    network, rgb = detector(folders["sam3"]).network, image(48, 96)
    model = transformers.Sam3Model.from_pretrained(folders["sam3"]).eval()
    tokenizer = transformers.AutoTokenizer.from_pretrained(folders["sam3"])
    found = network.find(rgb, network.encode(WORDS), 0.0)
    rows = iter(range(len(found.scores)))
    for column, word in enumerate(WORDS):
        text = tokenizer(word, padding="max_length", max_length=32, return_tensors="pt")
        ids, mask = text["input_ids"], text["attention_mask"]
        output = model(pixel_values=network.pixels(rgb), input_ids=ids, attention_mask=mask)
        scores = output.pred_logits[0].sigmoid() * output.presence_logits[0].sigmoid()
        masks = torch.nn.functional.interpolate(
            output.pred_masks.sigmoid(), size=(48, 96), mode="bilinear", align_corners=False
        )
        for score, box, mask in zip(scores, output.pred_boxes[0], masks[0] > 0.5):
            row = next(rows)
            assert np.isclose(found.scores[row, column], score, atol=1e-4)
            assert found.scores[row].sum() == found.scores[row, column]
            corners = box.numpy() * [96, 48, 96, 48]
            assert np.allclose(found.boxes_xyxy[row] + 0.5, corners, atol=1e-3)
            whole = np.zeros((48, 96), bool)
            whole[found.masks[row].window] = found.masks[row].pixels
            assert np.array_equal(whole, mask.numpy())
    assert next(rows, None) is None
    # Only what reaches the threshold becomes a mask of an image.
    least = float(np.median(found.scores[found.scores > 0]))
    some = network.find(rgb, network.encode(WORDS), least)
    assert 0 < len(some.scores) == len(some.masks) < len(found.scores)
    assert detector(folders["sam3"]).detect(rgb, 0.0).masks is not None


@pytest.mark.parametrize("family", FAMILIES)
def test_words_change_and_columns_stay(folders, family):
    made, rgb = detector(folders[family], ("mug", "sofa")), image(48, 96)
    first = made.detect(rgb, 0.0)
    assert first.classes == made.classes == ("mug", "sofa")
    made.use_words(("drill", "sofa"))
    found = made.detect(rgb, 0.0)
    assert found.classes == ("mug", "sofa", "drill")
    assert (found.class_probabilities[:, 0] == 0).all()
    assert np.allclose(found.class_probabilities.sum(axis=1), 1)
    # They are the distributions of these words alone.
    fresh = detector(folders[family], ("drill", "sofa")).detect(rgb, 0.0)
    assert np.allclose(found.class_probabilities[:, [2, 1]], fresh.class_probabilities)
    made.use_words(("mug", "sofa"))
    assert np.allclose(made.detect(rgb, 0.0).class_probabilities[:, :2], first.class_probabilities)
    for words, message in (
        ((), "is empty: name what"),
        (("mug", "mug"), "names 'mug' twice"),
        (("mug", "cup\x1b[2J"), "control character"),
        (("mug", "a " * 100), "tokens, expected at most"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            made.use_words(words)
    assert made.detect(rgb, 0.0).classes == ("mug", "sofa", "drill")


def test_perception_takes_the_detectors_words_and_masks(folders):
    names = {"detector": "open_vocabulary", "detector_path": str(folders["sam3"])}
    perception = build_perception(settings(**names, words=("mug", "sofa"), score_threshold=0.0))
    changed = settings(**names, words=("sofa", "drill"), score_threshold=0.0)
    perception.configure(changed)
    with pytest.raises(ConfigurationError, match="is empty"):
        perception.configure(settings(**names))
    assert perception._detector.classes == ("mug", "sofa", "drill")
    # Loaded again after a failure, it has the same columns.
    again = build_perception(changed)
    perception.vocabulary = again.vocabulary.__class__(("mug", "sofa", "drill"), ())
    again.take_over(perception, changed)
    assert again._detector.classes == ("mug", "sofa", "drill")
    with pytest.raises(ConfigurationError, match="needs a detector of free text"):
        build_perception(settings(words=("mug",)))
    with pytest.raises(ConfigurationError, match="expected grounding-dino or mm-grounding-dino"):
        (folders["sam3"].parent / "other").mkdir()
        other = folders["sam3"].parent / "other"
        transformers.RTDetrConfig().save_pretrained(other)
        detector(other)
