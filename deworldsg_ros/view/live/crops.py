"""The best photo of each object, among the images that the viewer has seen."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64, UInt8
from deworldsg_ros.view.live.camera import CameraView, jpeg

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
