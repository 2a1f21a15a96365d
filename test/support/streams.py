"""Messages as plain objects with the attributes of ROS messages."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from deworldsg_ros.scene.camera import quaternion_from_rotation

WIDTH, HEIGHT = 8, 6
K = (10.0, 0.0, 4.0, 0.0, 10.0, 3.0, 0.0, 0.0, 1.0)
MS = 10**6
# A stamp that float64 cannot represent exactly.
T0 = 1_700_000_000_123_456_789


def header(stamp_ns: int, frame_id: str = "camera") -> SimpleNamespace:
    sec, nanosec = divmod(stamp_ns, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame_id)


def image(pixels: np.ndarray, encoding: str, stamp_ns: int = T0, **changes: Any) -> SimpleNamespace:
    message = SimpleNamespace(
        header=header(stamp_ns),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.shape[1] * pixels.itemsize * (pixels.shape[2] if pixels.ndim == 3 else 1),
        data=np.frombuffer(pixels.tobytes(), np.uint8),
    )
    vars(message).update(changes)
    return message


def rgb(stamp_ns: int = T0, value: int = 0) -> SimpleNamespace:
    return image(np.full((HEIGHT, WIDTH, 3), value, np.uint8), "rgb8", stamp_ns)


def depth(stamp_ns: int = T0, millimetres: int = 1500) -> SimpleNamespace:
    return image(np.full((HEIGHT, WIDTH), millimetres, np.uint16), "16UC1", stamp_ns)


def compressed(data: bytes, format_: str) -> SimpleNamespace:
    return SimpleNamespace(header=header(T0), format=format_, data=np.frombuffer(data, np.uint8))


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def compressed_depth(counts: np.ndarray, a: float = 0, b: float = 0) -> bytes:
    """A compressedDepth payload: header with the parameters a and b, then a PNG."""
    return struct.pack("<iff", 0, a, b) + png(counts)


def camera_info(stamp_ns: int = T0, k: tuple[float, ...] = K) -> SimpleNamespace:
    return SimpleNamespace(header=header(stamp_ns), k=np.array(k), width=WIDTH, height=HEIGHT)


def pose(
    stamp_ns: int = T0, x: float = 0.0, frame_id: str = "map", w: float = 1.0
) -> SimpleNamespace:
    return SimpleNamespace(
        header=header(stamp_ns, frame_id),
        pose=SimpleNamespace(
            position=SimpleNamespace(x=x, y=0.0, z=0.0),
            orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=w),
        ),
    )


def odometry(stamp_ns: int = T0, x: float = 0.0, child: str = "camera") -> SimpleNamespace:
    stamped = pose(stamp_ns, x)
    return SimpleNamespace(
        header=stamped.header,
        child_frame_id=child,
        pose=SimpleNamespace(pose=stamped.pose, covariance=np.zeros(36)),
    )


def transform(parent: str, child: str, T: np.ndarray, stamp_ns: int = T0) -> SimpleNamespace:
    x, y, z, w = quaternion_from_rotation(T[:3, :3])
    return SimpleNamespace(
        header=header(stamp_ns, parent),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=T[0, 3], y=T[1, 3], z=T[2, 3]),
            rotation=SimpleNamespace(x=x, y=y, z=z, w=w),
        ),
    )


def tf(*transforms: SimpleNamespace) -> SimpleNamespace:
    return SimpleNamespace(transforms=list(transforms))
