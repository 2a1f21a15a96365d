"""The detector: suppression, decoding, calibration, and the shipped weights."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deworldsg_ros.perception.backends import embedded
from deworldsg_ros.perception.backends.embedded import (
    NanoDetDetector,
    PairDetector,
    SoftmaxCalibration,
    SsdLite,
    combine,
    decode,
    join_opinions,
)
from deworldsg_ros.scene.arrays import pairwise_iou
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.vocabulary import COCO_CLASSES

BOTTLE, CHAIR, CUP, VASE = map(COCO_CLASSES.index, ("bottle", "chair", "cup", "vase"))


def plain_iou(a, b):
    width, height = (min(a[i + 2], b[i + 2]) - max(a[i], b[i]) for i in (0, 1))
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


def boxes_of(rows):
    table = np.array(rows, dtype=float).reshape(-1, 6)
    boxes = np.hstack([table[:, :2], table[:, :2] + table[:, 2:4]])
    return boxes, table[:, 4], table[:, 5].astype(np.int64)


@given(st.lists(candidate, max_size=15))
def test_iou_and_suppression_equal_the_plain_loops(rows):
    boxes, scores, classes = boxes_of(rows)
    for a, row in zip(boxes, pairwise_iou(boxes, boxes)):
        assert np.allclose(row, [plain_iou(a, b) for b in boxes])
    limits = {"same_class_iou": 0.4, "any_class_iou": 0.7}
    found = embedded.cluster_boxes(boxes, scores, classes, **limits)
    assert found.tolist() == plain_suppression(boxes, scores, classes, 0.4, 0.7)


# Scores and logits of the codes grow evenly: from 0 to 1, and from -64 to 63.5.
CODES = np.arange(256)
TABLES = embedded.Tables(
    input_codes=np.tile(CODES.astype(np.uint8)[:, None], 3),
    logits=np.tile((CODES.astype(np.float32) - 128) / 2, (3, 1)),
    scores=np.tile(CODES.astype(np.float32) / 255, (3, 1)),
)


def empty_heads():
    """Codes of every cell: scores of 0.012, logits of 0."""
    heads = []
    for stride in embedded.STRIDES:
        side = embedded.INPUT_SIZE // stride
        head = np.full((side, side, len(COCO_CLASSES) + 4 * embedded.BINS), 128, np.uint8)
        head[..., : len(COCO_CLASSES)] = 3
        heads.append(head)
    return heads


@pytest.mark.parametrize("level", range(len(embedded.STRIDES)))
def test_decode_one_cell(level):
    stride, row, column = embedded.STRIDES[level], 5, 7
    heads = empty_heads()
    cell = heads[level][row, column]
    cell[CUP] = 230
    # Distances 1, 2, 3 and 4.5 strides: one sharp bin, or two equal ones beside each other.
    sides = cell[len(COCO_CLASSES) :].reshape(4, embedded.BINS)
    for side, bins in enumerate([[1], [2], [3], [4, 5]]):
        sides[side, bins] = 228
    boxes, scores = decode(heads, TABLES)
    x, y = (column + 0.5) * stride, (row + 0.5) * stride
    expected = [[x - stride, y - 2 * stride, x + 3 * stride, y + 4.5 * stride]]
    assert np.allclose(boxes, expected, atol=1e-4)
    assert scores.shape == (1, 80) and scores.argmax() == CUP
    assert scores[0, CUP] == TABLES.scores[level, 230]


def scores_of(scores):
    rows = np.full((len(scores), 80), 0.01)
    for row, named in zip(rows, scores):
        row[list(named)] = list(named.values())
    return rows


def test_class_scores_of_nearly_identical_boxes_are_combined():
    boxes = np.array([[10, 10, 60, 60], [11, 10, 61, 60], [200, 10, 260, 60]], dtype=float)
    found = combine(boxes, scores_of([{VASE: 0.6}, {BOTTLE: 0.55}, {VASE: 0.6}]), 0.4)
    disputed, plain = found.class_probabilities[:, VASE]
    assert found.class_probabilities[0, BOTTLE] > 0.2
    assert 0.5 < disputed < plain
    assert np.allclose(found.class_probabilities.sum(axis=1), 1)
    # Nested objects of different classes are kept.
    boxes = np.array([[0, 0, 100, 100], [40, 10, 60, 40]], dtype=float)
    found = combine(boxes, scores_of([{CHAIR: 0.6}, {CUP: 0.5}]), 0.4)
    assert found.class_probabilities.argmax(axis=1).tolist() == [CHAIR, CUP]


@given(st.lists(candidate, max_size=10))
def test_weak_candidates_change_no_object_but_its_classes(rows):
    boxes, best_scores, classes = boxes_of(rows)
    scores = scores_of([{c: s} for c, s in zip(classes, best_scores)])
    every, strong = combine(boxes, scores, 0.0), combine(boxes, scores, 0.5)
    best = every.scores >= 0.5
    assert np.array_equal(every.boxes_xyxy[best], strong.boxes_xyxy)
    assert np.array_equal(every.class_probabilities[best], strong.class_probabilities)


@given(st.lists(st.floats(0, 1), min_size=2, max_size=8), st.floats(0.1, 5))
def test_calibration_gives_distributions_and_keeps_the_order(scores, temperature):
    p = SoftmaxCalibration(temperature)(np.array([scores]))[0]
    assert np.isclose(p.sum(), 1) and (p >= 0).all()
    order = np.argsort(scores, kind="stable")
    assert (np.diff(p[order]) >= -1e-12).all()


def test_calibrated_distributions_can_merge():
    # Eq. 5: D_c = 1 - sum p q must be below 0.8 for two observations of one object.
    rows = scores_of([{CHAIR: 0.45, BOTTLE: 0.1}, {CHAIR: 0.6}, {CUP: 0.5}])
    flat, sharp = rows / rows.sum(axis=1, keepdims=True), SoftmaxCalibration(0.35)(rows)
    assert 1 - flat[0] @ flat[1] > 0.8
    assert 1 - sharp[0] @ sharp[1] < 0.6
    assert 1 - sharp[0] @ sharp[2] > 0.95
    with pytest.raises(ValueError, match="temperature is 0"):
        SoftmaxCalibration(0)


@pytest.mark.parametrize("shape", [(480, 640), (640, 480), (416, 416), (60, 80), (1, 500)])
def test_letterbox_keeps_the_aspect(shape):
    rgb = np.full((*shape, 3), (255, 128, 1), np.uint8)
    codes = 255 - TABLES.input_codes
    pixels, scale = embedded.letterbox(rgb, codes)
    assert pixels.shape == (1, 416, 416, 4) and pixels.dtype == np.uint8
    inside = (pixels[0, ..., :3] == (0, 127, 254)).all(axis=2)
    assert inside[0, 0]
    assert (pixels[0, ~inside, :3] == codes[0]).all()
    assert np.isclose(scale * max(shape), 416)
    assert inside.sum() == max(1, round(shape[0] * scale)) * max(1, round(shape[1] * scale))


def clock_picture():
    """A drawing of a wall clock, a COCO class that is easy to detect."""
    image = np.full((480, 640, 3), (214, 208, 196), np.uint8)
    for radius, grey in ((92, 40), (82, 250)):
        cv2.circle(image, (400, 200), radius, [grey] * 3, -1, cv2.LINE_AA)
    marks = [(62, 74, hour * np.pi / 6, 5) for hour in range(12)]
    for low, high, angle, width in [*marks, (0, 55, 0.0, 6), (0, 45, 2.0, 6)]:
        ends = [(int(400 + r * np.sin(angle)), int(200 - r * np.cos(angle))) for r in (low, high)]
        cv2.line(image, *ends, (20, 20, 20), width, cv2.LINE_AA)
    return image


def test_a_second_opinion_counts_where_the_boxes_agree():
    boxes = np.array([[10, 10, 60, 60], [100, 10, 160, 60]], dtype=float)
    alone = scores_of([{CUP: 0.5}, {CUP: 0.5}])
    beside = boxes + [2, 0, 2, 0]
    joined, scores = join_opinions((boxes, alone), (beside[:1], scores_of([{CUP: 0.6}])))
    assert np.array_equal(joined, boxes)
    assert scores[0, CUP] > 0.7 > 0.5 > scores[1, CUP]
    # Another name of the second is one more doubt, and its own boxes are no objects.
    _, other = join_opinions((boxes, alone), (beside, scores_of([{VASE: 0.9}, {VASE: 0.9}])))
    assert other[0, VASE] > other[0, BOTTLE] and other[0, CUP] < scores[0, CUP]
    nothing = (np.zeros((0, 4)), np.zeros((0, 80)))
    _, unseen = join_opinions((boxes, alone), nothing)
    assert np.array_equal(unseen[0], unseen[1]) and unseen[0, CUP] < other[0, CUP] + 1e-12
    assert join_opinions(nothing, (boxes, alone))[1].shape == (0, 80)


@pytest.mark.parametrize("make", [NanoDetDetector, PairDetector])
def test_the_shipped_weights_detect_a_clock(make):
    detector = make(threads=1)
    found, again = (detector.detect(clock_picture(), 0.2) for _ in range(2))
    assert np.array_equal(again.class_probabilities, found.class_probabilities)
    assert np.array_equal(again.boxes_xyxy, found.boxes_xyxy)
    found = detector.detect(clock_picture(), detector.default_score_threshold)
    names = [COCO_CLASSES[k] for k in found.class_probabilities.argmax(axis=1)]
    row = names.index("clock")
    assert plain_iou(found.boxes_xyxy[row], [308, 108, 492, 292]) > 0.8
    assert found.class_probabilities[row].max() > 0.7
    assert len(detector.detect(np.full((480, 640, 3), 90, np.uint8), 0.4)) == 0
    beside = make(threads=2).detect(clock_picture(), 0.2)
    again = detector.detect(clock_picture(), 0.2)
    assert np.array_equal(beside.class_probabilities, again.class_probabilities)
    for network in (NanoDetDetector, SsdLite):
        with pytest.raises(ConfigurationError, match=r"nowhere\.onnx"):
            network(weights=Path("nowhere.onnx"))


def test_the_second_network_gives_boxes_in_pixels():
    boxes, scores = SsdLite().candidates(clock_picture())
    best = scores[:, COCO_CLASSES.index("clock")].argmax()
    assert plain_iou(boxes[best], [308, 108, 492, 292]) > 0.7


def test_a_name_is_as_certain_as_its_score_says() -> None:
    scores = np.array([[0.8, 0.1, 0.1], [0.45, 0.1, 0.1]])
    boxes = np.array([[0.0, 0.0, 9.0, 9.0], [50.0, 50.0, 90.0, 90.0]])
    plain = combine(boxes, scores, 0.3, SoftmaxCalibration(0.35))
    assert plain.certainties is None and plain.doubted() is plain
    found = combine(boxes, scores, 0.3, SoftmaxCalibration(0.35, certainty=(2.0, 0.5)))
    assert found.certainties is not None
    odds = found.certainties / (1 - found.certainties)
    np.testing.assert_allclose(odds, math.exp(0.5) * (scores[:, 0] / (1 - scores[:, 0])) ** 2)
    doubted = found.doubted().class_probabilities
    np.testing.assert_allclose(doubted.sum(axis=1), 1.0)
    rest = (1 - found.certainties) / 3
    expected = found.certainties * plain.class_probabilities[:, 0] + rest
    np.testing.assert_allclose(doubted[:, 0], expected)
    assert found.take([1]).certainties == found.certainties[1]
