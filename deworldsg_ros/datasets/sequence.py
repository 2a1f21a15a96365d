"""What 3RScan, ReplicaSSG and the rendered rooms share: a scan folder with sequence/_info.txt."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.bags import messages as ros
from deworldsg_ros.bags.errors import RecordingError
from deworldsg_ros.bags.messages import Role, RoleMessage
from deworldsg_ros.bags.source import RawRoleMessage, UsedTopic
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
    serialized,
)
from deworldsg_ros.scene.camera import (
    Float64,
    Intrinsics,
    check_pose,
    pose_from_quaternion,
    quaternion_from_rotation,
)
from deworldsg_ros.scene.errors import RefusedInput

# Stamps count from here: a ROS time of zero means "unset" to many programs.
FIRST_STAMP_NS = 10**9
INFO_NAME = "_info.txt"
COLOR_NAME = re.compile(r"frame-(\d+)\.color\.(?:jpg|jpeg|png)$")

# Axes of the turned camera in those of the camera: x is what was -y, y is what was x.
TURNED_AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class SensorInfo:
    """What _info.txt says of the two cameras.

    Attributes:
        color, depth: intrinsics of the images as they lie on disk.
        depth_units_per_m: value of a depth pixel at one metre.
    """

    color: Intrinsics
    depth: Intrinsics
    depth_units_per_m: float


class SequenceDataset(Dataset):
    """One scan of a data set in 3RScan's layout.

    Attributes:
        default_rate_hz: frames a second, where the data set has no stamps of its own.
        turned: whether the images are turned by 90 degrees clockwise.
        pose_suffix: ending of the pose files.
        how_to_get: one sentence for whoever lacks a file.
        frame_numbers: number of the frame in its file names, by its stamp in nanoseconds.

    Raises:
        RecordingError: names the file that was expected, and how to get it.
    """

    default_rate_hz: ClassVar[float]
    turned: ClassVar[bool] = False
    pose_suffix: ClassVar[str] = ".pose.txt"
    how_to_get: ClassVar[str]

    def __init__(self, path: Path, options: DatasetOptions) -> None:
        super().__init__(path, options)
        self.sequence = sequence_folder(path)
        if self.sequence.parent.name:
            self.name = self.sequence.resolve().parent.name
        info_path = self.sequence / INFO_NAME
        if not info_path.exists():
            raise RecordingError(
                f"{self.kind} scan {path}: {info_path} is missing; {self.how_to_get}"
            )
        self._colors = {
            int(match[1]): file
            for file in sorted(self.sequence.iterdir())
            if (match := COLOR_NAME.match(file.name))
        }
        if not self._colors:
            raise RecordingError(
                f"{self.kind} scan {path}: {self.sequence} holds no frame-NNNNNN.color.jpg; "
                f"{self.how_to_get}"
            )
        first = next(iter(self._colors.values()))
        info = read_info(info_path)
        if image_size(first) != (info.color.width, info.color.height):
            raise RecordingError(
                f"{first} is {'x'.join(map(str, image_size(first)))}: {info_path} says "
                f"{info.color.width}x{info.color.height}"
            )
        if options.intrinsics:
            size = info.color.width, info.color.height
            info = SensorInfo(
                Intrinsics(*options.intrinsics, *size), info.depth, info.depth_units_per_m
            )
        self.info = info
        self.intrinsics = turned_intrinsics(info.color) if self.turned else info.color
        self.depth_suffix = self._choose_depth(first)
        rate_hz = options.rate_hz or self.default_rate_hz
        self._stamps_ns = {
            number: FIRST_STAMP_NS + round(number * 1e9 / rate_hz) for number in self._colors
        }
        self.frame_numbers = {stamp_ns: number for number, stamp_ns in self._stamps_ns.items()}
        self.frame_count = len(self._colors)
        self.topics = {
            role: UsedTopic(name, msgtype, self.frame_count)
            for role, name, msgtype in (
                (Role.RGB, f"frame-*.color{first.suffix}", ros.COMPRESSED_IMAGE),
                (Role.DEPTH, f"frame-*{self.depth_suffix}", ros.COMPRESSED_IMAGE),
                (Role.CAMERA_INFO, INFO_NAME, ros.CAMERA_INFO),
                (Role.POSE, f"frame-*{self.pose_suffix}", ros.POSE_STAMPED),
            )
        }

    def messages(self) -> Iterator[RoleMessage]:
        """camera_info, pose, depth and RGB of each frame; frames without a valid pose are left."""
        # What is decoded at once is not worth compressing: half of the time of reading a frame.
        return self._messages(stored=True)

    def raw_messages(self) -> Iterator[RawRoleMessage]:
        """The same, serialized and compressed."""
        return serialized(self._messages(stored=False))

    def _messages(self, *, stored: bool) -> Iterator[RoleMessage]:
        for number, color_path in self._colors.items():
            depth_path = self.file(number, self.depth_suffix)
            pose_path = self.file(number, self.pose_suffix)
            wanted = (depth_path, pose_path) if self.options.poses_needed else (depth_path,)
            missing = next((file for file in wanted if not file.exists()), None)
            if missing is not None:
                self.drops["missing_file"] += 1
                self.losses.append(f"{missing.name} is missing: its frame is left out")
                continue
            T_world_camera = None
            try:
                T_world_camera = read_pose(pose_path)
            except RefusedInput as refusal:
                if self.options.poses_needed:
                    self.drops[refusal.reason] += 1
                    continue
            try:
                messages = self._frame(
                    self._stamps_ns[number],
                    color_path,
                    depth_path,
                    np.eye(4) if T_world_camera is None else T_world_camera,
                    stored,
                )
            except RecordingError as error:
                self.drops["decode_failed"] += 1
                self.losses.append(f"{error}: its frame is left out")
                continue
            for message in messages:
                if T_world_camera is not None or message.role is not Role.POSE:
                    yield message

    def file(self, number: int, suffix: str) -> Path:
        """File of a frame."""
        return self.sequence / f"frame-{number:06d}{suffix}"

    def _choose_depth(self, first: Path) -> str:
        """Ending of the depth files; raises RecordingError where a wanted kind is absent."""
        if self.options.depth_source == "rendered":
            number = COLOR_NAME.match(first.name)
            path = self.file(int(number[1]) if number else 0, ".rendered.depth.png")
            if not path.exists():
                raise RecordingError(
                    f"{path} is missing: rendered depth was asked for, this scan has the "
                    "sensor's only"
                )
            return ".rendered.depth.png"
        return ".depth.pgm"

    def _frame(
        self,
        stamp_ns: int,
        color_path: Path,
        depth_path: Path,
        T_world_camera: Float64,
        stored: bool,
    ) -> list[RoleMessage]:
        color, color_format = read_file(color_path), image_format(color_path)
        depth_mm = self._depth_mm(depth_path)
        if self.turned:
            bgr = decode_image(color, cv2.IMREAD_COLOR, color_path)
            bgr = np.asarray(cv2.rotate(bgr, cv2.ROTATE_90_CLOCKWISE), np.uint8)
            color = encode_png(bgr, stored=stored)
            color_format = "png"
            depth_mm = np.asarray(cv2.rotate(depth_mm, cv2.ROTATE_90_CLOCKWISE), np.uint16)
            T_world_camera = turned_pose(T_world_camera)
        return [
            ros.camera_info(stamp_ns, CAMERA_FRAME, self.intrinsics),
            ros.pose_stamped(
                stamp_ns,
                WORLD_FRAME,
                T_world_camera[:3, 3],
                quaternion_from_rotation(T_world_camera[:3, :3]),
            ),
            ros.compressed_depth(stamp_ns, CAMERA_FRAME, encode_png(depth_mm, stored=stored)),
            ros.compressed_image(stamp_ns, CAMERA_FRAME, color, color_format),
        ]

    def _depth_mm(self, path: Path) -> NDArray[np.uint16]:
        """Depth of the colour image's pixels, (H, W) uint16 millimetres; raises RecordingError."""
        units = decode_image(read_file(path), cv2.IMREAD_UNCHANGED, path)
        if units.dtype != np.uint16 or units.ndim != 2:
            raise RecordingError(f"{path} is {units.dtype}: wanted 16-bit grey")
        size = (units.shape[1], units.shape[0])
        if size != (self.info.color.width, self.info.color.height):
            if size != (self.info.depth.width, self.info.depth.height):
                raise RecordingError(
                    f"{path} is {size[0]}x{size[1]}: {INFO_NAME} says "
                    f"{self.info.depth.width}x{self.info.depth.height}"
                )
            units = resample(units, self.info.depth, self.info.color)
        if self.info.depth_units_per_m != 1000.0:
            units = np.rint(units * (1000.0 / self.info.depth_units_per_m)).astype(np.uint16)
        return np.asarray(units, np.uint16)


