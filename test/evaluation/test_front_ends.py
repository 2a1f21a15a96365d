"""Front ends that are replayed or made: what they hand to lifting, and their seeded faults."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.perception import box_of
from support.sequences import BLOCKS, ROWS, instance_image, write_room

from deworldsg_ros.config import Config, PerceptionConfig
from deworldsg_ros.evaluation.front_ends import (
    Faults,
    FrontEndChoice,
    build_front_end,
    parse_faults,
)
from deworldsg_ros.evaluation.injection import (
    Detection,
    FrameDetections,
    FrameFaults,
    Injection,
    Relation,
    spread,
)
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError, EvaluationError
from deworldsg_ros.scene.frame_graph import Vocabulary

BOXES = np.array([[left, ROWS[0], right - 1, ROWS[1] - 1] for _, _, left, right in BLOCKS])


def perceived(root, choice, config=Config()):
    recording = open_recording(root / "data" / "room_0")
    annotations = Annotations(root, "replica")
    front_end = build_front_end(choice, annotations, "room_0", recording.source, config)
    return [front_end.perceive(frame) for frame in recording.frames()]


def classes_of(perceived):
    return perceived.frame_graph.class_probabilities.argmax(axis=1).tolist()


def test_recorded(tmp_path):
    root = write_room(tmp_path)
    seen = perceived(root, FrontEndChoice("recorded"))
    assert len(seen) == 3
    graph, instances = seen[0].frame_graph, seen[0].instances
    # Best score first: the blocks in reverse.
    np.testing.assert_allclose(graph.scores, [0.9, 0.85, 0.8])
    assert classes_of(seen[0]) == [0, 2, 1]
    np.testing.assert_allclose(graph.class_probabilities[0], [0.9, 0.05, 0.05])
    assert graph.boxes_xyxy.tolist() == BOXES[::-1].tolist()
    for row, (object_id, _, _, _) in enumerate(reversed(BLOCKS)):
        assert ((instances == row + 1) == (instance_image() == object_id)).all()
    # Relations best first, between rows; logits of stated and spread probabilities.
    assert graph.relations.pairs.tolist() == [[0, 1], [2, 1]]
    expected = np.log(np.array([9, 0.05 / 0.95, 0.05 / 0.95]))
    np.testing.assert_allclose(graph.relations.logits[1], expected)
    assert classes_of(perceived(root, FrontEndChoice("recorded", flip=0.1))[0]) == [2, 0, 1]
    with pytest.raises(EvaluationError, match="expected 0, 0.1"):
        perceived(root, FrontEndChoice("recorded", flip=0.2))
    path = root / "data/room_0/sequence/frame-000001.frontend.json"
    content = json.loads(path.read_text())
    for bad in ({**content, "version": 2}, {**content, "detections": [{}]}, []):
        path.write_text(json.dumps(bad))
        with pytest.raises(EvaluationError, match=r"frame-000001\.frontend\.json"):
            perceived(root, FrontEndChoice("recorded"))


@pytest.mark.parametrize("with_images", [True, False])
def test_perfect_ground_truth(tmp_path, with_images):
    root = write_room(tmp_path)
    if not with_images:
        for path in (root / "data/room_0/sequence").glob("*.instance.png"):
            path.unlink()
    first = perceived(root, FrontEndChoice("ground-truth"))[0]
    graph = first.frame_graph
    assert classes_of(first) == [1, 2, 0]
    # Without instance images every other pixel is looked at.
    np.testing.assert_allclose(graph.boxes_xyxy, BOXES, atol=0 if with_images else 1)
    for row, (object_id, _, _, _) in enumerate(BLOCKS):
        agree = (first.instances == row + 1) == (instance_image() == object_id)
        assert agree.mean() > (0.999 if with_images else 0.97)
    best = dict(zip(map(tuple, graph.relations.pairs.tolist()), graph.relations.logits.argmax(1)))
    assert best == {(0, 1): 0, (2, 1): 1}


def test_boxes_are_true_and_masks_are_those_of_the_segmenter(tmp_path):
    root = write_room(tmp_path)
    first = perceived(root, FrontEndChoice("boxes", jitter_px=0))[0]
    graph = first.frame_graph
    assert graph.vocabulary.classes == ("book", "chair", "table")
    assert classes_of(first) == [1, 2, 0]
    np.testing.assert_allclose(graph.class_probabilities.max(axis=1), 0.9)
    np.testing.assert_allclose(graph.scores, 0.9)
    assert graph.boxes_xyxy.tolist() == BOXES.tolist()
    for row, (object_id, _, _, _) in enumerate(BLOCKS):
        mask, true = first.instances == row + 1, instance_image() == object_id
        # The depth separates block and background, but a segmenter is not exact.
        assert (mask & true).sum() / (mask | true).sum() > 0.6
    # The images, not the annotation, decide about relations: the blocks float side by side.
    best = graph.relations.logits.argmax(axis=1)
    assert len(best) and "on" not in {graph.vocabulary.predicates[index] for index in best}
    egtr = Config(perception=PerceptionConfig(relation_head="egtr"))
    with pytest.raises(EvaluationError, match=r"perception\.relation_head"):
        perceived(root, FrontEndChoice("boxes"), egtr)


@pytest.mark.parametrize("kind", ["ground-truth", "boxes"])
def test_faults_of_single_frames(tmp_path, kind):
    root = write_room(tmp_path, frames=12)
    assert not any(len(item.frame_graph) for item in perceived(root, FrontEndChoice(kind, miss=1)))
    for item in perceived(root, FrontEndChoice(kind, flip=1.0)):
        assert np.not_equal(classes_of(item), [1, 2, 0]).all()
    false = perceived(root, FrontEndChoice(kind, faults=Faults(false=8)))
    assert max(len(item.frame_graph) for item in false) > 3
    # They are seeded, and have the chosen rate.
    choice = FrontEndChoice(kind, flip=0.3, miss=0.2, jitter_px=1.5, seed=5)
    first, again, other = (
        [item.frame_graph.boxes_xyxy.tolist() for item in perceived(root, replace(choice, seed=n))]
        for n in (5, 5, 1)
    )
    assert first == again != other
    assert 0.6 < np.sum([len(boxes) for boxes in first]) / 36 < 0.95


def test_faults_are_parsed_described_and_checked():
    for values, offender in (
        ({"kind": "video"}, "--front-end video"),
        ({"flip": -0.1}, "--flip -0.1"),
        ({"jitter_px": -1.0}, "--jitter -1"),
        ({"kind": "boxes", "faults": Faults(cut=0.1)}, "cut 0.1"),
    ):
        with pytest.raises(EvaluationError, match=offender):
            FrontEndChoice(**values)
    assert parse_faults("") == Faults()
    assert parse_faults("label=0.1, false=2,spell_s=1") == Faults(0.1, 2.0, spell_s=1.0)
    assert parse_faults("cut=0.25,spell_s=1").describe() == "cut 0.25 spell_s 1"
    for text in ("lable=1", "label", "label=x"):
        with pytest.raises(ConfigurationError, match=f"'{text}'.*NAME=NUMBER"):
            parse_faults(text)
    for text in ("label=1.1", "cut=-0.1", "merge=nan", "false=9", "spell_s=0", "false_s=inf"):
        with pytest.raises(EvaluationError, match=f"{text.split('=')[0]}="):
            parse_faults(text)


# Faults that persist over frames do what they say, as often as asked, the same each time.
RATE_HZ = 10.0
SHAPE = 120, 160
CAMERA = Intrinsics(120.0, 120.0, 79.5, 59.5, SHAPE[1], SHAPE[0])
VOCABULARY = Vocabulary(tuple("abcdef"), ("near", "on"))
CLASSES = (0, 1, 2)
# Rows and columns of three things; the first two touch.
PLACES = np.s_[20:60, 10:40], np.s_[30:60, 40:80], np.s_[70:110, 100:140]


def frame(number):
    rgb, depth_m = np.zeros((*SHAPE, 3), np.uint8), np.full(SHAPE, 2.0, np.float32)
    stamp_ns = 10**9 + round(number * 1e9 / RATE_HZ)
    return RgbdFrame(stamp_ns, rgb, depth_m, CAMERA, np.eye(4))


def seen():
    image, detections = np.zeros(SHAPE, np.uint16), []
    for value, place in enumerate(PLACES, 1):
        image[place] = value
        box, classes = box_of(image == value), spread({value - 1: 0.9}, 6)
        detections.append(Detection(box, classes, 0.9, value))
    return FrameDetections(detections, [Relation(0, 1, 0.9, spread({0: 0.9}, 2))], image)


def run(frames=600, seed=0, **faults):
    injection = Injection(VOCABULARY, CLASSES, FrameFaults(), Faults(**faults), seed)
    return [injection.apply(seen(), frame(number), number) for number in range(frames)]


def labels(item):
    return {part.instance: int(part.class_probabilities.argmax()) for part in item.detections}


def test_a_wrong_label_lasts_a_spell_and_has_the_chosen_rate():
    items = run(label=0.2)
    wrong = np.array([[labels(item)[value] != value - 1 for item in items] for value in (1, 2, 3)])
    assert 0.1 < wrong.mean() < 0.3
    assert (wrong[0] != wrong[1]).any()
    # A spell has 20 frames.
    starts = np.flatnonzero(np.diff(wrong[0].astype(int), prepend=1) == 1)
    assert len(starts) and all(wrong[0][start : start + 20].all() for start in starts)
    # Another class of the room.
    assert all(set(labels(item).values()) <= set(CLASSES) for item in items)


def test_false_boxes_are_on_the_background():
    items = run(false=2.0)
    objects = seen().instance_image > 0
    for item in items:
        for part in item.detections[3:]:
            mask = item.instance_image == part.instance
            assert np.count_nonzero(mask) >= 200
            assert not (mask & objects).any()
            assert int(part.class_probabilities.argmax()) in CLASSES
    # Fewer than asked for: some are too small to be seen, or lie on the objects.
    assert 0.7 < np.mean([len(item.detections) - 3 for item in items]) <= 2.3


def test_masks_bleed_merge_and_are_cut():
    bled = run(2, bleed=1.0)[0]
    image = bled.instance_image
    # The last one bleeds over the background, as far as the strip is wide.
    assert (image[70:110, 90:100] == 3).all() and not (image[70:110, 80:89] == 3).any()
    # Of two that bleed into one another the second keeps what it took.
    assert (image[35:55, 31:40] == 2).all()
    assert bled.detections[2].box_xyxy.tolist() == [90, 60, 149, 119]
    # A merged mask removes the neighbour and its relations.
    merged = run(1, merge=1.0)[0]
    assert [part.instance for part in merged.detections] == [1, 3]
    assert merged.detections[0].box_xyxy.tolist() == [10, 20, 79, 59]
    assert not merged.relations
    assert (merged.instance_image[PLACES[1]] == 1).all()
    # A cut mask covers a part of its object for a spell.
    share = np.array([(item.instance_image == 3).sum() for item in run(cut=0.3)]) / (40 * 40)
    assert 0.15 < (share < 1).mean() < 0.45
    assert ((share[share < 1] > 0.35) & (share[share < 1] < 0.75)).all()
    for item in run(3, cut=1.0):
        for part in item.detections:
            assert (part.box_xyxy == box_of(item.instance_image == part.instance)).all()


def test_faults_are_independent_of_one_another_and_of_the_frames_processed_before():
    for item in run(5):
        assert labels(item) == {1: 0, 2: 1, 3: 2}
        assert (item.instance_image == seen().instance_image).all()
        assert len(item.relations) == 1
    everything = {"label": 0.3, "bleed": 0.3, "merge": 0.3, "cut": 0.3}
    whole = run(60, **everything)
    injection = Injection(VOCABULARY, CLASSES, FrameFaults(), Faults(**everything), 0)
    for number in range(59, 0, -7):
        again = injection.apply(seen(), frame(number), number)
        assert (again.instance_image == whole[number].instance_image).all()
        assert labels(again) == labels(whole[number])
    other = run(60, seed=1, **everything)
    assert any(labels(a) != labels(b) for a, b in zip(whole, other))
    # One fault does not change another.
    assert all(labels(a).items() <= labels(b).items() for a, b in zip(whole, run(60, label=0.3)))
