"""Microsoft 7-Scenes: frame-NNNNNN.color.*, .depth.png, .pose.txt.

There are two layouts. With a camera-intrinsics.txt, the depth is registered to colour, 0 is
invalid, the poses are of the colour camera, and the images are used as they are. Without this file,
the folder is as Microsoft distributes it: raw Kinect images, 65535 is invalid, poses of the depth
camera. Colour is then undistorted and depth is projected into the colour camera, with the
calibration below.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from deworldsg_ros.recordings.folders.dataset import (
    DatasetOptions,
    decode_image,
    encode_png,
    image_format,
    image_size,
    read_file,
)
from deworldsg_ros.recordings.folders.frame_files import FIRST_STAMP_NS, FrameFiles, color_files
from deworldsg_ros.scene.arrays import Float64, UInt16
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RecordingError

# --- Registration of a depth image to the colour camera.


def register_depth(
    depth_mm: UInt16, depth_camera: Intrinsics, color_camera: Intrinsics, T_color_depth: Float64
) -> UInt16:
    """Project depth into the colour camera; of several surfaces in a pixel, the nearest wins.

    Args:
        depth_mm: (H, W) uint16 of the depth camera; 0 = invalid.
        depth_camera: its intrinsics.
        color_camera: intrinsics of the output image.
        T_color_depth: (4, 4) float64, depth camera to colour camera, metres.

    Returns:
        (H', W') uint16 millimetres on the grid of the colour camera; 0 = no depth.
    """
    rows, columns = np.nonzero(depth_mm)
    z = depth_mm[rows, columns] * 1e-3
    points_depth = np.stack(
        [
            (columns - depth_camera.cx) / depth_camera.fx * z,
            (rows - depth_camera.cy) / depth_camera.fy * z,
            z,
        ]
    )
    x, y, z = T_color_depth[:3, :3] @ points_depth + T_color_depth[:3, 3:]
    front = z > 1e-3
    x, y, z = x[front], y[front], z[front]
    u = np.rint(color_camera.fx * x / z + color_camera.cx).astype(np.int64)
    v = np.rint(color_camera.fy * y / z + color_camera.cy).astype(np.int64)
    inside = (u >= 0) & (u < color_camera.width) & (v >= 0) & (v < color_camera.height)
    nearest = np.full(color_camera.height * color_camera.width, 65535, np.uint16)
    z_mm = np.minimum(np.rint(z[inside] * 1e3), 65534).astype(np.uint16)
    np.minimum.at(nearest, v[inside] * color_camera.width + u[inside], z_mm)
    nearest[nearest == 65535] = 0
    return nearest.reshape(color_camera.height, color_camera.width)


# --- Microsoft 7-Scenes: frame-NNNNNN.color.*, .depth.png, .pose.txt.
#
# There are two layouts. With a camera-intrinsics.txt, the depth is registered to colour, 0 is
# invalid, the poses are of the colour camera, and the images are used as they are. Without this
# file, the folder is as Microsoft distributes it: raw Kinect images, 65535 is invalid, poses of the
# depth camera. Colour is then undistorted and depth is projected into the colour camera, with the
# calibration below.

INTRINSICS_NAME = "camera-intrinsics.txt"
# Value of an invalid pixel in a raw depth image.
NO_DEPTH = 65535

# The Kinect v1 of the data set. The values of the depth camera are those of the publisher. The
# colour camera was calibrated against it on the RedKitchen sequence: it is 26 mm to the right.
DEPTH_FX_FY_CX_CY = (585.0, 585.0, 320.0, 240.0)
COLOR_FX_FY_CX_CY = (528.41, 528.41, 320.32, 236.72)
COLOR_K1 = -0.0153
BASELINE_M = 0.026


class SevenScenes(FrameFiles):
    """One sequence folder of 7-Scenes; the module describes the two layouts.

    Raises:
        RecordingError: names the missing file.
    """

    kind = "7scenes"
    depth_suffix = ".depth.png"
    expects = "frame-NNNNNN.color.png (or .jpg), .depth.png and .pose.txt"

    def __init__(self, path: Path, options: DatasetOptions) -> None:
        super().__init__(path, options)
        colors = color_files(path)
        if not colors:
            raise RecordingError(f"7-Scenes folder {path}: {_where_else(path)}")
        self.registered = (path / INTRINSICS_NAME).exists() or bool(options.intrinsics)
        size = image_size(next(iter(colors.values())))
        fx_fy_cx_cy = options.intrinsics or (
            _read_intrinsics(path / INTRINSICS_NAME) if self.registered else COLOR_FX_FY_CX_CY
        )
        self.intrinsics = Intrinsics(*fx_fy_cx_cy, *size)
        self._depth_camera = Intrinsics(*DEPTH_FX_FY_CX_CY, *size)
        # The file numbers count frames of the sensor, and some copies keep every N-th frame only.
        numbers = range(len(colors)) if options.rate_hz else colors
        rate_hz = options.rate_hz or 30.0  # of the Kinect
        stamps_ns = [FIRST_STAMP_NS + round(number * 1e9 / rate_hz) for number in numbers]
        calibration = INTRINSICS_NAME if self.registered else "(built-in calibration)"
        self._set_frames(colors, stamps_ns, calibration)

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether there are files named frame-NNNNNN.color.*, here or one level below."""
        # Data sets in the layout of 3RScan have the same file names, and this file.
        if (path / "_info.txt").exists():
            return False
        return any(True for _ in path.glob("frame-*.color.*")) or any(
            True for _ in path.glob("seq-*/frame-*.color.*")
        )

    def _camera_pose(self, T_world_file: Float64) -> Float64:
        if self.registered:
            return T_world_file
        # The file has the pose of the depth camera; the colour camera is at x = baseline in it.
        return T_world_file @ _translation_x(BASELINE_M)

    def _images(self, color_path: Path, depth_path: Path, stored: bool) -> tuple[bytes, str, bytes]:
        color, depth = read_file(color_path), read_file(depth_path)
        if self.registered:
            return color, image_format(color_path), depth
        bgr = decode_image(color, cv2.IMREAD_COLOR, color_path)
        depth_mm = decode_image(depth, cv2.IMREAD_UNCHANGED, depth_path)
        if depth_mm.dtype != np.uint16 or depth_mm.ndim != 2:
            raise RecordingError(f"{depth_path} is {depth_mm.dtype}: expected 16-bit grey")
        undistorted = cv2.undistort(bgr, self.intrinsics.matrix, np.array([COLOR_K1, 0, 0, 0]))
        registered = register_depth(
            np.where(depth_mm == NO_DEPTH, 0, depth_mm).astype(np.uint16),
            self._depth_camera,
            self.intrinsics,
            _translation_x(-BASELINE_M),
        )
        return (
            encode_png(np.asarray(undistorted, np.uint8), stored=stored),
            "png",
            encode_png(registered, stored=stored),
        )


def _translation_x(x_m: float) -> Float64:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def _where_else(path: Path) -> str:
    sequences = sorted(folder.name for folder in path.glob("seq-*") if folder.is_dir())
    expected = "expected frame-NNNNNN.color.png (or .jpg) in it"
    if sequences:
        return f"it holds the sequences {', '.join(sequences)}: expected one of them"
    return expected


def _read_intrinsics(path: Path) -> tuple[float, float, float, float]:
    try:
        K = np.array(read_file(path).split(), np.float64).reshape(3, 3)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}; expected a 3x3 camera matrix") from error
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
