"""The stage: composition, limits, counted drops, failing backends, configuration."""

import sys
from collections import Counter
from dataclasses import replace
from itertools import islice

import cv2
import numpy as np
import pytest
from support import failing_backend
from support.failing_backend import Backend, Faults
from support.perception import (
    CUP_ON_TABLE,
    HEIGHT,
    INTRINSICS,
    PITCH,
    SHAPE,
    TABLE_TOP,
    WIDTH,
    box_of,
    render,
)

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception import Detections, Perception, build_perception
from deworldsg_ros.perception.backends.geometric import GeometricRelationHead
from deworldsg_ros.perception.backends.rgbd import RgbdSegmenter
from deworldsg_ros.perception.stage import mean_colours
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.ros.health import REASONS
from deworldsg_ros.scene.camera import Intrinsics, MaskPatch, RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.scene.vocabulary import REPLICA_SSG_PREDICATES


class ListedDetector:
    default_score_threshold = 0.45

    def __init__(self, boxes, classes, scores, names=("table", "cup", "person")):
        self.classes = names
        self.boxes = np.array(boxes, dtype=float).reshape(-1, 4)
        self.probabilities = np.full((len(scores), 3), 0.1)
        self.probabilities[np.arange(len(scores)), classes] = 0.8
        self.scores = np.array(scores, dtype=float)
        self.thresholds = []

    def detect(self, rgb, score_threshold):
        self.thresholds.append(score_threshold)
        keep = self.scores >= score_threshold
        return Detections(self.boxes[keep], self.probabilities[keep], self.scores[keep])


RGB, DEPTH_M, OWNER = render([TABLE_TOP, CUP_ON_TABLE], 0.002)
TABLE, CUP = box_of(OWNER > 0), box_of(OWNER == 2)
T_CAMERA = np.eye(4)
T_CAMERA[:3, 1] = 0, -np.sin(PITCH), -np.cos(PITCH)
T_CAMERA[:3, 2] = 0, np.cos(PITCH), -np.sin(PITCH)
T_CAMERA[:3, 3] = 0, 0, 1.5
FRAME = RgbdFrame(7, RGB, DEPTH_M, INTRINSICS, T_CAMERA)


def stage(detector, **settings):
    head = GeometricRelationHead(REPLICA_SSG_PREDICATES)
    return Perception(detector, RgbdSegmenter(), head, PerceptionConfig(**settings), world_up="z")


def perceive(boxes, classes, scores, **settings):
    return stage(ListedDetector(boxes, classes, scores), **settings).perceive(FRAME)


def test_a_table_and_a_cup():
    # Worst first: the stage orders.
    found, again = (perceive([TABLE, CUP], [0, 1], [0.6, 0.9]) for _ in range(2))
    graph = found.frame_graph
    assert graph.scores.tolist() == [0.9, 0.6]
    assert (graph.stamp_ns, graph.width, graph.height) == (7, WIDTH, HEIGHT)
    assert graph.vocabulary.predicates == REPLICA_SSG_PREDICATES
    for label, value in ((1, 2), (2, 1)):
        mask, truth = found.instances == label, value == OWNER
        assert (mask & truth).sum() / (mask | truth).sum() > 0.85
    row = graph.relations.pairs.tolist().index([0, 1])
    assert REPLICA_SSG_PREDICATES[graph.relations.logits[row].argmax()] == "on"
    assert found.drops == {}
    assert np.array_equal(again.instances, found.instances)
    assert np.array_equal(again.frame_graph.relations.logits, graph.relations.logits)
    without = perceive([TABLE, CUP], [0, 1], [0.6, 0.9], max_relations=0)
    assert without.frame_graph.relations.logits.shape == (0, 50)
    # Boxes are clipped to the image.
    found = perceive([[-20, -30, 60, 300]], [0], [0.9])
    assert found.frame_graph.boxes_xyxy.tolist() == [[0, 0, 60, HEIGHT - 1]]


