"""The stage: composition, limits, counted drops, configuration."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from support.perception import (
    CUP_ON_TABLE,
    HEIGHT,
    INTRINSICS,
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
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import (
    COCO_CLASSES,
    PREDICATE_SETS,
    REPLICA_SSG_PREDICATES,
    SCANNET_CLASSES,
    SCANNET_PREDICATES,
    VISUAL_GENOME_CLASSES,
)


class ListedDetector:
    """Returns the detections that it was made with."""

    classes = ("table", "cup", "person")
    default_score_threshold = 0.45

    def __init__(self, boxes, classes, scores):
        self.boxes = np.array(boxes, dtype=float).reshape(-1, 4)
        self.probabilities = np.full((len(scores), 3), 0.1)
        self.probabilities[np.arange(len(scores)), classes] = 0.8
        self.scores = np.array(scores, dtype=float)
        self.thresholds = []

    def detect(self, rgb, score_threshold):
        self.thresholds.append(score_threshold)
        keep = self.scores >= score_threshold
        return Detections(self.boxes[keep], self.probabilities[keep], self.scores[keep])


def camera_pose():
    pitch = np.radians(30.0)
    pose = np.eye(4)
    pose[:3, 0] = [1, 0, 0]
    pose[:3, 1] = [0, -np.sin(pitch), -np.cos(pitch)]
    pose[:3, 2] = [0, np.cos(pitch), -np.sin(pitch)]
    pose[:3, 3] = [0, 0, 1.5]
    return pose


def table_and_cup():
    rgb, depth_m, owner = render([TABLE_TOP, CUP_ON_TABLE], 0.002)
    frame = RgbdFrame(7, rgb, depth_m, INTRINSICS, camera_pose())
    return frame, box_of(owner > 0), box_of(owner == 2), owner


def stage(detector, **settings):
    head = GeometricRelationHead(REPLICA_SSG_PREDICATES)
    return Perception(detector, RgbdSegmenter(), head, PerceptionConfig(**settings), world_up="z")


def test_a_table_and_a_cup():
    frame, table, cup, owner = table_and_cup()
    # Worst first: the stage orders.
    found = stage(ListedDetector([table, cup], [0, 1], [0.6, 0.9])).perceive(frame)
    graph = found.frame_graph
    assert graph.scores.tolist() == [0.9, 0.6]
    assert graph.stamp_ns == 7 and (graph.width, graph.height) == (WIDTH, HEIGHT)
    assert graph.vocabulary.predicates == REPLICA_SSG_PREDICATES
    for label, value in ((1, 2), (2, 1)):
        mask, truth = found.instances == label, owner == value
        assert (mask & truth).sum() / (mask | truth).sum() > 0.85
    relations = {
        tuple(pair): REPLICA_SSG_PREDICATES[row.argmax()]
        for pair, row in zip(graph.relations.pairs.tolist(), graph.relations.logits)
    }
    assert relations[0, 1] == "on"
    assert found.drops == {}


def test_nothing_detected():
    frame, *_ = table_and_cup()
    found = stage(ListedDetector([], [], [])).perceive(frame)
    assert len(found.frame_graph) == 0 and not found.instances.any()
    assert found.instances.shape == SHAPE and found.instances.dtype == np.uint16
    assert found.frame_graph.relations.logits.shape == (0, 50)


def test_dropped_detections_are_counted():
    frame, table, cup, _ = table_and_cup()
    boxes = [table, cup, [400, 10, 500, 60], [10, 10, 10.5, 80]]
    perceived = stage(ListedDetector(boxes, [0, 1, 2, 2], [0.6, 0.9, 0.95, 0.5])).perceive(frame)
    assert perceived.drops == {"box_too_small": 2}
    assert perceived.frame_graph.scores.tolist() == [0.9, 0.6]


def test_the_best_50_objects_are_kept():
    frame, *_ = table_and_cup()
    corners = [(30 * (k % 10), 30 * (k // 10)) for k in range(52)]
    boxes = [[x, y, x + 20, y + 20] for x, y in corners]
    scores = np.linspace(0.5, 0.9, 52)
    perceived = stage(ListedDetector(boxes, [2] * 52, scores)).perceive(frame)
    assert perceived.drops == {"over_max_objects": 2}
    assert perceived.frame_graph.scores.tolist() == scores[:1:-1].tolist()


def test_boxes_are_clipped_to_the_image():
    frame, *_ = table_and_cup()
    found = stage(ListedDetector([[-20, -30, 60, 300]], [0], [0.9])).perceive(frame)
    assert found.frame_graph.boxes_xyxy.tolist() == [[0, 0, 60, HEIGHT - 1]]


def test_a_box_that_fills_the_image_is_no_object():
    frame, *_ = table_and_cup()
    near = [0.03 * WIDTH, 0.03 * HEIGHT, 0.97 * WIDTH, 0.97 * HEIGHT]
    far = [*near[:3], 0.9 * HEIGHT]
    detector = ListedDetector([near, far], [0, 1], [0.9, 0.8])
    perceived = stage(detector).perceive(frame)
    assert perceived.drops == {"box_is_the_view": 1}
    assert perceived.frame_graph.scores.tolist() == [0.8]
    perceived = stage(detector, refine_detections=False).perceive(frame)
    assert perceived.frame_graph.scores.tolist() == [0.9, 0.8]


def test_relations_can_be_off():
    frame, table, cup, _ = table_and_cup()
    found = stage(ListedDetector([table, cup], [0, 1], [0.6, 0.9]), max_relations=0)
    assert len(found.perceive(frame).frame_graph.relations.pairs) == 0


@pytest.mark.parametrize(("configured", "used"), [(-1.0, 0.45), (0.7, 0.7), (0.0, 0.0)])
@pytest.mark.parametrize(("refine", "fraction"), [(True, 0.5), (False, 1.0)])
def test_threshold_is_that_of_the_detector_unless_configured(configured, used, refine, fraction):
    frame, *_ = table_and_cup()
    detector = ListedDetector([], [], [])
    perception = stage(detector, score_threshold=configured, refine_detections=refine)
    perception.perceive(frame)
    assert detector.thresholds == [used * fraction] and perception.score_threshold == used


@pytest.mark.parametrize(("refine", "taken"), [(True, 0.0), (False, 1.0)])
def test_a_weakly_detected_cup_is_no_object_and_no_part_of_the_table(refine, taken):
    frame, table, cup, owner = table_and_cup()
    detector = ListedDetector([table, cup], [0, 1], [0.6, 0.3])
    perceived = stage(detector, refine_detections=refine).perceive(frame)
    assert perceived.frame_graph.scores.tolist() == [0.6] and perceived.drops == {}
    assert (perceived.instances[owner == 2] > 0).mean() == pytest.approx(taken, abs=0.1)


def test_perception_is_deterministic():
    frame, table, cup, _ = table_and_cup()
    detector = ListedDetector([table, cup], [0, 1], [0.6, 0.9])
    first, second = stage(detector).perceive(frame), stage(detector).perceive(frame)
    assert np.array_equal(first.instances, second.instances)
    assert np.array_equal(first.frame_graph.relations.logits, second.frame_graph.relations.logits)


def test_the_configured_stage_runs():
    frame, *_ = table_and_cup()
    perception = build_perception(PerceptionConfig(predicate_set="3dssg", threads=1))
    perceived = perception.perceive(frame)
    assert perception.vocabulary.classes == COCO_CLASSES
    assert perceived.frame_graph.relations.logits.shape[1] == 7


@pytest.mark.parametrize("field", ["detector", "segmenter", "relation_head"])
def test_an_unknown_backend_is_refused(field):
    config = msgspec.structs.replace(PerceptionConfig(), **{field: "magic"})
    with pytest.raises(ConfigurationError, match=f"perception.{field} is 'magic', expected one of"):
        build_perception(config)


def test_vocabularies_are_the_published_ones():
    assert len(COCO_CLASSES) == len(set(COCO_CLASSES)) == 80
    assert len(VISUAL_GENOME_CLASSES) == len(set(VISUAL_GENOME_CLASSES)) == 150
    assert len(SCANNET_CLASSES) == len(set(SCANNET_CLASSES)) == 20
    assert {name: len(p) for name, p in PREDICATE_SETS.items()} == {"replica_ssg": 50, "3dssg": 7}
    assert set(
        ["above", "against", "attached to", "has", "in", "near", "on", "under", "with"]
    ) <= set(REPLICA_SSG_PREDICATES)
    assert sorted(SCANNET_PREDICATES) == list(SCANNET_PREDICATES)


@pytest.mark.parametrize(
    ("classes", "reason"),
    [
        (("table", "cup\x1b[2J", "person"), "contains a control character"),
        (("table", "c" * 257, "person"), "of 257 characters: expected at most 256"),
        (tuple(map(str, range(8193))), "8193 names: expected at most 8192"),
    ],
)
def test_names_of_a_model_that_no_message_may_contain_are_refused(classes, reason) -> None:
    detector = ListedDetector([], [], [])
    detector.classes = classes
    with pytest.raises(ConfigurationError, match=f"classes of the models: .*{reason}"):
        Perception(detector, RgbdSegmenter(), GeometricRelationHead(("on",)), PerceptionConfig())
