"""Where to put labels so that they do not cover one another: greedy, then improved in sweeps.

Everything is in pixels of the picture, y upwards; boxes are x1, y1, x2, y2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deworldsg_ros.scene.arrays import Float64

DIRECTIONS = 16
DISTANCES_PX = (9.0, 18.0, 30.0, 45.0, 62.0, 85.0, 112.0, 145.0)
SWEEPS = 3

OVERLAP_COST, OUTSIDE_COST, ANCHOR_COST, DISTANCE_COST = 6.0, 50.0, 60.0, 1.6
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
        return np.hstack([self.centres - self.sizes / 2, self.centres + self.sizes / 2])


def place(anchors: Float64, sizes: Float64, frame: Float64) -> Placement:
    """Put each label near its anchor, clear of the other labels and anchors, inside the frame.

    Args:
        anchors: (n, 2), what the labels belong to; the first are placed first.
        sizes: (n, 2), width and height of the labels.
        frame: (4,) box that they must stay inside.
    """
    centres = anchors.copy()
    for sweep in range(SWEEPS + 1):
        for index in range(len(anchors)):
            candidates = _candidates(anchors[index], sizes[index])
            boxes = np.hstack([candidates - sizes[index] / 2, candidates + sizes[index] / 2])
            others = np.arange(len(anchors)) != index
            if sweep == 0:
                others[index:] = False
            taken = Placement(centres[others], sizes[others]).boxes
            cost = OVERLAP_COST * overlap_areas(boxes, taken).sum(axis=1)
            cost += OUTSIDE_COST * _outside(boxes, frame)
            cost += ANCHOR_COST * _covered(boxes, anchors)
            cost += DISTANCE_COST * np.linalg.norm(candidates - anchors[index], axis=1)
            centres[index] = candidates[int(np.argmin(cost))]
    return Placement(centres, sizes)


def place_if_free(candidates: Float64, size: Float64, taken: Float64, frame: Float64) -> int | None:
    """The first candidate centre (m, 2) at which a label covers none of the boxes, or None."""
    boxes = np.hstack([candidates - size / 2, candidates + size / 2])
    free = (overlap_areas(boxes, taken).sum(axis=1) <= FREE_OVERLAP_PX2) & (
        _outside(boxes, frame) == 0
    )
    return int(np.argmax(free)) if free.any() else None


def overlap_areas(boxes: Float64, others: Float64) -> Float64:
    """(n, m) areas that n boxes share with m others."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    sides = np.maximum(high - low, 0.0)
    return np.asarray(sides[..., 0] * sides[..., 1])


def nearest_on_box(point: Float64, box: Float64) -> Float64:
    """The point of a box (4,) that is nearest to a point (2,)."""
    return np.clip(point, box[:2], box[2:])


def _candidates(anchor: Float64, size: Float64) -> Float64:
    """Centres around an anchor: the box's rim lies at each distance in each direction."""
    angles = np.pi / 2 + 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reach = rays * size / 2
    return np.concatenate([anchor + reach + distance * rays for distance in DISTANCES_PX])


def _outside(boxes: Float64, frame: Float64) -> Float64:
    """By how many pixels each box sticks out of the frame."""
    below = np.maximum(frame[:2] - boxes[:, :2], 0.0).sum(axis=1)
    return np.asarray(below + np.maximum(boxes[:, 2:] - frame[2:], 0.0).sum(axis=1))


def _covered(boxes: Float64, points: Float64, margin: float = 3.0) -> Float64:
    """How many points each box covers."""
    inside = (points[None] > boxes[:, None, :2] - margin) & (
        points[None] < boxes[:, None, 2:] + margin
    )
    return np.asarray(inside.all(axis=2).sum(axis=1), np.float64)
