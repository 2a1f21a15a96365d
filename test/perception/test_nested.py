"""Nested detections of one object are joined; different objects are kept."""

from __future__ import annotations

import numpy as np
import pytest
from support.perception import on_image

from deworldsg_ros.perception.protocols import Detections, MaskPatch
from deworldsg_ros.perception.stage import in_front_of, join_nested

SCREEN, CUP = [0.9, 0.1], [0.1, 0.9]
OUTER, INNER, SECOND = [10, 10, 90, 70], [20, 20, 45, 60], [50, 20, 80, 60]


def detections(*rows):
    boxes, classes, scores = zip(*rows)
    return Detections(np.array(boxes, float), np.array(classes, float), np.array(scores, float)), [
        MaskPatch(y1, x1, np.ones((y2 - y1 + 1, x2 - x1 + 1), bool)) for x1, y1, x2, y2 in boxes
    ]


def depth_of(masks, depths_m):
    depth_m = np.zeros((80, 100), np.float32)
    for mask, value in zip(masks, depths_m):
        depth_m[mask.window][mask.pixels] = value
    return depth_m


@pytest.mark.parametrize("scores", [(0.8, 0.5), (0.5, 0.8)])
def test_the_lit_part_of_a_screen_is_joined_with_the_screen(scores):
    rows = sorted(zip((OUTER, INNER), (SCREEN, SCREEN), scores), key=lambda row: -row[2])
    objects, masks = detections(*rows)
    joined, joined_masks = join_nested(objects, masks, depth_of(masks, (2.0, 2.01)))
    assert joined.boxes_xyxy.tolist() == [OUTER] and joined.scores.tolist() == [0.8]
    image = on_image(joined_masks[0], (80, 100))
    assert image.sum() == 81 * 61
    # The input is unchanged.
    assert objects.boxes_xyxy.tolist() == [row[0] for row in rows]


def test_nested_boxes_without_depth_are_joined():
    objects, masks = detections((OUTER, SCREEN, 0.8), (INNER, SCREEN, 0.5))
    assert len(join_nested(objects, masks, np.zeros((80, 100), np.float32))[0]) == 1


@pytest.mark.parametrize(
    ("inner", "classes", "depths_m"),
    [
        (INNER, CUP, (2.0, 2.0)),  # a cup in front of a screen
        (INNER, SCREEN, (2.0, 2.6)),  # a chair seen through another's back
        ([60, 20, 99, 60], SCREEN, (2.0, 2.0)),  # mostly beside it
    ],
)
def test_different_objects_are_not_joined(inner, classes, depths_m):
    objects, masks = detections((OUTER, SCREEN, 0.8), (inner, classes, 0.5))
    joined, joined_masks = join_nested(objects, masks, depth_of(masks, depths_m))
    assert len(joined) == len(joined_masks) == 2
    assert joined.boxes_xyxy.tolist() == objects.boxes_xyxy.tolist()


def test_a_box_around_several_objects_is_removed():
    objects, masks = detections((OUTER, SCREEN, 0.8), (INNER, SCREEN, 0.6), (SECOND, SCREEN, 0.5))
    joined, _ = join_nested(objects, masks, depth_of(masks, (2.0, 2.0, 2.0)))
    assert joined.boxes_xyxy.tolist() == [INNER, SECOND]


def test_a_chain_of_nested_boxes_is_one_object():
    core = [25, 25, 40, 50]
    objects, masks = detections((OUTER, SCREEN, 0.8), (INNER, SCREEN, 0.6), (core, SCREEN, 0.5))
    joined, _ = join_nested(objects, masks, depth_of(masks, (2.0, 2.0, 2.0)))
    assert joined.boxes_xyxy.tolist() == [OUTER]


@pytest.mark.parametrize(
    "boxes",
    [
        # Two leaning books, the box of one inside that of the other.
        ([10, 10, 40, 70], [12, 20, 38, 70]),
        # A thin book inside the box of a leaning one, which overlaps the next book.
        ([10, 10, 40, 70], [12, 20, 22, 70], [35, 15, 60, 70]),
    ],
)
def test_a_row_of_equal_objects_is_not_one_object(boxes):
    objects, masks = detections(*((box, SCREEN, 0.9 - 0.1 * k) for k, box in enumerate(boxes)))
    joined, _ = join_nested(objects, masks, depth_of(masks, [2.0] * len(boxes)))
    assert joined.boxes_xyxy.tolist() == [list(box) for box in boxes]


def test_a_larger_object_beside_the_whole_makes_no_row():
    part, other = [12, 20, 22, 70], [35, 5, 99, 79]
    objects, masks = detections(
        ([10, 10, 40, 70], SCREEN, 0.8), (part, SCREEN, 0.6), (other, SCREEN, 0.5)
    )
    joined, _ = join_nested(objects, masks, depth_of(masks, (2.0, 2.0, 2.0)))
    assert joined.boxes_xyxy.tolist() == [[10, 10, 40, 70], other]


def test_no_detections():
    none = Detections(np.zeros((0, 4)), np.zeros((0, 2)), np.zeros(0))
    joined, masks = join_nested(none, [], np.zeros((80, 100), np.float32))
    assert len(joined) == 0 and masks == []


@pytest.mark.parametrize(
    ("box", "of_class", "in_front"),
    [
        (INNER, CUP, True),
        (INNER, SCREEN, False),  # a part of the screen
        ([60, 20, 99, 60], CUP, False),  # mostly beside it
        ([0, 0, 99, 79], CUP, False),  # the support of the screen
    ],
)
def test_weak_detections_in_front_are_inside_an_object_of_another_class(box, of_class, in_front):
    objects, _ = detections((OUTER, SCREEN, 0.8))
    weak, _ = detections((box, of_class, 0.3))
    assert len(in_front_of(objects, weak)) == in_front
    assert len(in_front_of(objects.take(slice(0)), weak)) == 0
    assert len(in_front_of(objects, weak.take(slice(0)))) == 0
