"""Non-maximum suppression that keeps track of the suppressed boxes."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.boxes import pairwise_iou


def cluster_boxes(
    boxes_xyxy: Float64,
    scores: Float64,
    classes: Int64,
    *,
    same_class_iou: float,
    any_class_iou: float,
) -> Int64:
    """Greedy non-maximum suppression, with the suppressing box of each box.

    The best remaining box suppresses the remaining boxes of its class whose IoU exceeds
    `same_class_iou`, and those of any class whose IoU exceeds `any_class_iou`.

    Args:
        boxes_xyxy: (n, 4) pixels.
        scores: (n,).
        classes: (n,) most likely class.
        same_class_iou: IoU above which boxes of one class show one object.
        any_class_iou: IoU above which any boxes show one object.

    Returns:
        (n,) int64: row of the box that suppressed each; its own row if it was kept.
    """
    order = np.argsort(-scores, kind="stable")
    iou = pairwise_iou(boxes_xyxy[order], boxes_xyxy[order])
    same_class = classes[order][:, None] == classes[order][None, :]
    covers = (iou > any_class_iou) | (same_class & (iou > same_class_iou))
    keeper = np.full(len(order), -1, dtype=np.int64)
    for rank in range(len(order)):
        if keeper[rank] < 0:
            keeper[(keeper < 0) & covers[rank]] = rank
            keeper[rank] = rank
    result = np.empty(len(order), dtype=np.int64)
    result[order] = order[keeper]
    return result