def sequence_folder(path: Path) -> Path:
    """Folder of the frames, for a scan's folder or that folder itself."""
    return (
        path
        if path.name == "sequence" and not (path / "sequence").is_dir()
        else (path / "sequence")
    )


def dataset_root(path: Path) -> Path:
    """Root of the data set that a scan's folder (or its frames') belongs to."""
    return sequence_folder(path.resolve()).parents[2]


def has_frames(path: Path, suffix: str) -> bool:
    """Whether a scan has frame files with this ending."""
    return any(True for _ in sequence_folder(path).glob(f"frame-*{suffix}"))


def looks_like_scan(path: Path) -> bool:
    """Whether a folder is a scan in 3RScan's layout."""
    return (sequence_folder(path) / INFO_NAME).exists()


def turned_intrinsics(intrinsics: Intrinsics) -> Intrinsics:
    """Intrinsics of an image turned by 90 degrees clockwise, as 3DSSG's users compute them.

    The principal point goes to H - cy, where pixel centres at integers would make it H - 1 - cy;
    the numbers that are compared were all made with H - cy.
    """
    return Intrinsics(
        fx=intrinsics.fy,
        fy=intrinsics.fx,
        cx=intrinsics.height - intrinsics.cy,
        cy=intrinsics.cx,
        width=intrinsics.height,
        height=intrinsics.width,
    )


