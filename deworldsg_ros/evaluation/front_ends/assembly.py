"""Assembly of detections into the output of perception."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from deworldsg_ros.perception.instance_image import instance_image
from deworldsg_ros.perception.protocols import MaskPatch
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.scene.arrays import Float64, UInt16
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary

# Probabilities are clipped this far from 0 and 1: the logits stay finite (within ±13.8).
LOGIT_MARGIN = 1e-6
# An object is detected from this size on: visible pixels, and both sides of its box.
# bags/README.md counts an object as visible from the same number of pixels on.
MIN_VISIBLE_PX = 200
MIN_BOX_SIDE_PX = 10


@dataclass(frozen=True)
class Detection:
    """One object in the image, before selection.

    Attributes:
        box_xyxy: (4,) pixels.
        class_probabilities: (C,) float64, sums to one.
        score: confidence of the detector.
        instance: value of the object in the instance image of the frame.
    """

    box_xyxy: Float64
    class_probabilities: Float64
    score: float
    instance: int


@dataclass(frozen=True)
class Relation:
    """One relation between two detections.

    Attributes:
        subject, object: indices of the detections.
        score: confidence of the relation.
        probabilities: (R,) float64, of every predicate.
    """

    subject: int
    object: int
    score: float
    probabilities: Float64


@dataclass(frozen=True)
class FrameDetections:
    """Detections and relations of one frame.

    Attributes:
        detections: the detections.
        relations: relations between them, by index.
        instance_image: (H, W) uint16, value of the object of each pixel.
    """

    detections: Sequence[Detection]
    relations: Sequence[Relation]
    instance_image: UInt16


def logits(probabilities: Float64) -> Float64:
    """log(p / (1 - p)) of each probability, clipped to [`LOGIT_MARGIN`, 1 - `LOGIT_MARGIN`]."""
    inside = np.clip(probabilities, LOGIT_MARGIN, 1.0 - LOGIT_MARGIN)
    return np.asarray(np.log(inside / (1.0 - inside)))


def spread(stated: Mapping[int, float], count: int) -> Float64:
    """Distribution (count,) with the stated probabilities; the rest is spread evenly."""
    others = count - len(stated)
    left = max(0.0, 1.0 - sum(stated.values()))
    distribution = np.full(count, left / others if others else 0.0)
    for index, probability in stated.items():
        distribution[index] = probability
    return np.asarray(distribution / distribution.sum())


def visible_box(instances: UInt16, object_id: int) -> Float64 | None:
    """Box x1, y1, x2, y2 of an object's pixels; None if too few of them are visible."""
    mask = instances == object_id
    if int(np.count_nonzero(mask)) < MIN_VISIBLE_PX:
        return None
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    box = np.array([columns[0], rows[0], columns[-1], rows[-1]], np.float64)
    return None if (box[2:] - box[:2] < MIN_BOX_SIDE_PX).any() else box


def assemble(
    frame: RgbdFrame, vocabulary: Vocabulary, seen: FrameDetections, top_relations: int
) -> Perceived:
    """The frame graph and label image of a frame.

    A mask is the pixels of the instance image with the value of the object, inside the box.
    Detections are ordered by score. The `top_relations` relations with the highest score are kept.
    """
    detections, relations = seen.detections, seen.relations
    order = sorted(range(len(detections)), key=lambda index: -detections[index].score)
    row_of = {index: row for row, index in enumerate(order)}
    chosen = [detections[index] for index in order]
    width, height = frame.intrinsics.width, frame.intrinsics.height
    boxes = np.array([item.box_xyxy for item in chosen], np.float64).reshape(-1, 4)
    boxes = np.clip(boxes, 0.0, [width - 1.0, height - 1.0] * 2)
    classes = np.array([item.class_probabilities for item in chosen], np.float64)
    classes = classes.reshape(-1, len(vocabulary.classes))
    scores = np.array([item.score for item in chosen], np.float64)
    masks = [_cut(seen.instance_image, item.instance, box) for item, box in zip(chosen, boxes)]
    kept = sorted(relations, key=lambda item: -item.score)[:top_relations]
    pairs = [(row_of[item.subject], row_of[item.object]) for item in kept]
    predicates = np.array([item.probabilities for item in kept], np.float64)
    graph = FrameGraph(
        stamp_ns=frame.stamp_ns,
        frame_id="camera_rgb_optical_frame",
        width=width,
        height=height,
        vocabulary=vocabulary,
        boxes_xyxy=boxes,
        class_probabilities=classes,
        scores=scores,
        relations=Relations(
            np.array(pairs, np.int64).reshape(-1, 2),
            logits(predicates.reshape(-1, len(vocabulary.predicates))),
            np.array([item.score for item in kept], np.float64),
        ),
    )
    instances = instance_image(masks, classes.argmax(axis=1), scores, (height, width))
    empty = sum(not mask.pixels.any() for mask in masks)
    return Perceived(graph, instances, {"empty_mask": empty} if empty else {})


def _cut(instance_image: UInt16, value: int, box_xyxy: Float64) -> MaskPatch:
    # All pixels that the box touches.
    left, top = np.floor(box_xyxy[:2]).astype(int).tolist()
    right, bottom = np.ceil(box_xyxy[2:]).astype(int).tolist()
    patch = instance_image[top : bottom + 1, left : right + 1]
    return MaskPatch(top, left, patch == value)
