"""Masks become an instance image; nested detections of one object are joined."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.perception import on_image

from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.perception.stage import instance_image, join_nested
from deworldsg_ros.scene.camera import MaskPatch

SHAPE = (6, 7)


def pixelwise(masks, classes, scores):
    labels = np.zeros(SHAPE, np.uint16)
    for y, x in np.ndindex(SHAPE):
        claims = [k for k, mask in enumerate(masks) if on_image(mask, SHAPE)[y, x]]
        if len({classes[k] for k in claims}) == 1:
            labels[y, x] = 1 + max(claims, key=lambda k: (scores[k], -k))
    return labels


@st.composite
def frames(draw):
    count = draw(st.integers(0, 5))
    masks = []
    for _ in range(count):
        top, left = draw(st.integers(0, SHAPE[0])), draw(st.integers(0, SHAPE[1]))
        height = draw(st.integers(0, SHAPE[0] - top))
        width = draw(st.integers(0, SHAPE[1] - left))
        bits = draw(st.lists(st.booleans(), min_size=height * width, max_size=height * width))
        masks.append(MaskPatch(top, left, np.array(bits, dtype=bool).reshape(height, width)))
    classes = draw(st.lists(st.integers(0, 2), min_size=count, max_size=count))
    scores = draw(st.lists(st.sampled_from([0.25, 0.5, 0.75]), min_size=count, max_size=count))
    return masks, np.array(classes, dtype=np.int64), np.array(scores)


@given(frames())
def test_the_instance_image_equals_the_pixel_by_pixel_rule(frame):
    labels = instance_image(*frame, SHAPE)
    assert labels.dtype == np.uint16
    assert np.array_equal(labels, pixelwise(*frame))


SCREEN, CUP = [0.9, 0.1], [0.1, 0.9]
OUTER, INNER, SECOND = [10, 10, 90, 70], [20, 20, 45, 60], [50, 20, 80, 60]


def join(*rows, depths_m=None):
    """Detections (box, classes, score) and masks that are their boxes, joined."""
    boxes, classes, scores = (np.array(column, float) for column in zip(*rows))
    objects = Detections(boxes, classes, scores)
    masks = [
        MaskPatch(y1, x1, np.ones((y2 - y1 + 1, x2 - x1 + 1), bool))
        for (x1, y1, x2, y2), _, _ in rows
    ]
    depth_m = np.zeros((80, 100), np.float32)
    for mask, value in zip(masks, depths_m or [2.0] * len(rows)):
        depth_m[mask.window][mask.pixels] = value
    joined, joined_masks = join_nested(objects, masks, depth_m)
    # The input is unchanged.
    assert np.array_equal(boxes, [box for box, _, _ in rows])
    assert len(joined) == len(joined_masks)
    return joined, joined_masks


@pytest.mark.parametrize("boxes", [(OUTER, INNER), (INNER, OUTER)])
@pytest.mark.parametrize("depths_m", [(2.0, 2.01), (0.0, 0.0)])
def test_the_lit_part_of_a_screen_is_joined_with_the_screen(boxes, depths_m):
    joined, (mask,) = join((boxes[0], SCREEN, 0.8), (boxes[1], SCREEN, 0.5), depths_m=depths_m)
    assert joined.boxes_xyxy.tolist() == [OUTER] and joined.scores.tolist() == [0.8]
    assert on_image(mask, (80, 100)).sum() == 81 * 61


@pytest.mark.parametrize(
    ("inner", "classes", "depths_m"),
    [
        (INNER, CUP, (2.0, 2.0)),  # a cup in front of a screen
        (INNER, SCREEN, (2.0, 2.6)),  # a chair seen through another's back
        ([60, 20, 99, 60], SCREEN, (2.0, 2.0)),  # mostly beside it
    ],
)
def test_different_objects_are_not_joined(inner, classes, depths_m):
    joined, _ = join((OUTER, SCREEN, 0.8), (inner, classes, 0.5), depths_m=depths_m)
    assert joined.boxes_xyxy.tolist() == [OUTER, inner]


@pytest.mark.parametrize(
    ("boxes", "kept"),
    [
        # A box around several objects is removed.
        ((OUTER, INNER, SECOND), (INNER, SECOND)),
        # A chain of nested boxes is one object.
        ((OUTER, INNER, [25, 25, 40, 50]), (OUTER,)),
        # A row of equal objects is not one. Two leaning books, the box of one inside the other's.
        (([10, 10, 40, 70], [12, 20, 38, 70]), None),
        # A thin book inside the box of a leaning one, which overlaps the next book.
        (([10, 10, 40, 70], [12, 20, 22, 70], [35, 15, 60, 70]), None),
        # A larger object beside the whole makes no row.
        (
            ([10, 10, 40, 70], [12, 20, 22, 70], [35, 5, 99, 79]),
            ([10, 10, 40, 70], [35, 5, 99, 79]),
        ),
    ],
)
def test_several_boxes_of_one_class(boxes, kept):
    joined, _ = join(*((box, SCREEN, 0.9 - 0.1 * k) for k, box in enumerate(boxes)))
    assert joined.boxes_xyxy.tolist() == list(kept or boxes)
