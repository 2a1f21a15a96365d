"""Microsoft 7-Scenes: frame-NNNNNN.color.*, .depth.png, .pose.txt.

Two layouts are known. With a camera-intrinsics.txt the depth is taken as registered to colour,
0 = invalid, the poses are those of the colour camera, and the images are passed on as they are.
Without one the folder is as Microsoft distributes it: raw Kinect images, 65535 = invalid, poses of
the depth camera. Then colour is undistorted and depth is projected into the colour camera, with
the calibration below.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from deworldsg_ros.bags import messages as ros
from deworldsg_ros.bags.errors import RecordingError
from deworldsg_ros.bags.messages import Role, RoleMessage
from deworldsg_ros.bags.source import UsedTopic
from deworldsg_ros.datasets.dataset import (
    CAMERA_FRAME,
    WORLD_FRAME,
    Dataset,
    DatasetOptions,
    decode_image,
    encode_png,
    image_format,
    image_size,
    read_file,
)
from deworldsg_ros.datasets.registration import register_depth
from deworldsg_ros.scene.camera import (
    Float64,
    Intrinsics,
    check_pose,
    pose_from_quaternion,
    quaternion_from_rotation,
)
from deworldsg_ros.scene.errors import RefusedInput

SENSOR_RATE_HZ = 30.0
# Stamps count from here: a ROS time of zero means "unset" to many programs.
FIRST_STAMP_NS = 10**9
NO_DEPTH = 65535
COLOR_NAME = re.compile(r"frame-(\d+)\.color\.(?:jpg|jpeg|png)$")

# The Kinect v1 of the data set. The depth camera's values are the publisher's; the colour camera
# was calibrated against it on the RedKitchen sequence (it sits 26 mm to the right of it).
DEPTH_FX_FY_CX_CY = (585.0, 585.0, 320.0, 240.0)
COLOR_FX_FY_CX_CY = (528.41, 528.41, 320.32, 236.72)
COLOR_K1 = -0.0153
BASELINE_M = 0.026


class SevenScenes(Dataset):
    """One sequence folder of 7-Scenes, see the module.

    Attributes:
        frame_numbers: number of the frame in its file names, by its stamp in nanoseconds.

    Raises:
        RecordingError: names the file that was expected.
    """

    kind = "7scenes"
    expects = "frame-NNNNNN.color.png (or .jpg), .depth.png and .pose.txt"

    def __init__(self, path: Path, options: DatasetOptions) -> None:
        super().__init__(path, options)
        self._colors = {
            int(match[1]): file
            for file in sorted(path.iterdir())
            if (match := COLOR_NAME.match(file.name))
        }
        if not self._colors:
            raise RecordingError(f"7-Scenes folder {path}: {_where_else(path)}")
        self.registered = (path / "camera-intrinsics.txt").exists() or bool(options.intrinsics)
        size = image_size(next(iter(self._colors.values())))
        fx_fy_cx_cy = options.intrinsics or (
            _read_intrinsics(path / "camera-intrinsics.txt")
            if self.registered
            else COLOR_FX_FY_CX_CY
        )
        self.intrinsics = Intrinsics(*fx_fy_cx_cy, *size)
        self._depth_camera = Intrinsics(*DEPTH_FX_FY_CX_CY, *size)
        self.frame_count = len(self._colors)
        self.frame_numbers = {
            self._stamp_ns(place, index): index for place, index in enumerate(self._colors)
        }
        first = next(iter(self._colors.values()))
        self.topics = {
            Role.RGB: UsedTopic(f"frame-*.color{first.suffix}", ros.COMPRESSED_IMAGE, len(self)),
            Role.DEPTH: UsedTopic("frame-*.depth.png", ros.COMPRESSED_IMAGE, len(self)),
            Role.CAMERA_INFO: UsedTopic(
                "camera-intrinsics.txt" if self.registered else "(built-in calibration)",
                ros.CAMERA_INFO,
                len(self),
            ),
            Role.POSE: UsedTopic("frame-*.pose.txt", ros.POSE_STAMPED, len(self)),
        }

    def __len__(self) -> int:
        return self.frame_count

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether there are files named frame-NNNNNN.color.*, here or one level below."""
        # Data sets in 3RScan's layout name theirs alike, and have this besides.
        if (path / "_info.txt").exists():
            return False
        return any(True for _ in path.glob("frame-*.color.*")) or any(
            True for _ in path.glob("seq-*/frame-*.color.*")
        )

    def messages(self) -> Iterator[RoleMessage]:
        """camera_info, pose, depth and RGB of each frame; frames without a valid pose are left."""
        for place, (index, color_path) in enumerate(self._colors.items()):
            stem = color_path.name[: color_path.name.index(".")]
            depth_path = self.path / f"{stem}.depth.png"
            pose_path = self.path / f"{stem}.pose.txt"
            wanted = (depth_path, pose_path) if self.options.poses_needed else (depth_path,)
            missing = next((file for file in wanted if not file.exists()), None)
            if missing is not None:
                self.drops["missing_file"] += 1
                self.losses.append(f"{missing.name} is missing: its frame is left out")
                continue
            T_world_camera = None
            try:
                T_world_camera = _read_pose(pose_path)
            except RefusedInput as refusal:
                if self.options.poses_needed:
                    self.drops[refusal.reason] += 1
                    continue
            try:
                messages = self._frame(
                    self._stamp_ns(place, index),
                    color_path,
                    depth_path,
                    np.eye(4) if T_world_camera is None else T_world_camera,
                )
            except RecordingError as error:
                self.drops["decode_failed"] += 1
                self.losses.append(f"{error}: its frame is left out")
                continue
            for message in messages:
                if T_world_camera is not None or message.role is not Role.POSE:
                    yield message

    def _stamp_ns(self, place: int, index: int) -> int:
        if self.options.rate_hz:
            return FIRST_STAMP_NS + round(place * 1e9 / self.options.rate_hz)
        # Every fourth frame of the 30 Hz sensor comes at 7.5 Hz.
        return FIRST_STAMP_NS + round(index * 1e9 / SENSOR_RATE_HZ)

    def _frame(
        self, stamp_ns: int, color_path: Path, depth_path: Path, T_world_camera: Float64
    ) -> list[RoleMessage]:
        color, depth = read_file(color_path), read_file(depth_path)
        color_format = image_format(color_path)
        if not self.registered:
            color, depth = self._register(color, depth, color_path, depth_path)
            color_format = "png"
            # The poses are the depth camera's: the colour camera is at x = baseline in it.
            T_world_camera = T_world_camera @ _translation_x(BASELINE_M)
        return [
            ros.camera_info(stamp_ns, CAMERA_FRAME, self.intrinsics),
            ros.pose_stamped(
                stamp_ns,
                WORLD_FRAME,
                T_world_camera[:3, 3],
                quaternion_from_rotation(T_world_camera[:3, :3]),
            ),
            ros.compressed_depth(stamp_ns, CAMERA_FRAME, depth),
            ros.compressed_image(stamp_ns, CAMERA_FRAME, color, color_format),
        ]

    def _register(
        self, color: bytes, depth: bytes, color_path: Path, depth_path: Path
    ) -> tuple[bytes, bytes]:
        bgr = decode_image(color, cv2.IMREAD_COLOR, color_path)
        depth_mm = decode_image(depth, cv2.IMREAD_UNCHANGED, depth_path)
        if depth_mm.dtype != np.uint16 or depth_mm.ndim != 2:
            raise RecordingError(f"{depth_path} is {depth_mm.dtype}: wanted 16-bit grey")
        undistorted = cv2.undistort(bgr, self.intrinsics.matrix, np.array([COLOR_K1, 0, 0, 0]))
        registered = register_depth(
            np.where(depth_mm == NO_DEPTH, 0, depth_mm).astype(np.uint16),
            self._depth_camera,
            self.intrinsics,
            _translation_x(-BASELINE_M),
        )
        return encode_png(np.asarray(undistorted, np.uint8)), encode_png(registered)


def _translation_x(x_m: float) -> Float64:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def _where_else(path: Path) -> str:
    sequences = sorted(folder.name for folder in path.glob("seq-*") if folder.is_dir())
    expected = "expected frame-NNNNNN.color.png (or .jpg) in it"
    if sequences:
        return f"{expected}; it holds the sequences {', '.join(sequences)}: name one of them"
    return expected


def _read_intrinsics(path: Path) -> tuple[float, float, float, float]:
    try:
        K = np.array(read_file(path).split(), np.float64).reshape(3, 3)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}; wanted a 3x3 camera matrix") from error
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _read_pose(path: Path) -> Float64:
    """T_world_camera of a pose file; raises RefusedInput ``invalid_pose``."""
    try:
        T = np.array(path.read_text().split(), np.float64).reshape(4, 4)
    except (OSError, ValueError) as error:
        raise RefusedInput("invalid_pose", f"{path}: {error}; wanted a 4x4 matrix") from error
    check_pose(T)
    # Printed decimals are not quite a rotation; the message's quaternion is exactly one.
    return pose_from_quaternion(T[:3, 3], quaternion_from_rotation(T[:3, :3]))
