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
    CANDIDATE_SCORE,
    INPUT_SIZE,
    STRIDES,
    NanoDetDetector,
    SoftmaxCalibration,
    Tables,
    cluster_boxes,
    combine,
    decode,
    letterbox,
)
from deworldsg_ros.scene.arrays import pairwise_iou
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import COCO_CLASSES

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


# Scores and logits of the codes grow evenly: from 0 to 1, and from -64 to 63.5.
TABLES = Tables(
    input_codes=np.tile(np.arange(256, dtype=np.uint8)[:, None], 3),
    logits=np.tile((np.arange(256, dtype=np.float32) - 128) / 2, (3, 1)),
    scores=np.tile(np.arange(256, dtype=np.float32) / 255, (3, 1)),
)


def empty_heads():
    """Codes of every cell: scores of 0.012, logits of 0."""
    heads = []
    for stride in STRIDES:
        side = INPUT_SIZE // stride
        head = np.full((side, side, len(COCO_CLASSES) + 4 * BINS), 128, np.uint8)
        head[..., : len(COCO_CLASSES)] = 3
        heads.append(head)
    return heads


@pytest.mark.parametrize("level", range(len(STRIDES)))
def test_decode_one_cell(level):
    stride = STRIDES[level]
    heads = empty_heads()
    row, column = 5, 7
    cell = heads[level][row, column]
    cell[CUP] = 230
    # Distances 1, 2, 3 and 4.5 strides: one sharp bin, or two equal ones beside each other.
    sides = cell[len(COCO_CLASSES) :].reshape(4, BINS)
    for side, bins in enumerate([[1], [2], [3], [4, 5]]):
        sides[side, bins] = 228
    boxes, scores = decode(heads, TABLES)
    x, y = (column + 0.5) * stride, (row + 0.5) * stride
    expected = [[x - stride, y - 2 * stride, x + 3 * stride, y + 4.5 * stride]]
    assert np.allclose(boxes, expected, atol=1e-4)
    assert scores.shape == (1, 80) and scores.argmax() == CUP
    assert scores[0, CUP] == TABLES.scores[level, 230]


@pytest.mark.parametrize(("code", "count"), [(38, 0), (39, 1)])
def test_decode_takes_scores_above_the_limit(code, count):
    assert TABLES.scores[0, 38] <= CANDIDATE_SCORE < TABLES.scores[0, 39]
    heads = empty_heads()
    heads[0][0, 0, CUP] = code
    assert len(decode(heads, TABLES)[0]) == count


def test_decode_without_candidates():
    boxes, scores = decode(empty_heads(), TABLES)
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


@given(st.lists(candidate, max_size=10))
def test_weak_candidates_change_no_object_but_its_classes(rows):
    table = np.array(rows, dtype=float).reshape(-1, 6)
    boxes = np.hstack([table[:, :2], table[:, :2] + table[:, 2:4]])
    scores = np.full((len(rows), 80), 0.01)
    scores[np.arange(len(rows)), table[:, 5].astype(int)] = table[:, 4]
    every, strong = combine(boxes, scores, 0.0), combine(boxes, scores, 0.5)
    best = every.scores >= 0.5
    assert np.array_equal(every.boxes_xyxy[best], strong.boxes_xyxy)
    assert np.array_equal(every.class_probabilities[best], strong.class_probabilities)


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
    rgb = np.full((*shape, 3), (255, 128, 1), np.uint8)
    codes = 255 - TABLES.input_codes
    pixels, scale = letterbox(rgb, codes)
    assert pixels.shape == (1, 416, 416, 4) and pixels.dtype == np.uint8
    inside = (pixels[0, ..., :3] == (0, 127, 254)).all(axis=2)
    assert inside[0, 0]
    assert (pixels[0, ~inside, :3] == codes[0]).all()
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
