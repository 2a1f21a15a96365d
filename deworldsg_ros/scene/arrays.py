"""Array types, softmax, and boxes in images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# --- Names of the array types that the package uses.

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Float16 = NDArray[np.float16]
Int64 = NDArray[np.int64]
Int32 = NDArray[np.int32]
Int16 = NDArray[np.int16]
Int8 = NDArray[np.int8]
UInt64 = NDArray[np.uint64]
UInt32 = NDArray[np.uint32]
UInt16 = NDArray[np.uint16]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]


# --- Softmax. scipy.special has it, too, but takes a third of the start of a node to import.


class SoftmaxWeights(NamedTuple):
    """Parts of the softmax of logits (..., C).

    Attributes:
        best: (..., 1) the greatest logits.
        exponentials: (..., C) of the logits without the greatest one.
        totals: (..., 1) sums of the exponentials.
    """

    best: Float64
    exponentials: Float64
    totals: Float64


def softmax_weights(logits: Float64) -> SoftmaxWeights:
    """See `SoftmaxWeights`; logits (..., C) float64, C > 0."""
    best = logits.max(axis=-1, keepdims=True)
    exponentials = np.exp(logits - best)
    return SoftmaxWeights(best, exponentials, exponentials.sum(axis=-1, keepdims=True))


def softmax(logits: Float64) -> Float64:
    """The distributions of logits (..., C) float64; each sums to 1."""
    _, exponentials, totals = softmax_weights(logits)
    return np.asarray(exponentials / totals)


# --- Axis-aligned boxes in an image: x1, y1, x2, y2.


def corners_of(boxes_cxcywh: Float64) -> Float64:
    """Corners (n, 4) of boxes (n, 4) given by centre, width and height."""
    centres, halves = boxes_cxcywh[:, :2], boxes_cxcywh[:, 2:] / 2
    return np.hstack([centres - halves, centres + halves])


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
