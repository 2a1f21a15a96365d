"""Boxes inside other boxes of a frame: nested detections of one object, and weak detections.

Suppression by IoU keeps a small box inside a large one of the same class.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from deworldsg_ros.perception.protocols import Detections, MaskPatch
from deworldsg_ros.scene.arrays import Bool, Float32, Float64
from deworldsg_ros.scene.boxes import areas, shared_areas

# Two objects have one class if the dot product of their class distributions exceeds this.
SAME_CLASS = 0.3
# A box is nested if more than this fraction of it is inside another: edges are a few pixels off.
NESTED_FRACTION = 0.8
# A part has less than this fraction of the area of the whole. From there on the IoU is 0.5 or more,
# and detectors suppress one of two such boxes. Objects in a row have similar sizes.
PART_OF_AREA = 0.5
# Two surfaces are at one depth if their median depths differ by less: a constant, and a fraction of
# the depth for the noise of the sensor.
DEPTH_STEP_M = 0.05
DEPTH_STEP_FRACTION = 0.03


def join_nested(
    objects: Detections, masks: list[MaskPatch], depth_m: Float32
) -> tuple[Detections, list[MaskPatch]]:
    """Join nested detections of one object.

    A box inside a larger box of its class and at its depth is a part of the same object, such as
    the lit part of a screen. The joined object has both boxes and both masks, and the class and
    score of the better detection. A box with several such boxes inside is a group of objects and
    is removed. At different depths, both objects are kept: one is seen through the other's gaps. A
    row of equal objects is kept: a box of similar size, or beside another one of similar size.

    Args:
        objects: n objects, best score first.
        masks: n masks.
        depth_m: (H, W) float32, metres; 0 = invalid.

    Returns:
        The objects, best score first, and their masks.
    """
    within = _nested(objects)
    for inner, outer in np.argwhere(within):
        within[inner, outer] = _at_one_depth(masks[inner], masks[outer], depth_m)
    if not within.any():
        return objects, masks
    boxes, masks = objects.boxes_xyxy.copy(), list(masks)
    # A chain of three nested boxes is no group: each box counts only for the largest around it.
    outermost = within & ~(within.astype(int) @ within > 0)
    removed = outermost.sum(axis=0) > 1
    for inner, outer in np.argwhere(within):
        if removed[inner] or removed[outer]:
            continue
        keep, other = min(inner, outer), max(inner, outer)  # the better score comes first
        boxes[keep] = _hull(boxes[inner], boxes[outer])
        masks[keep] = _union(masks[inner], masks[outer], depth_m.shape)
        removed[other] = True
    kept = np.flatnonzero(~removed)
    return replace(objects, boxes_xyxy=boxes).take(kept), [masks[row] for row in kept]


def in_front_of(objects: Detections, weak: Detections) -> Detections:
    """The weak detections inside a larger object of another class.

    A weak detection that overlaps an object of its own class may be a part of it, and is left out.
    """
    inside, overlaps, same_class = _compare(weak, objects)
    part = (overlaps & same_class).any(axis=1)
    return weak.take(np.flatnonzero((inside & ~same_class).any(axis=1) & ~part))


def _nested(objects: Detections) -> Bool:
    """(n, n) bool: the row's box may be a part of the object of the column's box, of its class.

    Neighbours in a row of equal objects, such as books, also have boxes inside each other.
    """
    inside, overlaps, same_class = _compare(objects, objects)
    area = areas(objects.boxes_xyxy)
    ratio = area[:, None] / area[None, :]
    part = inside & same_class & (ratio < PART_OF_AREA)
    similar = (ratio > PART_OF_AREA) & (ratio < 1.0 / PART_OF_AREA)
    beside = overlaps & same_class & similar & ~inside & ~inside.T
    np.fill_diagonal(beside, False)
    in_row = np.flatnonzero(beside.any(axis=1))
    part[:, in_row] = False
    return np.asarray(part)


def _compare(a: Detections, b: Detections) -> tuple[Bool, Bool, Bool]:
    """(n, m) bool each: a is inside b, which is larger; they overlap; they have one class."""
    area_a, area_b = areas(a.boxes_xyxy), areas(b.boxes_xyxy)
    shared = shared_areas(a.boxes_xyxy, b.boxes_xyxy)
    inside = (shared > NESTED_FRACTION * area_a[:, None]) & (area_a[:, None] < area_b[None, :])
    same_class = a.class_probabilities @ b.class_probabilities.T > SAME_CLASS
    return inside, shared > 0, same_class


def _at_one_depth(inner: MaskPatch, outer: MaskPatch, depth_m: Float32) -> bool:
    """Whether the median depths agree; masks without depth count as being at one depth."""
    medians = [_median_depth(mask, depth_m) for mask in (inner, outer)]
    step_m = DEPTH_STEP_M + DEPTH_STEP_FRACTION * min(medians)
    return not abs(medians[0] - medians[1]) > step_m


def _median_depth(mask: MaskPatch, depth_m: Float32) -> float:
    values = depth_m[mask.window][mask.pixels]
    values = values[values > 0]
    return float(np.median(values)) if len(values) else float("nan")


def _hull(a_xyxy: Float64, b_xyxy: Float64) -> Float64:
    return np.concatenate([np.minimum(a_xyxy[:2], b_xyxy[:2]), np.maximum(a_xyxy[2:], b_xyxy[2:])])


def _union(a: MaskPatch, b: MaskPatch, shape: tuple[int, ...]) -> MaskPatch:
    image = np.zeros(shape, dtype=bool)
    image[a.window] |= a.pixels
    image[b.window] |= b.pixels
    return MaskPatch(0, 0, image)