def turned_pose(T_world_camera: Float64) -> Float64:
    """Pose of the camera whose image is turned by 90 degrees clockwise."""
    T = T_world_camera.copy()
    T[:3, :3] = T_world_camera[:3, :3] @ TURNED_AXES
    return T


def resample(
    depth: NDArray[np.uint16], depth_camera: Intrinsics, color_camera: Intrinsics
) -> NDArray[np.uint16]:
    """Depth on the colour image's pixels, for two cameras in one place; 0 outside the image."""
    u = np.arange(color_camera.width, dtype=np.float64)
    v = np.arange(color_camera.height, dtype=np.float64)
    columns = (u - color_camera.cx) / color_camera.fx * depth_camera.fx + depth_camera.cx
    rows = (v - color_camera.cy) / color_camera.fy * depth_camera.fy + depth_camera.cy
    # The nearest pixel: between a near and a far surface there is nothing.
    column, row = np.rint(columns).astype(int), np.rint(rows).astype(int)
    inside_u = (column >= 0) & (column < depth_camera.width)
    inside_v = (row >= 0) & (row < depth_camera.height)
    taken = depth[
        np.clip(row, 0, depth_camera.height - 1)[:, None],
        np.clip(column, 0, depth_camera.width - 1),
    ]
    return np.where(inside_v[:, None] & inside_u, taken, 0).astype(np.uint16)


def read_info(path: Path) -> SensorInfo:
    """Read _info.txt; raises RecordingError with the key that was wanted."""
    values: dict[str, str] = {}
    for line in read_file(path).decode(errors="replace").splitlines():
        key, equals, value = line.partition("=")
        if equals:
            values[key.strip()] = value.strip()
    try:
        color = _camera(values, "Color")
        depth = _camera(values, "Depth")
        units_per_m = float(values.get("m_depthShift", "1000"))
    except KeyError as error:
        raise RecordingError(f"{path} has no {error.args[0]}: wanted one") from error
    except (ValueError, RefusedInput) as error:
        raise RecordingError(f"{path}: {error}") from error
    if not units_per_m > 0:
        raise RecordingError(f"{path}: m_depthShift is {units_per_m}: wanted > 0")
    return SensorInfo(color, depth, units_per_m)


def _camera(values: dict[str, str], which: str) -> Intrinsics:
    key = f"m_calibration{which}Intrinsic"
    numbers = [float(word) for word in values[key].split()]
    if len(numbers) != 16:
        raise ValueError(f"{key} has {len(numbers)} numbers: wanted 16, row by row")
    lower = which.lower()
    size = int(values[f"m_{lower}Width"]), int(values[f"m_{lower}Height"])
    return Intrinsics(numbers[0], numbers[5], numbers[2], numbers[6], *size)


def read_pose(path: Path) -> Float64:
    """T_world_camera (4, 4) of a pose file; raises RefusedInput ``invalid_pose``."""
    try:
        T = np.array(path.read_text().split(), np.float64).reshape(4, 4)
    except (OSError, ValueError) as error:
        raise RefusedInput("invalid_pose", f"{path}: {error}; wanted a 4x4 matrix") from error
    check_pose(T)
    # Printed decimals are not quite a rotation; the message's quaternion is exactly one.
    return pose_from_quaternion(T[:3, 3], quaternion_from_rotation(T[:3, :3]))
