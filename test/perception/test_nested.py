"""One thing detected as a whole and in part is one object; things that are two stay two."""

from __future__ import annotations

import numpy as np
import pytest

from deworldsg_ros.perception.nested import in_front_of, join_nested
from deworldsg_ros.perception.protocols import Detections, MaskPatch

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
def test_the_lit_part_of_a_screen_is_the_screen(scores):
    rows = sorted(zip((OUTER, INNER), (SCREEN, SCREEN), scores), key=lambda row: -row[2])
    objects, masks = detections(*rows)
    joined, joined_masks = join_nested(objects, masks, depth_of(masks, (2.0, 2.01)))
    assert joined.boxes_xyxy.tolist() == [OUTER] and joined.scores.tolist() == [0.8]
    image = joined_masks[0].to_image((80, 100))
    assert image.sum() == 81 * 61
    # Nothing that came in was changed.
    assert objects.boxes_xyxy.tolist() == [row[0] for row in rows]


def test_what_has_no_depth_cannot_be_behind():
    objects, masks = detections((OUTER, SCREEN, 0.8), (INNER, SCREEN, 0.5))
    assert len(join_nested(objects, masks, np.zeros((80, 100), np.float32))[0]) == 1


@pytest.mark.parametrize(
    ("inner", "classes", "depths_m"),
    [
        (INNER, CUP, (2.0, 2.0)),  # a cup in front of a screen
        (INNER, SCREEN, (2.0, 2.6)),  # a chair seen through another's back
        ([60, 20, 99, 60], SCREEN, (2.0, 2.0)),  # beside it, for the most part
    ],
)
def test_two_things_stay_two(inner, classes, depths_m):
    objects, masks = detections((OUTER, SCREEN, 0.8), (inner, classes, 0.5))
    joined, joined_masks = join_nested(objects, masks, depth_of(masks, depths_m))
    assert len(joined) == len(joined_masks) == 2
    assert joined.boxes_xyxy.tolist() == objects.boxes_xyxy.tolist()


def test_a_box_around_several_is_a_group():
    objects, masks = detections((OUTER, SCREEN, 0.8), (INNER, SCREEN, 0.6), (SECOND, SCREEN, 0.5))
    joined, _ = join_nested(objects, masks, depth_of(masks, (2.0, 2.0, 2.0)))
    assert joined.boxes_xyxy.tolist() == [INNER, SECOND]


def test_boxes_like_onion_skins_are_one():
    core = [25, 25, 40, 50]
    objects, masks = detections((OUTER, SCREEN, 0.8), (INNER, SCREEN, 0.6), (core, SCREEN, 0.5))
    joined, _ = join_nested(objects, masks, depth_of(masks, (2.0, 2.0, 2.0)))
    assert joined.boxes_xyxy.tolist() == [OUTER]


def test_nothing():
    none = Detections(np.zeros((0, 4)), np.zeros((0, 2)), np.zeros(0))
    joined, masks = join_nested(none, [], np.zeros((80, 100), np.float32))
    assert len(joined) == 0 and masks == []


@pytest.mark.parametrize(
    ("box", "of_class", "in_front"),
    [
        (INNER, CUP, True),
        (INNER, SCREEN, False),  # a part of the screen
        ([60, 20, 99, 60], CUP, False),  # beside it, for the most part
        ([0, 0, 99, 79], CUP, False),  # what holds the screen
    ],
)
def test_what_is_in_front_of_an_object_lies_in_it_and_is_another(box, of_class, in_front):
    objects, _ = detections((OUTER, SCREEN, 0.8))
    unsure, _ = detections((box, of_class, 0.3))
    assert len(in_front_of(objects, unsure)) == in_front
    assert len(in_front_of(objects.take(slice(0)), unsure)) == 0
    assert len(in_front_of(objects, unsure.take(slice(0)))) == 0
