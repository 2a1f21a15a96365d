"""Scans with sequence/_info.txt: 3RScan, ReplicaSSG and the rendered rooms."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from deworldsg_ros.recordings.folders.dataset import (
    DatasetOptions,
    decode_image,
    encode_png,
    image_format,
    image_size,
    read_file,
    read_json,
)
from deworldsg_ros.recordings.folders.frame_files import FIRST_STAMP_NS, FrameFiles, color_files
from deworldsg_ros.scene.arrays import Float64, UInt16
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RecordingError, RefusedInput

# --- Common layout of 3RScan, ReplicaSSG and the rendered rooms: a scan with sequence/_info.txt.

INFO_NAME = "_info.txt"
RENDERED_DEPTH = ".rendered.depth.png"

# R_camera_rotated: axes of the rotated camera in the camera frame; its x is -y, its y is x.
ROTATED_AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class SensorInfo:
    """Calibration of the two cameras, from _info.txt.

    Attributes:
        color, depth: intrinsics of the stored images.
        depth_units_per_m: value of a depth pixel at one metre.
    """

    color: Intrinsics
    depth: Intrinsics
    depth_units_per_m: float


class SequenceDataset(FrameFiles):
    """One scan of a data set in the layout of 3RScan.

    Attributes:
        default_rate_hz: frames per second; these data sets have no stamps.
        rotated: whether the images are rotated by 90 degrees clockwise.
        how_to_get: where a missing file can be downloaded, one sentence.

    Raises:
        RecordingError: names the missing file and how to get it.
    """

    default_rate_hz: ClassVar[float]
    rotated: ClassVar[bool] = False
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
        colors = color_files(self.sequence)
        if not colors:
            raise RecordingError(
                f"{self.kind} scan {path}: {self.sequence} holds no frame-NNNNNN.color.jpg; "
                f"{self.how_to_get}"
            )
        first = next(iter(colors.values()))
        info = read_info(info_path)
        if image_size(first) != (info.color.width, info.color.height):
            raise RecordingError(
                f"{first} is {'x'.join(map(str, image_size(first)))}: expected "
                f"{info.color.width}x{info.color.height}, as {info_path} states"
            )
        if options.intrinsics:
            size = info.color.width, info.color.height
            info = SensorInfo(
                Intrinsics(*options.intrinsics, *size), info.depth, info.depth_units_per_m
            )
        self.info = info
        self.intrinsics = rotated_intrinsics(info.color) if self.rotated else info.color
        self.depth_suffix = self._choose_depth(min(colors))
        rate_hz = options.rate_hz or self.default_rate_hz
        stamps_ns = [FIRST_STAMP_NS + round(number * 1e9 / rate_hz) for number in colors]
        self._set_frames(colors, stamps_ns, INFO_NAME)

    def file(self, number: int, suffix: str) -> Path:
        """File of a frame."""
        return self.sequence / f"frame-{number:06d}{suffix}"

    def _choose_depth(self, first: int) -> str:
        """Ending of the depth files, by the first frame; raises RecordingError without them."""
        if self.options.depth_source == "rendered":
            path = self.file(first, RENDERED_DEPTH)
            if not path.exists():
                raise RecordingError(
                    f"{path} is missing: --depth-source is rendered, but this scan has only "
                    "depth of the sensor. Use --depth-source sensor"
                )
            return RENDERED_DEPTH
        return ".depth.pgm"

    def _camera_pose(self, T_world_file: Float64) -> Float64:
        return rotated_pose(T_world_file) if self.rotated else T_world_file

    def _images(self, color_path: Path, depth_path: Path, stored: bool) -> tuple[bytes, str, bytes]:
        color, color_format = read_file(color_path), image_format(color_path)
        depth_mm = self._depth_mm(depth_path)
        if self.rotated:
            bgr = decode_image(color, cv2.IMREAD_COLOR, color_path)
            bgr = np.asarray(cv2.rotate(bgr, cv2.ROTATE_90_CLOCKWISE), np.uint8)
            color, color_format = encode_png(bgr, stored=stored), "png"
            depth_mm = np.asarray(cv2.rotate(depth_mm, cv2.ROTATE_90_CLOCKWISE), np.uint16)
        return color, color_format, encode_png(depth_mm, stored=stored)

    def _depth_mm(self, path: Path) -> UInt16:
        """Depth of the colour image's pixels, (H, W) uint16 millimetres; raises RecordingError."""
        units = decode_image(read_file(path), cv2.IMREAD_UNCHANGED, path)
        if units.dtype != np.uint16 or units.ndim != 2:
            raise RecordingError(f"{path} is {units.dtype}: expected 16-bit grey")
        size = (units.shape[1], units.shape[0])
        if size != (self.info.color.width, self.info.color.height):
            if size != (self.info.depth.width, self.info.depth.height):
                raise RecordingError(
                    f"{path} is {size[0]}x{size[1]}: expected "
                    f"{self.info.depth.width}x{self.info.depth.height}, as {INFO_NAME} states"
                )
            units = resample(units, self.info.depth, self.info.color)
        if self.info.depth_units_per_m != 1000.0:
            units = np.rint(units * (1000.0 / self.info.depth_units_per_m)).astype(np.uint16)
        return np.asarray(units, np.uint16)


