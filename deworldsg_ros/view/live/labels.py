"""Labels that do not overlap on the screen of one browser."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float64
from deworldsg_ros.scene.boxes import shared_areas
from deworldsg_ros.view.live.drawing import rotations
from deworldsg_ros.view.live.tables import Label

# Of viser's labels at a scale of one: 12 px letters of this mean width, in a frame.
LETTER_PX = 6.6
HEIGHT_PX = 20.0
FRAME_PX = 12.0
# viser's anchors of a label, and where its centre then is, in half widths and half heights.
ANCHORS = (
    ("bottom-center", 0.0, -1.0),
    ("center-left", 1.0, 0.0),
    ("center-right", -1.0, 0.0),
    ("top-center", 0.0, 1.0),
)
# Objects that cover less than a pixel or two need no label.
FARTHEST_M = 60.0


class Camera(NamedTuple):
    """The camera of a browser.

    Attributes:
        position: (3,) world, metres.
        wxyz: (4,) of its optical axes (x right, y down, z forward) to world.
        fov_rad: vertical field of view.
        width, height: of the view, pixels.
    """

    position: Float64
    wxyz: Float64
    fov_rad: float
    width: float
    height: float

    def project(self, points: Float64) -> tuple[Float64, Float64]:
        """Pixels (n, 2), y downwards, and depths (n,) in metres of points (n, 3)."""
        local = (points - self.position) @ rotations(np.asarray(self.wxyz, np.float64)[None])[0]
        depths = local[:, 2]
        focal_px = self.height / 2 / np.tan(self.fov_rad / 2)
        middle = np.array([self.width, self.height]) / 2
        return middle + focal_px * local[:, :2] / np.maximum(depths, 1e-6)[:, None], depths


class Placed(NamedTuple):
    """A label that is shown, and its anchor for viser."""

    label: Label
    anchor: str


def place(labels: Sequence[Label], camera: Camera, most: int) -> list[Placed]:
    """The labels that have room, at most so many; those of more weight first.

    A label stands above its point, or beside, or below. Without room it is not shown.
    """
    if not labels or most < 1:
        return []
    points_px, depths = camera.project(np.array([label.position for label in labels]))
    sizes = np.array([(FRAME_PX + LETTER_PX * len(label.text), HEIGHT_PX) for label in labels])
    in_view = _in_view(points_px, depths, camera)
    order = sorted(np.flatnonzero(in_view).tolist(), key=lambda index: -labels[index].weight)
    anchors = np.array([(x, y) for _, x, y in ANCHORS])
    taken = np.zeros((most, 4))
    placed: list[Placed] = []
    for index in order:
        half = sizes[index] / 2
        centres = points_px[index] + anchors * half
        boxes = np.hstack([centres - half, centres + half])
        free = shared_areas(boxes, taken[: len(placed)]).sum(axis=1) == 0
        if not free.any():
            continue
        best = int(np.argmax(free))
        taken[len(placed)] = boxes[best]
        placed.append(Placed(labels[index], ANCHORS[best][0]))
        if len(placed) == most:
            break
    return placed


def _in_view(points_px: Float64, depths: Float64, camera: Camera) -> Bool:
    inside = (points_px >= 0) & (points_px <= (camera.width, camera.height))
    return np.asarray(inside.all(axis=1) & (depths > 0.05) & (depths < FARTHEST_M))