def test_the_colour_of_an_object_is_that_of_its_mask_without_lights_and_shadows():
    # A red object in two parts of its patch, with a tenth of glare and of shadow, on blue.
    rgb, instances = np.full((100, 120, 3), (0, 0, 255), np.uint8), np.zeros((100, 120), np.uint16)
    instances[10:90, 10:40] = instances[10:90, 70:100] = 2
    rgb[instances == 2] = 200, 30, 30
    rgb[10:18, 10:100], rgb[82:90, 10:100] = 255, 0
    patch, nothing = (slice(10, 90), slice(10, 100)), (slice(0, 5), slice(0, 5))
    colours = mean_colours(rgb, instances, [nothing, patch])
    expected = cv2.cvtColor(np.float32([[[200, 30, 30]]]) / 255, cv2.COLOR_RGB2Lab)[0, 0]
    np.testing.assert_allclose(colours[1], expected, atol=1.5)
    assert np.isnan(colours[0]).all() and mean_colours(rgb, instances, [nothing]) is None

    found = perceive([TABLE, CUP], [0, 1], [0.6, 0.9]).frame_graph
    cup = cv2.cvtColor(RGB[OWNER == 2][None].astype(np.float32) / 255, cv2.COLOR_RGB2Lab)[0]
    np.testing.assert_allclose(found.colours_lab[0], np.median(cup, axis=0), atol=6)


class CountingEmbedder:
    """The mean colour of each crop."""

    model_name = "mean colour"

    def __init__(self):
        self.crops = []

    def embed(self, crops):
        self.crops += [crop.shape for crop in crops]
        return np.array([crop.reshape(-1, 3).mean(axis=0) for crop in crops], np.float32)


def test_an_embedder_takes_two_objects_a_second_in_turn():
    embedder, boxes = CountingEmbedder(), [TABLE, CUP]
    at = with_embedder(embedder, boxes)
    seen = {}
    for index in range(31):  # 10 Hz
        graph = at.perceive(replace(FRAME, stamp_ns=10**9 + index * 10**8)).frame_graph
        if graph.embeddings is not None:
            assert graph.embeddings.model == "mean colour"
            seen[index] = graph.embeddings.rows.tolist()
    # The largest one first, which is the second row; then that which waits longest.
    assert seen == {0: [1], 5: [0], 10: [1], 15: [0], 20: [1], 25: [0], 30: [1]}
    height, width, _ = embedder.crops[1]
    x1, y1, x2, y2 = CUP
    assert max(x2 - x1, y2 - y1) < height == width <= 1.1 * max(x2 - x1, y2 - y1) + 3
    # A frame after a long time has all that a second has.
    later = at.perceive(replace(FRAME, stamp_ns=9 * 10**10)).frame_graph
    assert later.embeddings.rows.tolist() == [0, 1]
    np.testing.assert_allclose(np.linalg.norm(later.embeddings.vectors, axis=1), 1, atol=1e-3)


def test_a_failing_embedder_loses_only_the_embeddings(caplog):
    embedder = CountingEmbedder()
    at = with_embedder(embedder, [TABLE, CUP])
    embedder.embed = None
    found = at.perceive(FRAME)
    assert found.drops == {"embedder_error": 2} and "embedder_error" in REASONS
    assert len(found.frame_graph) == 2 and found.frame_graph.embeddings is None
    assert "the embedder failed" in caplog.text


def with_embedder(embedder, boxes):
    head = GeometricRelationHead(REPLICA_SSG_PREDICATES)
    detector = ListedDetector(boxes, [0, 1], [0.6, 0.9])
    config = PerceptionConfig()
    return Perception(detector, RgbdSegmenter(), head, config, world_up="z", embedder=embedder)


def test_the_masks_of_a_detector_are_used_as_they_are():
    class MaskingDetector(ListedDetector):
        def detect(self, rgb, score_threshold):
            found = super().detect(rgb, score_threshold)
            masks = (MaskPatch(0, 0, OWNER == 1), MaskPatch(0, 0, OWNER == 2))
            return replace(found, masks=masks[: len(found)])

    made = stage(MaskingDetector([TABLE, CUP], [0, 1], [0.6, 0.9]))
    made._segmenter = None
    found = made.perceive(FRAME)
    assert found.frame_graph.scores.tolist() == [0.9, 0.6]
    for label, value in ((1, 2), (2, 1)):
        assert np.array_equal(found.instances == label, value == OWNER)


