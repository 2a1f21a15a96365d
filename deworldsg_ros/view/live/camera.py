"""The camera of the live view: one frame as it is shown, and the best photo of each object."""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from deworldsg_ros.scene.arrays import Float64, UInt8, UInt16
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.view.colours import to_rgb
from deworldsg_ros.wire import messages as wire

# --- One frame of the camera as it is shown: the image with its masks, and where it was taken.

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

    def last(self, stamp_ns: int | None) -> Shot | None:
        """The newest frame, not after a time; None = there is none."""
        return next(
            (
                shot
                for shot in reversed(self._shots)
                if stamp_ns is None or shot.stamp_ns <= stamp_ns
            ),
            None,
        )


# --- Joins the topics of a frame by its stamp: image, masks, objects, and the nodes they became.

# Frames that wait for their last part: three seconds of images at 10 Hz.
MOST_WAITING = 30
PARTS = ("rgb", "instances", "local", "node_ids")


class FrameJoiner:
    """Collects the parts of frames, as functions that decode them.

    Args:
        period_s: a frame that is complete earlier after the one before is left out, undecoded.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._waiting: OrderedDict[int, dict[str, Callable[[], Any]]] = OrderedDict()
        self._given_s = float("-inf")

    def add(
        self, part: str, stamp_ns: int, decode: Callable[[], Any], now_s: float
    ) -> CameraView | None:
        """Add a part, one of PARTS; returns the frame if it is complete and not too early.

        Raises:
            RefusedInput: if a part of a complete frame cannot be used.
        """
        parts = self._waiting.setdefault(stamp_ns, {})
        parts[part] = decode
        if len(self._waiting) > MOST_WAITING:
            self._waiting.popitem(last=False)
        if len(parts) < len(PARTS):
            return None
        del self._waiting[stamp_ns]
        if now_s - self._given_s < self._period_s:
            return None
        self._given_s = now_s
        rgb: UInt8 = parts["rgb"]()
        instances: UInt16 = parts["instances"]()
        local: LocalGraph = parts["local"]()
        node_ids: Sequence[int] = parts["node_ids"]()
        return view_of(local, node_ids, rgb, instances)


# --- The best photo of each object, among the images that the viewer has seen.

# At most so many photos of at most this side: 10 MB.
MOST_CROPS = 1000
MOST_SIDE_PX = 192
# Around the box of the object, as a fraction of its longer side.
MARGIN = 0.12
# An object that the image cuts off is shown if nothing better was seen.
CUT_OFF_FACTOR = 0.3
# A new photo has to be this much better: otherwise it would change in every frame.
BETTER = 1.1


class Crop(NamedTuple):
    """A photo: its score, its time, and a JPEG file."""

    score: float
    stamp_ns: int
    image: bytes


class BestViews:
    """One photo for each node: that with the most mask pixels, times the detector's score."""

    def __init__(self, most: int = MOST_CROPS) -> None:
        self._most = most
        self._crops: dict[int, Crop] = {}

    def __getitem__(self, node_id: int) -> Crop | None:
        return self._crops.get(node_id)

    def __len__(self) -> int:
        return len(self._crops)

    def stamps(self) -> dict[int, int]:
        """The time of each photo, by node."""
        return {node_id: crop.stamp_ns for node_id, crop in self._crops.items()}

    def add(self, view: CameraView) -> None:
        """Keep the photos of a frame that are better than the known ones."""
        if view.rgb is None or view.local is None:
            return
        local = view.local
        height, width = view.rgb.shape[:2]
        for row, node_id in enumerate(view.node_ids):
            box = local.boxes_xyxy[row] * (width / local.width)
            score = float(local.pixel_counts[row] * local.scores[row])
            if box.min() < 2 or box[2] > width - 2 or box[3] > height - 2:
                score *= CUT_OFF_FACTOR
            known = self._crops.get(node_id)
            if known is None or score > BETTER * known.score:
                self._put(node_id, Crop(score, view.stamp_ns, jpeg(_cut(view.rgb, box))))

    def merge(self, removed: list[wire.RemovedNode]) -> None:
        """Forget removed nodes; a node that replaces one takes the better photo."""
        for node in removed:
            crop = self._crops.pop(node.id, None)
            if crop is not None and node.merged_into is not None:
                known = self._crops.get(node.merged_into)
                if known is None or crop.score > known.score:
                    self._put(node.merged_into, crop)

    def _put(self, node_id: int, crop: Crop) -> None:
        # The photo that has not changed for the longest time is the first.
        self._crops.pop(node_id, None)
        self._crops[node_id] = crop
        if len(self._crops) > self._most:
            del self._crops[next(iter(self._crops))]


def _cut(rgb: UInt8, box_xyxy: Float64) -> UInt8:
    margin = MARGIN * float(np.max(box_xyxy[2:] - box_xyxy[:2]))
    height, width = rgb.shape[:2]
    low = np.clip(np.floor(box_xyxy[:2] - margin), 0, (width - 1, height - 1)).astype(int)
    high = np.clip(np.ceil(box_xyxy[2:] + margin), low + 1, (width, height)).astype(int)
    crop = rgb[low[1] : high[1], low[0] : high[0]]
    scale = min(1.0, MOST_SIDE_PX / max(crop.shape[:2]))
    size = (max(round(crop.shape[1] * scale), 1), max(round(crop.shape[0] * scale), 1))
    return np.asarray(cv2.resize(crop, size, interpolation=cv2.INTER_AREA))
