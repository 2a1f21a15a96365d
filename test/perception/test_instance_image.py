"""Masks → instance image, against a slow pixel-by-pixel rule."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.perception import on_image

from deworldsg_ros.perception.protocols import MaskPatch
from deworldsg_ros.perception.stage import instance_image

SHAPE = (6, 7)


def pixelwise(masks, classes, scores):
    labels = np.zeros(SHAPE, np.uint16)
    for y in range(SHAPE[0]):
        for x in range(SHAPE[1]):
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
def test_equals_the_pixel_by_pixel_rule(frame):
    masks, classes, scores = frame
    assert np.array_equal(instance_image(masks, classes, scores, SHAPE), pixelwise(*frame))


def whole(value=True):
    return MaskPatch(0, 0, np.full(SHAPE, value))


@pytest.mark.parametrize(
    ("classes", "scores", "expected"),
    [
        ([3], [0.5], 1),
        ([3, 3], [0.5, 0.6], 2),
        ([3, 3], [0.5, 0.5], 1),
        ([3, 4], [0.5, 0.6], 0),
        # A third mask does not resolve the ambiguity of two classes.
        ([3, 4, 3], [0.5, 0.6, 0.9], 0),
    ],
)
def test_a_pixel_in_several_masks(classes, scores, expected):
    masks = [whole() for _ in classes]
    labels = instance_image(masks, np.array(classes), np.array(scores), SHAPE)
    assert (labels == expected).all()
    assert labels.dtype == np.uint16


def test_no_masks():
    labels = instance_image([], np.zeros(0, np.int64), np.zeros(0), SHAPE)
    assert labels.shape == SHAPE and not labels.any()


def test_more_masks_than_labels_are_refused():
    masks = [MaskPatch(0, 0, np.zeros((0, 0), dtype=bool))] * 65536
    with pytest.raises(ValueError, match="65536 masks"):
        instance_image(masks, np.zeros(65536, np.int64), np.zeros(65536), SHAPE)