VIEW = [0.03 * WIDTH, 0.03 * HEIGHT, 0.97 * WIDTH, 0.97 * HEIGHT]


@pytest.mark.parametrize(
    ("boxes", "classes", "scores", "drops", "kept"),
    [
        ([], [], [], {}, []),
        ([TABLE, CUP], [0, 0], [0.6, 0.9], {"detected_twice": 1}, [0.9]),
        ([TABLE, [400, 10, 500, 60]], [0, 1], [0.6, 0.95], {"box_too_small": 1}, [0.6]),
        ([TABLE, [10, 10, 10.5, 80]], [0, 1], [0.6, 0.9], {"box_too_small": 1}, [0.6]),
        ([VIEW, [*VIEW[:3], 0.9 * HEIGHT]], [0, 1], [0.9, 0.8], {"box_is_the_view": 1}, [0.8]),
        (
            [[x, y, x + 20, y + 20] for y in range(0, 180, 30) for x in range(0, 300, 30)][:52],
            [2] * 52,
            np.linspace(0.5, 0.9, 52),
            {"over_max_objects": 2},
            np.linspace(0.5, 0.9, 52)[:1:-1],
        ),
    ],
)
def test_dropped_detections_are_counted(boxes, classes, scores, drops, kept):
    found = perceive(boxes, classes, scores)
    assert found.drops == drops
    assert found.frame_graph.scores.tolist() == list(kept)
    assert found.instances.shape == SHAPE and found.instances.dtype == np.uint16


@pytest.mark.parametrize(("configured", "used"), [(-1.0, 0.45), (0.7, 0.7), (0.0, 0.0)])
@pytest.mark.parametrize(("refine", "fraction"), [(True, 0.5), (False, 1.0)])
def test_threshold_is_that_of_the_detector_unless_configured(configured, used, refine, fraction):
    detector = ListedDetector([], [], [])
    perception = stage(detector, score_threshold=configured, refine_detections=refine)
    perception.perceive(FRAME)
    assert detector.thresholds == [used * fraction] and perception.score_threshold == used


@pytest.mark.parametrize(("refine", "taken"), [(True, 0.0), (False, 1.0)])
def test_refined_detections_leave_out_weak_objects_and_the_view(refine, taken):
    found = perceive([TABLE, CUP], [0, 1], [0.6, 0.3], refine_detections=refine)
    assert found.frame_graph.scores.tolist() == [0.6] and found.drops == {}
    assert (found.instances[OWNER == 2] > 0).mean() == pytest.approx(taken, abs=0.1)
    assert len(perceive([VIEW], [0], [0.9], refine_detections=refine).frame_graph) == (not refine)


def with_backend(failing="", times=1):
    backend, shape = Backend(**{failing: Faults(raises=9)}), failing_backend.SHAPE
    perception = Perception(backend, backend, backend, PerceptionConfig(), world_up="z")
    intrinsics = Intrinsics(40.0, 40.0, 24.5, 19.5, shape[1], shape[0])
    rgb, depth_m = np.zeros((*shape, 3), np.uint8), np.ones(shape, np.float32)
    for stamp_ns in range(times):
        found = perception.perceive(RgbdFrame(stamp_ns, rgb, depth_m, intrinsics, np.eye(4)))
    return found, backend


