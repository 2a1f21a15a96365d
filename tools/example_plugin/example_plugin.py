"""A detector and a recording format of another package.

After ``pip install ./tools/example_plugin``:

    deworldsg run FOLDER --set "perception.detector=red_things {least_px: 200}"
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import cv2
import msgspec
import numpy as np

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.recordings import source as ros
from deworldsg_ros.recordings.folders.dataset import (
    CAMERA_FRAME,
    WORLD_FRAME,
    Dataset,
    DatasetOptions,
    encode_png,
)
from deworldsg_ros.recordings.source import Role, RoleMessage, UsedTopic
from deworldsg_ros.scene.camera import Intrinsics, quaternion_from_rotation
from deworldsg_ros.scene.errors import RecordingError


class RedThings:
    """Finds things by their colour: each red patch is a box.

    Args:
        config: the section ``perception``.
        least_px: pixels of the smallest thing.
        names: of a red thing, and of all others.
    """

    default_score_threshold = 0.5

    def __init__(
        self,
        config: PerceptionConfig,
        *,
        least_px: Annotated[int, msgspec.Meta(ge=1)] = 50,
        names: tuple[str, str] = ("red thing", "thing"),
    ) -> None:
        self.classes = names
        self._least_px = least_px

    def detect(self, rgb: np.ndarray, score_threshold: float) -> Detections:
        """Objects of an image (H, W, 3), RGB."""
        red, green, blue = np.moveaxis(rgb.astype(np.int16), -1, 0)
        is_red = (red > 90) & (red > 2 * np.maximum(green, blue))
        _, _, patches, _ = cv2.connectedComponentsWithStats(is_red.astype(np.uint8))
        # The first patch is everything else.
        found = patches[1:][patches[1:, cv2.CC_STAT_AREA] >= self._least_px]
        left, top, width, height = found[:, :4].T.astype(np.float64)
        boxes = np.stack([left, top, left + width - 1, top + height - 1], axis=1)
        classes = np.tile([0.9, 0.1], (len(boxes), 1))
        return Detections(boxes, classes, np.full(len(boxes), 0.9))


class NumpyFolder(Dataset):
    """A folder with one frame a file: NAME.npz has ``rgb`` (H, W, 3) uint8, ``depth_mm`` (H, W)
    uint16, ``T_world_camera`` (4, 4), ``intrinsics`` (fx, fy, cx, cy) and ``stamp_ns``.
    """

    kind = "numpy_folder"
    expects = "frame_*.npz"

    def __init__(self, path: Path, options: DatasetOptions) -> None:
        super().__init__(path, options)
        self._files = sorted(path.glob("frame_*.npz"))
        if not self._files:
            raise RecordingError(f"{path} has no frame_*.npz")
        self.frame_count = len(self._files)
        types = {
            Role.RGB: ros.COMPRESSED_IMAGE,
            Role.DEPTH: ros.COMPRESSED_IMAGE,
            Role.CAMERA_INFO: ros.CAMERA_INFO,
            Role.POSE: ros.POSE_STAMPED,
        }
        self.topics = {
            role: UsedTopic(self.expects, kind, self.frame_count) for role, kind in types.items()
        }

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether a file of a frame exists."""
        return next(path.glob("frame_*.npz"), None) is not None

    def messages(self) -> Iterator[RoleMessage]:
        """Pose, camera, depth and colour of each frame."""
        for file in self._files:
            with np.load(file, allow_pickle=False) as frame:
                stamp_ns, T = int(frame["stamp_ns"]), frame["T_world_camera"]
                rgb, depth_mm = frame["rgb"], frame["depth_mm"]
                intrinsics = Intrinsics(*frame["intrinsics"].tolist(), *depth_mm.shape[::-1])
            quaternion = quaternion_from_rotation(T[:3, :3])
            yield ros.pose_stamped(stamp_ns, WORLD_FRAME, T[:3, 3], quaternion)
            yield ros.camera_info(stamp_ns, CAMERA_FRAME, intrinsics)
            yield ros.compressed_depth(stamp_ns, CAMERA_FRAME, encode_png(depth_mm))
            bgr = np.ascontiguousarray(rgb[..., ::-1])
            yield ros.compressed_image(stamp_ns, CAMERA_FRAME, encode_png(bgr), "png")
