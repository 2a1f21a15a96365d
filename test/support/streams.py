"""Messages of a small camera, as recordings have them."""

import dataclasses
import struct
from typing import Any

import numpy as np
from support import recordings
from support.recordings import encoded

from deworldsg_ros.recordings import source as ros
from deworldsg_ros.scene.camera import Intrinsics, rigid_motion

MS = 10**6
# A stamp that float64 cannot represent exactly.
T0 = 1_700_000_000_123_456_789
CAMERA = Intrinsics(10.0, 10.0, 4.0, 3.0, 8, 6)
SHAPE = (CAMERA.height, CAMERA.width)


def at(x: float = 0.0, y: float = 0.0, turn_rad: float = 0.0) -> np.ndarray:
    """A pose at (x, y, 0), rotated about z."""
    return rigid_motion(np.array([x, y, 0.0]), np.array([0.0, 0.0, turn_rad]))


def image(pixels: np.ndarray, encoding: str, stamp_ns: int = T0, **changes: Any) -> Any:
    return dataclasses.replace(recordings.raw_image(stamp_ns, pixels, encoding), **changes)


def rgb(stamp_ns: int = T0, value: int = 0) -> Any:
    return image(np.full((*SHAPE, 3), value, np.uint8), "rgb8", stamp_ns)


def depth(stamp_ns: int = T0, millimetres: int = 1500) -> Any:
    return image(np.full(SHAPE, millimetres, np.uint16), "16UC1", stamp_ns)


def compressed(data: bytes, format_: str) -> Any:
    return ros.compressed_image(T0, "camera", data, format_).message


def compressed_depth(counts: np.ndarray, a: float = 0, b: float = 0) -> bytes:
    """A compressedDepth payload: header with the parameters a and b, then a PNG."""
    return struct.pack("<iff", 0, a, b) + encoded(counts)


def camera_info(stamp_ns: int = T0, camera: Intrinsics = CAMERA) -> Any:
    return ros.camera_info(stamp_ns, recordings.CAMERA, camera).message


def pose(stamp_ns: int = T0, x: float = 0.0) -> Any:
    return ros.pose_stamped_from_matrix(stamp_ns, recordings.WORLD, at(x)).message