def test_a_backend_that_fails_loses_only_its_own_results(caplog):
    found, backend = with_backend()
    assert len(found.frame_graph) == 3 and len(found.frame_graph.relations.pairs) == 1
    assert found.drops == {} and found.failures == {}
    # The features are sorted by score together with their objects.
    assert backend.features.tolist() == [[2, 3], [4, 5], [0, 1]]
    found, _ = with_backend("relation_head", times=3)
    assert len(found.frame_graph) == 3 and found.instances.any()
    assert found.frame_graph.relations.logits.shape == (0, 2)
    assert found.drops == {"relation_head_error": 3}
    assert "injected fault" in found.failures["relation_head_error"]
    # It is logged once, with its traceback.
    assert len(caplog.records) == 1
    assert "the relation head failed" in caplog.text and "Traceback" in caplog.text
    found, _ = with_backend("segmenter")
    assert len(found.frame_graph) == 0 and not found.instances.any()
    assert found.instances.shape == failing_backend.SHAPE and found.instances.dtype == np.uint16
    assert found.drops == {"segmenter_error": 3}
    assert list(found.failures) == ["segmenter_error"]
    with pytest.raises(RefusedInput, match="injected fault") as refusal:
        with_backend("detector")
    assert refusal.value.reason == "detector_error"
    assert {"relation_head_error", "segmenter_error", "detector_error"} <= REASONS.keys()


@pytest.mark.parametrize(
    ("settings", "offender"),
    [
        ({"detector": "magic"}, "perception.detector is 'magic'"),
        ({"segmenter": "magic"}, "perception.segmenter is 'magic'"),
        ({"relation_head": "magic"}, "perception.relation_head is 'magic'"),
        # The geometric head has no predicates of its own.
        ({"predicate_set": "checkpoint", "threads": 1}, "'checkpoint'.*'geometric'"),
    ],
)
def test_an_unknown_backend_is_refused(settings, offender):
    with pytest.raises(ConfigurationError, match=offender):
        build_perception(PerceptionConfig(**settings))


@pytest.mark.parametrize(
    ("field", "name"), [("detector", "rtdetr"), ("segmenter", "sam2"), ("segmenter", "sam")]
)
def test_without_torch_the_error_names_the_package_to_install(field, name, monkeypatch):
    for module in ("closed_set", "sam"):
        monkeypatch.setitem(sys.modules, f"deworldsg_ros.perception.backends.{module}", None)
    with pytest.raises(ConfigurationError, match=f"'{name}'.*pip install torch"):
        build_perception(PerceptionConfig(**{field: name}))


@pytest.mark.parametrize(
    ("names", "offender"),
    [
        (("table", "cup\x1b[2J", "person"), "control character"),
        (("table", "c" * 257, "person"), "257 characters"),
        (tuple(map(str, range(8193))), "8193 names"),
    ],
)
def test_names_of_a_model_that_no_message_may_contain_are_refused(names, offender):
    detector = ListedDetector([], [], [], names)
    with pytest.raises(ConfigurationError, match=f"classes of the models: .*{offender}"):
        Perception(detector, RgbdSegmenter(), GeometricRelationHead(("on",)), PerceptionConfig())


def test_the_objects_of_the_kitchen_and_cups_on_the_table_are_found(shared_dir):
    recording = open_recording(shared_dir / "data" / "redkitchen")
    perception = build_perception(PerceptionConfig())
    frames_with, cups, predicates = Counter(), 0, Counter()
    for seen in islice(recording.frames(), 60, 125, 5):
        found = perception.perceive(seen)
        graph = found.frame_graph
        names = [graph.vocabulary.classes[k] for k in graph.class_probabilities.argmax(1)]
        frames_with.update(set(names))
        for row, name in enumerate(names):
            mask = (found.instances == row + 1) & (seen.depth_m > 0)
            # The mask of a cup excludes the table.
            if name == "cup" and mask.sum() > 100:
                low, high = np.percentile(seen.depth_m[mask], [10, 90])
                assert high - low < 0.15
                cups += 1
        for (s, o), logits in zip(graph.relations.pairs, graph.relations.logits):
            if (names[s], names[o]) == ("cup", "dining table"):
                predicates[graph.vocabulary.predicates[logits.argmax()]] += 1
    for name in ("chair", "dining table", "cup", "tv"):
        assert frames_with[name] >= 3, frames_with
    # And little that is not there.
    there = {"chair", "dining table", "cup", "tv", "book", "sink", "bottle", "bowl", "remote"}
    invented = sum(count for name, count in frames_with.items() if name not in there)
    assert invented <= 0.1 * frames_with.total(), frames_with
    assert cups >= 5
    assert predicates["on"] >= 3 and predicates.most_common(1)[0][0] == "on", predicates
