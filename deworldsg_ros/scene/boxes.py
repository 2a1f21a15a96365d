"""Axis-aligned boxes in an image: x1, y1, x2, y2."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.arrays import Float64


def areas(boxes: Float64) -> Float64:
    """Areas (n,) of boxes (n, 4); 0 for an inverted box."""
    return np.asarray(np.clip(boxes[:, 2:] - boxes[:, :2], 0.0, None).prod(axis=1))


def shared_areas(boxes: Float64, others: Float64) -> Float64:
    """Areas (n, m) that boxes (n, 4) share with others (m, 4)."""
    # One array per side: numpy is several times slower with a last axis of two.
    x1, y1, x2, y2 = (np.ascontiguousarray(side)[:, None] for side in boxes.T)
    left, top, right, bottom = np.ascontiguousarray(others.T)
    width = np.maximum(np.minimum(x2, right) - np.maximum(x1, left), 0.0)
    return np.asarray(width * np.maximum(np.minimum(y2, bottom) - np.maximum(y1, top), 0.0))


def pairwise_iou(boxes: Float64, others: Float64) -> Float64:
    """Intersection over union, (n, m), of boxes (n, 4) and others (m, 4); 0 for empty boxes."""
    shared = shared_areas(boxes, others)
    union = areas(boxes)[:, None] + areas(others)[None, :] - shared
    return np.asarray(shared / np.maximum(union, 1e-12))
