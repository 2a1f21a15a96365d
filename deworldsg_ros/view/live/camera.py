"""One frame of the camera as it is shown: the image with its masks, and where it was taken."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from deworldsg_ros.scene.arrays import Float64, UInt8, UInt16
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.view.colours import to_rgb

# The image of the panel. Smaller ones are sent faster, larger ones show no more in it.
SHOWN_WIDTH_PX = 360
JPEG_QUALITY = 80
MASK_OPACITY = 0.45
NO_NODE = (0.55, 0.58, 0.65)
# Images that the time slider can show; 15 kB each. Positions of the trail take 200 bytes each.
MOST_IMAGES = 600
MOST_POSES = 20_000
# The vertical field of view if no intrinsics are known: that of a RealSense D435.
USUAL_FOV_RAD = math.radians(42)


@dataclass(frozen=True)
class CameraView:
    """A frame.

    Attributes:
        stamp_ns: time of the image.
        T_world_camera: (4, 4) pose of the optical frame.
        rgb: (H, W, 3) uint8; None = only the pose is known.
        fov_rad: vertical field of view.
        instances: (H, W) uint16 instance image; None = not available.
        local: its objects in 3D; None = not available.
        node_ids: node that each row of `local` became.
    """

    stamp_ns: int
    T_world_camera: Float64
    rgb: UInt8 | None = None
    fov_rad: float = USUAL_FOV_RAD
    instances: UInt16 | None = None
    local: LocalGraph | None = None
    node_ids: tuple[int, ...] = ()

    @property
    def aspect(self) -> float:
        """Width over height."""
        return 4 / 3 if self.rgb is None else self.rgb.shape[1] / self.rgb.shape[0]


def view_of(
    local: LocalGraph, node_ids: Sequence[int], rgb: UInt8, instances: UInt16
) -> CameraView:
    """The view of a frame that was merged into the graph; `node_ids` of the rows of `local`."""
    grid = local.depth_grid
    fov_rad = USUAL_FOV_RAD
    if grid is not None:
        fov_rad = 2 * math.atan2(grid.intrinsics.height / 2, grid.intrinsics.fy)
    return CameraView(
        local.stamp_ns, local.T_world_camera, rgb, fov_rad, instances, local, tuple(node_ids)
    )


def with_masks(view: CameraView, colours: Mapping[int, str]) -> UInt8 | None:
    """The image with a tint on each mask, (h, w, 3) uint8, at most SHOWN_WIDTH_PX wide.

    Args:
        view: the frame.
        colours: #rrggbb of each published node; other objects are grey.
    """
    if view.rgb is None:
        return None
    height, width = view.rgb.shape[:2]
    scale = min(1.0, SHOWN_WIDTH_PX / width)
    size = (round(width * scale), round(height * scale))
    image = cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA)
    if view.instances is None or view.local is None:
        return np.asarray(image)
    masks = cv2.resize(view.instances, size, interpolation=cv2.INTER_NEAREST)
    tints = np.zeros((int(masks.max()) + 1, 3))
    opacities = np.zeros(len(tints))
    for value, node_id in zip(view.local.instance_ids.tolist(), view.node_ids):
        if value < len(tints):
            tints[value] = to_rgb(colours[node_id]) if node_id in colours else NO_NODE
            opacities[value] = MASK_OPACITY
    alpha = opacities[masks][..., None]
    return np.asarray(image * (1 - alpha) + 255 * tints[masks] * alpha, np.uint8)


def jpeg(image: UInt8) -> bytes:
    """A JPEG file of an RGB image (H, W, 3)."""
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return bytes(cv2.imencode(".jpg", image[..., ::-1], options)[1])


class Shot(NamedTuple):
    """A frame as it is kept: pose (4, 4) and, for the newest ones, the image as JPEG."""

    stamp_ns: int
    T_world_camera: Float64
    fov_rad: float
    aspect: float
    image: bytes


class Shots:
    """The camera's way: a pose of each frame, and the newest images."""

    def __init__(self) -> None:
        self._shots: deque[Shot] = deque(maxlen=MOST_POSES)

    def add(self, shot: Shot) -> None:
        """Add the newest frame."""
        self._shots.append(shot)
        if len(self._shots) > MOST_IMAGES:
            old = self._shots[-MOST_IMAGES - 1]
            self._shots[-MOST_IMAGES - 1] = old._replace(image=b"")

    def until(self, stamp_ns: int | None) -> list[Shot]:
        """Frames up to a time, the oldest first; None = all."""
        return [shot for shot in self._shots if stamp_ns is None or shot.stamp_ns <= stamp_ns]