def sequence_folder(path: Path) -> Path:
    """Folder of the frames, for the folder of a scan or that folder itself."""
    return (
        path
        if path.name == "sequence" and not (path / "sequence").is_dir()
        else (path / "sequence")
    )


def dataset_root(path: Path) -> Path:
    """Root of the data set of a scan, for the folder of the scan or of its frames."""
    return sequence_folder(path.resolve()).parents[2]


def has_frames(path: Path, suffix: str) -> bool:
    """Whether a scan has frame files with this ending."""
    return any(True for _ in sequence_folder(path).glob(f"frame-*{suffix}"))


def looks_like_scan(path: Path) -> bool:
    """Whether a folder is a scan in the layout of 3RScan."""
    return (sequence_folder(path) / INFO_NAME).exists()


def rotated_intrinsics(intrinsics: Intrinsics) -> Intrinsics:
    """Intrinsics of an image rotated by 90 degrees clockwise, as in published results on 3DSSG.

    The principal point becomes H - cy, as in those results. With pixel centres at integers it is
    H - 1 - cy.
    """
    return Intrinsics(
        fx=intrinsics.fy,
        fy=intrinsics.fx,
        cx=intrinsics.height - intrinsics.cy,
        cy=intrinsics.cx,
        width=intrinsics.height,
        height=intrinsics.width,
    )


def rotated_pose(T_world_camera: Float64) -> Float64:
    """Pose (4, 4) of the camera whose image is rotated by 90 degrees clockwise."""
    T = T_world_camera.copy()
    T[:3, :3] = T_world_camera[:3, :3] @ ROTATED_AXES
    return T


def resample(depth: UInt16, depth_camera: Intrinsics, color_camera: Intrinsics) -> UInt16:
    """Depth on the pixels of the colour image, for two cameras at one position; 0 outside.

    Args:
        depth: (H, W) uint16.
        depth_camera: its intrinsics.
        color_camera: intrinsics of the output, (H', W') uint16.
    """
    u = np.arange(color_camera.width, dtype=np.float64)
    v = np.arange(color_camera.height, dtype=np.float64)
    columns = (u - color_camera.cx) / color_camera.fx * depth_camera.fx + depth_camera.cx
    rows = (v - color_camera.cy) / color_camera.fy * depth_camera.fy + depth_camera.cy
    # The nearest pixel: an interpolated depth between a near and a far surface is on neither.
    column, row = np.rint(columns).astype(int), np.rint(rows).astype(int)
    inside_u = (column >= 0) & (column < depth_camera.width)
    inside_v = (row >= 0) & (row < depth_camera.height)
    taken = depth[
        np.clip(row, 0, depth_camera.height - 1)[:, None],
        np.clip(column, 0, depth_camera.width - 1),
    ]
    return np.where(inside_v[:, None] & inside_u, taken, 0).astype(np.uint16)


def read_info(path: Path) -> SensorInfo:
    """Read _info.txt; raises RecordingError, which names the missing or wrong key."""
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
        raise RecordingError(f"{path} has no {error.args[0]}: expected one") from error
    except (ValueError, RefusedInput) as error:
        raise RecordingError(f"{path}: {error}") from error
    # 16 bits: between one unit a kilometre and a thousand a millimetre.
    if not 1e-3 <= units_per_m <= 1e6:
        raise RecordingError(f"{path}: m_depthShift is {units_per_m}: expected > 0, 1e-3 to 1e6")
    return SensorInfo(color, depth, units_per_m)


def _camera(values: dict[str, str], which: str) -> Intrinsics:
    key = f"m_calibration{which}Intrinsic"
    numbers = [float(word) for word in values[key].split()]
    if len(numbers) != 16:
        raise ValueError(f"{key} has {len(numbers)} numbers: expected 16, row by row")
    lower = which.lower()
    size = int(values[f"m_{lower}Width"]), int(values[f"m_{lower}Height"])
    return Intrinsics(numbers[0], numbers[5], numbers[2], numbers[6], *size)


