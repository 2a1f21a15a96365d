"""The detector: suppression, decoding, calibration, and the shipped weights."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deworldsg_ros.perception.backends.nanodet import (
    BINS,
    INPUT_SIZE,
    STRIDES,
    NanoDetDetector,
    combine,
    decode,
    letterbox,
)
from deworldsg_ros.perception.networks.calibration import SoftmaxCalibration
from deworldsg_ros.perception.networks.nms import cluster_boxes
from deworldsg_ros.scene.boxes import pairwise_iou
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabularies import COCO_CLASSES

CHAIR, CUP, VASE = (COCO_CLASSES.index(name) for name in ("chair", "cup", "vase"))


def plain_iou(a, b):
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    shared = max(width, 0) * max(height, 0)
    area = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1])
    return shared / (area - shared)


def plain_suppression(boxes, scores, classes, same, other):
    remaining = sorted(range(len(boxes)), key=lambda k: (-scores[k], k))
    keeper = {}
    while remaining:
        best = remaining.pop(0)
        keeper[best] = best
        left = []
        for k in remaining:
            iou = plain_iou(boxes[best], boxes[k])
            if iou > other or (classes[k] == classes[best] and iou > same):
                keeper[k] = best
            else:
                left.append(k)
        remaining = left
    return [keeper[k] for k in range(len(boxes))]


candidate = st.tuples(
    st.integers(0, 20), st.integers(0, 20), st.integers(1, 20), st.integers(1, 20),
    st.sampled_from([0.2, 0.4, 0.6, 0.8]), st.integers(0, 1),
)  # fmt: skip


@given(st.lists(candidate, max_size=15))
def test_suppression_equals_the_plain_loop(rows):
    table = np.array(rows, dtype=float).reshape(-1, 6)
    boxes = np.hstack([table[:, :2], table[:, :2] + table[:, 2:4]])
    found = cluster_boxes(
        boxes, table[:, 4], table[:, 5].astype(np.int64), same_class_iou=0.4, any_class_iou=0.7
    )
    assert found.tolist() == plain_suppression(boxes, table[:, 4], table[:, 5], 0.4, 0.7)


@given(st.lists(candidate, min_size=1, max_size=6))
def test_iou_equals_the_plain_loop(rows):
    table = np.array(rows, dtype=float)
    boxes = np.hstack([table[:, :2], table[:, :2] + table[:, 2:4]])
    expected = [[plain_iou(a, b) for b in boxes] for a in boxes]
    assert np.allclose(pairwise_iou(boxes, boxes), expected)


def empty_heads():
    heads = []
    for stride in STRIDES:
        cells = (INPUT_SIZE // stride) ** 2
        heads += [
            np.full((cells, len(COCO_CLASSES)), 0.01, np.float32),
            np.zeros((cells, 4 * BINS), np.float32),
        ]
    return heads


@pytest.mark.parametrize("level", range(len(STRIDES)))
def test_decode_one_cell(level):
    stride = STRIDES[level]
    heads = empty_heads()
    row, column = 5, 7
    cell = row * (INPUT_SIZE // stride) + column
    heads[2 * level][cell, CUP] = 0.9
    # Distances 1, 2, 3 and 4.5 strides: one sharp bin, or two equal ones beside each other.
    sides = heads[2 * level + 1][cell].reshape(4, BINS)
    for side, bins in enumerate([[1], [2], [3], [4, 5]]):
        sides[side, bins] = 50.0
    boxes, scores = decode(heads[::-1])
    x, y = (column + 0.5) * stride, (row + 0.5) * stride
    expected = [[x - stride, y - 2 * stride, x + 3 * stride, y + 4.5 * stride]]
    assert np.allclose(boxes, expected, atol=1e-4)
    assert scores.shape == (1, 80) and scores.argmax() == CUP


def test_decode_without_candidates():
    boxes, scores = decode(empty_heads())
    assert boxes.shape == (0, 4) and scores.shape == (0, 80)
    assert len(combine(boxes, scores, 0.4)) == 0


def scores_of(**named):
    scores = np.full(80, 0.01)
    for name, value in named.items():
        scores[COCO_CLASSES.index(name)] = value
    return scores


def test_class_scores_of_nearly_identical_boxes_are_combined():
    boxes = np.array([[10, 10, 60, 60], [11, 10, 61, 60], [200, 10, 260, 60]], dtype=float)
    scores = np.stack([scores_of(vase=0.6), scores_of(bottle=0.55), scores_of(vase=0.6)])
    found = combine(boxes, scores, 0.4)
    assert len(found) == 2
    disputed, plain = found.class_probabilities[:, VASE]
    assert found.class_probabilities[0, COCO_CLASSES.index("bottle")] > 0.2
    assert 0.5 < disputed < plain
    assert np.allclose(found.class_probabilities.sum(axis=1), 1)


def test_nested_objects_of_different_classes_are_kept():
    boxes = np.array([[0, 0, 100, 100], [40, 10, 60, 40]], dtype=float)
    found = combine(boxes, np.stack([scores_of(chair=0.6), scores_of(cup=0.5)]), 0.4)
    assert found.class_probabilities.argmax(axis=1).tolist() == [CHAIR, CUP]


def test_calibrated_distributions_can_merge():
    # Eq. 5: D_c = 1 - sum p q must be below 0.8 for two observations of one object.
    first, second = scores_of(chair=0.45, bench=0.1), scores_of(chair=0.6)
    flat = [s / s.sum() for s in (first, second)]
    sharp = SoftmaxCalibration(0.35)(np.stack([first, second]))
    cup = SoftmaxCalibration(0.35)(scores_of(cup=0.5)[None])
    assert 1 - flat[0] @ flat[1] > 0.8
    assert 1 - sharp[0] @ sharp[1] < 0.6
    assert 1 - sharp[0] @ cup[0] > 0.95


@given(st.lists(st.floats(0, 1), min_size=2, max_size=8), st.floats(0.1, 5))
def test_calibration_gives_distributions_and_keeps_the_order(scores, temperature):
    p = SoftmaxCalibration(temperature)(np.array([scores]))[0]
    assert np.isclose(p.sum(), 1) and (p >= 0).all()
    order = np.argsort(scores, kind="stable")
    assert (np.diff(p[order]) >= -1e-12).all()


def test_calibration_refuses_a_temperature_that_is_not_positive():
    with pytest.raises(ValueError, match="temperature is 0"):
        SoftmaxCalibration(0)


@pytest.mark.parametrize("shape", [(480, 640), (640, 480), (416, 416), (60, 80), (1, 500)])
def test_letterbox_keeps_the_aspect(shape):
    rgb = np.full((*shape, 3), 255, np.uint8)
    tensor, scale = letterbox(rgb)
    assert tensor.shape == (1, 3, 416, 416) and tensor.dtype == np.float32
    inside = (tensor[0] > 0).all(axis=0)
    assert inside[0, 0]
    assert np.isclose(scale * max(shape), 416)
    expected = max(1, round(shape[0] * scale)) * max(1, round(shape[1] * scale))
    assert inside.sum() == expected


@pytest.fixture(scope="module")
def detector():
    return NanoDetDetector(threads=1)


def clock_picture():
    """A drawing of a wall clock, a COCO class that is easy to detect."""
    image = np.full((480, 640, 3), (214, 208, 196), np.uint8)
    centre = (400, 200)
    cv2.circle(image, centre, 92, (40, 40, 40), -1, cv2.LINE_AA)
    cv2.circle(image, centre, 82, (250, 250, 250), -1, cv2.LINE_AA)
    for hour in range(12):
        angle = hour * np.pi / 6
        tip = (int(400 + 74 * np.sin(angle)), int(200 - 74 * np.cos(angle)))
        root = (int(400 + 62 * np.sin(angle)), int(200 - 62 * np.cos(angle)))
        cv2.line(image, root, tip, (20, 20, 20), 5, cv2.LINE_AA)
    cv2.line(image, centre, (400, 145), (20, 20, 20), 6, cv2.LINE_AA)
    cv2.line(image, centre, (440, 220), (20, 20, 20), 6, cv2.LINE_AA)
    return image


def test_the_shipped_weights_detect_a_clock(detector):
    found = detector.detect(clock_picture(), detector.default_score_threshold)
    names = [COCO_CLASSES[k] for k in found.class_probabilities.argmax(axis=1)]
    assert "clock" in names
    row = names.index("clock")
    assert plain_iou(found.boxes_xyxy[row], [308, 108, 492, 292]) > 0.8
    assert found.class_probabilities[row].max() > 0.7
    assert np.allclose(found.class_probabilities.sum(axis=1), 1)


def test_detection_is_deterministic(detector):
    first = detector.detect(clock_picture(), 0.2)
    second = detector.detect(clock_picture(), 0.2)
    assert np.array_equal(first.class_probabilities, second.class_probabilities)
    assert np.array_equal(first.boxes_xyxy, second.boxes_xyxy)


def test_an_empty_image_has_no_detections(detector):
    assert len(detector.detect(np.full((480, 640, 3), 90, np.uint8), 0.4)) == 0


def test_missing_weights_are_refused():
    with pytest.raises(ConfigurationError, match="nowhere.onnx"):
        NanoDetDetector(weights=Path("nowhere.onnx"))
