"""Positions of labels that do not overlap: greedy, then improved in sweeps.

All coordinates are pixels of the picture, y upwards; boxes are x1, y1, x2, y2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.boxes import shared_areas

# Candidates of a label: a ring of directions at each distance from its anchor.
DIRECTIONS = 16
DISTANCES_PX = (9.0, 18.0, 30.0, 45.0, 62.0, 85.0, 112.0, 145.0)
# More sweeps over a room of 90 labels change nothing.
SWEEPS = 3

# Costs of a candidate: per px² of overlap, px outside the frame, covered anchor, px of distance.
OVERLAP_COST, OUTSIDE_COST, ANCHOR_COST, DISTANCE_COST = 6.0, 50.0, 60.0, 1.6
# Text boxes include a margin: an overlap of this area is not visible.
FREE_OVERLAP_PX2 = 4.0


@dataclass(frozen=True)
class Placement:
    """Boxes of n labels.

    Attributes:
        centres: (n, 2) float64, pixels.
        sizes: (n, 2) float64, pixels.
    """

    centres: Float64
    sizes: Float64

    @property
    def boxes(self) -> Float64:
        """(n, 4) float64."""
        return boxes_at(self.centres, self.sizes)


def boxes_at(centres: Float64, sizes: Float64) -> Float64:
    """(n, 4) boxes of centres (n, 2) and sizes (n, 2); or (4,) of (2,) and (2,)."""
    return np.hstack([centres - sizes / 2, centres + sizes / 2])


def place(anchors: Float64, sizes: Float64, frame: Float64) -> Placement:
    """Place each label near its anchor and inside the frame, off other labels and anchors.

    Args:
        anchors: (n, 2), positions of the objects; the first are placed first.
        sizes: (n, 2), width and height of the labels.
        frame: (4,) box around all labels.
    """
    centres = anchors.copy()
    for sweep in range(SWEEPS + 1):
        for index in range(len(anchors)):
            candidates = _candidates(anchors[index], sizes[index])
            boxes = boxes_at(candidates, sizes[index])
            others = np.arange(len(anchors)) != index
            if sweep == 0:
                others[index:] = False
            taken = Placement(centres[others], sizes[others]).boxes
            cost = OVERLAP_COST * shared_areas(boxes, taken).sum(axis=1)
            cost += OUTSIDE_COST * _outside(boxes, frame)
            cost += ANCHOR_COST * _covered(boxes, anchors)
            cost += DISTANCE_COST * np.linalg.norm(candidates - anchors[index], axis=1)
            centres[index] = candidates[int(np.argmin(cost))]
    return Placement(centres, sizes)


def place_if_free(candidates: Float64, size: Float64, taken: Float64, frame: Float64) -> int | None:
    """Index of the first candidate centre (m, 2) at which a label covers no box, or None."""
    boxes = boxes_at(candidates, size)
    free = (shared_areas(boxes, taken).sum(axis=1) <= FREE_OVERLAP_PX2) & (
        _outside(boxes, frame) == 0
    )
    return int(np.argmax(free)) if free.any() else None


def nearest_on_box(point: Float64, box: Float64) -> Float64:
    """The point of a box (4,) nearest to a point (2,)."""
    return np.clip(point, box[:2], box[2:])


def _candidates(anchor: Float64, size: Float64) -> Float64:
    """Centres around an anchor, with the box's rim at each distance in each direction."""
    angles = np.pi / 2 + 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reach = rays * size / 2
    return np.concatenate([anchor + reach + distance * rays for distance in DISTANCES_PX])


def _outside(boxes: Float64, frame: Float64) -> Float64:
    """(n,) pixels by which boxes exceed the frame."""
    below = np.maximum(frame[:2] - boxes[:, :2], 0.0).sum(axis=1)
    return np.asarray(below + np.maximum(boxes[:, 2:] - frame[2:], 0.0).sum(axis=1))


def _covered(boxes: Float64, points: Float64) -> Float64:
    """(n,) number of points that each box covers, with a margin of 3 pixels."""
    inside = (points[None] > boxes[:, None, :2] - 3.0) & (points[None] < boxes[:, None, 2:] + 3.0)
    return np.asarray(inside.all(axis=2).sum(axis=1), np.float64)