# --- Rendered rooms: the layout of ReplicaSSG with instance images, recorded detections, gt.json.

GROUND_TRUTH_NAME = "gt.json"


def belongs_to_rooms(path: Path) -> bool:
    """Whether a scan has instance images and recorded detections."""
    return has_frames(path, ".instance.png") and has_frames(path, ".frontend.json")


class RoomsScan(SequenceDataset):
    """One rendered room."""

    kind = "rooms"
    expects = (
        "sequence/_info.txt and sequence/frame-NNNNNN.{color.jpg,depth.pgm,pose.txt,instance.png,"
        "frontend.json}"
    )
    default_rate_hz = 10.0
    how_to_get = "run unpack.py of the rendered rooms, which writes all files"

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether it is a scan with instance images and recorded detections."""
        return looks_like_scan(path) and belongs_to_rooms(path)


def read_ground_truth(scan_folder: Path) -> dict[str, Any] | None:
    """Content of a room's gt.json; None if there is none. Raises RecordingError."""
    path = sequence_folder(scan_folder).parent / GROUND_TRUTH_NAME
    if not path.exists():
        return None
    content = read_json(path)
    if not isinstance(content, dict) or "objects" not in content:
        raise RecordingError(f"{path}: there is no key objects; expected one")
    return content


# --- ReplicaSSG over Replica: data/SCAN/sequence, 960x540, no rotation.


def belongs_to_replica(path: Path) -> bool:
    """Whether the data set of a scan has the annotations of ReplicaSSG."""
    return (dataset_root(path) / "ReplicaSSG").is_dir()


class ReplicaScan(SequenceDataset):
    """One scene of ReplicaSSG."""

    kind = "replica"
    expects = (
        "sequence/_info.txt and sequence/frame-NNNNNN.{color.jpg,depth.pgm,pose.txt}, with "
        "ReplicaSSG/ beside data/"
    )
    default_rate_hz = 30.0
    how_to_get = (
        "download Replica (https://github.com/facebookresearch/Replica-Dataset) and run the "
        "scripts of https://github.com/Howardkhh/ReplicaSSG, which render the frames"
    )

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether it is a scan of a data set with ReplicaSSG/, but no rendered room."""
        return looks_like_scan(path) and belongs_to_replica(path) and not belongs_to_rooms(path)


# --- 3RScan with annotations of 3DSSG: data/SCAN/sequence, images rotated upright by 90 degrees.
#
# The phone was held upright but its images are stored in landscape format: they are rotated
# clockwise, with the intrinsics and the poses (`rotated_intrinsics`, `rotated_pose`). Depth is
# rendered from the mesh if such files exist (``frame-*.rendered.depth.png``, as in published
# results), else it is of the sensor; `DatasetOptions.depth_source` selects it.


class RioScan(SequenceDataset):
    """One scan of 3RScan."""

    kind = "3rscan"
    expects = "sequence/_info.txt and sequence/frame-NNNNNN.{color.jpg,depth.pgm,pose.txt}"
    default_rate_hz = 10.0
    rotated = True
    how_to_get = (
        "agree to the terms at https://github.com/WaldJohannaU/3RScan, download the scan and "
        "unpack its sequence.zip into sequence/"
    )

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether it is a scan that is neither of ReplicaSSG nor a rendered room."""
        return looks_like_scan(path) and not belongs_to_replica(path) and not belongs_to_rooms(path)

    def _choose_depth(self, first: int) -> str:
        if self.options.depth_source == "auto" and self.file(first, RENDERED_DEPTH).exists():
            return RENDERED_DEPTH
        return super()._choose_depth(first)


# --- Instance images of the data sets that have them: the object id of each pixel.


def read_instances(source: object, stamp_ns: int) -> UInt16 | None:
    """Object ids of a frame's pixels, (H, W) uint16, 0 = none; None without an instance image.

    Raises:
        RecordingError: for an image that cannot be decoded.
    """
    # Instance images are not rotated: they do not fit rotated images.
    if not isinstance(source, SequenceDataset) or source.rotated:
        return None
    if stamp_ns not in source.frame_numbers:
        return None
    path = source.file(source.frame_numbers[stamp_ns], ".instance.png")
    if not path.exists():
        return None
    return np.asarray(decode_image(read_file(path), cv2.IMREAD_UNCHANGED, path), np.uint16)
