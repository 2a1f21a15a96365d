"""Boxes within other boxes of a frame: one thing detected twice, and what lies in front of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from deworldsg_ros.perception.protocols import Detections, MaskPatch
from deworldsg_ros.scene.arrays import Bool, Float32, Float64

# Σ p q of two class distributions above which they speak of one class.
SAME_CLASS = 0.3
# Share of a box inside another above which it is nested; boxes are a few pixels off.
NESTED_SHARE = 0.8
# Surfaces whose median depths differ by less are not one behind the other.
DEPTH_STEP_M = 0.05
DEPTH_STEP_SHARE = 0.03


def join_nested(
    objects: Detections, masks: list[MaskPatch], depth_m: Float32
) -> tuple[Detections, list[MaskPatch]]:
    """Make one object of each that was detected as a whole and in part.

    Suppression by IoU lets a box through that lies in a larger one of its class: the lit part of a
    screen and the screen. At one depth, the two are one thing: it keeps the outer box, both masks,
    and what was said of the better score. A box with several such boxes in it is a group of
    things, and goes; a thing behind the other's gaps is at another depth, and both stay.

    Args:
        objects: n objects, best score first.
        masks: of the objects.
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
    # Of boxes that lie in one another, the largest counts: two that do not make a group.
    outermost = within & ~(within.astype(int) @ within > 0)
    gone = outermost.sum(axis=0) > 1
    for inner, outer in np.argwhere(within):
        if gone[inner] or gone[outer]:
            continue
        keep, other = min(inner, outer), max(inner, outer)  # the better score comes first
        boxes[keep] = _hull(boxes[inner], boxes[outer])
        masks[keep] = _union(masks[inner], masks[outer], depth_m.shape)
        gone[other] = True
    kept = np.flatnonzero(~gone)
    return replace(objects, boxes_xyxy=boxes).take(kept), [masks[row] for row in kept]


def in_front_of(objects: Detections, unsure: Detections) -> Detections:
    """Those of `unsure` that lie within a larger object and are no part of any.

    What overlaps an object of its own class may be that object once more.
    """
    inside, overlaps, same_class = _placed(unsure, objects)
    part = (overlaps & same_class).any(axis=1)
    return unsure.take(np.flatnonzero((inside & ~same_class).any(axis=1) & ~part))


def _nested(objects: Detections) -> Bool:
    """(n, n): the box of the row lies in the larger one of the column, and is of its class."""
    inside, _, same_class = _placed(objects, objects)
    return inside & same_class


def _placed(a: Detections, b: Detections) -> tuple[Bool, Bool, Bool]:
    """(n, m) each: a lies within b, which is larger; they overlap; they are of one class."""
    area_a, area_b = ((x.boxes_xyxy[:, 2:] - x.boxes_xyxy[:, :2]).prod(axis=1) for x in (a, b))
    low = np.maximum(a.boxes_xyxy[:, None, :2], b.boxes_xyxy[None, :, :2])
    high = np.minimum(a.boxes_xyxy[:, None, 2:], b.boxes_xyxy[None, :, 2:])
    shared = np.clip(high - low, 0.0, None).prod(axis=2)
    inside = (shared > NESTED_SHARE * area_a[:, None]) & (area_a[:, None] < area_b[None, :])
    same_class = a.class_probabilities @ b.class_probabilities.T > SAME_CLASS
    return inside, shared > 0, same_class


def _at_one_depth(inner: MaskPatch, outer: MaskPatch, depth_m: Float32) -> bool:
    """Whether nothing tells that one is behind the other; what has no depth tells nothing."""
    medians = [_median_depth(mask, depth_m) for mask in (inner, outer)]
    step_m = DEPTH_STEP_M + DEPTH_STEP_SHARE * min(medians)
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
