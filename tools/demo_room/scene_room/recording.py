"""Writes frames into a rosbag2 recording (MCAP) with the message types of ROS 2 Jazzy."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from .render import CX, CY, FOCAL_PX, HEIGHT, WIDTH

START_NS = 1_750_000_000_000_000_000
PERIOD_NS = 100_000_000
CAMERA_FRAME, WORLD_FRAME = "camera_color_optical_frame", "world"
# compressed_depth_image_transport starts with its ConfigHeader: int32 format (0 = inverse depth)
# and two float32 quantisation parameters. Readers of 16UC1 ignore them.
COMPRESSED_DEPTH_HEADER = bytes(12)


class RecordingWriter:
    """Writes one message per topic and frame, all with the stamp of the frame."""

    def __init__(self, folder: Path) -> None:
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._topics = {
            "/rgb/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
            "/depth/image_raw/compressedDepth": "sensor_msgs/msg/CompressedImage",
            "/rgb/camera_info": "sensor_msgs/msg/CameraInfo",
            "/camera/pose": "geometry_msgs/msg/PoseStamped",
        }

    def __enter__(self) -> RecordingWriter:
        self._writer.open()
        self._connections = {
            topic: self._writer.add_connection(topic, kind, typestore=self._store)
            for topic, kind in self._topics.items()
        }
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.close()

    def write(
        self,
        index: int,
        jpeg: bytes,
        depth_png: bytes,
        T_world_camera: NDArray[np.float64],
    ) -> None:
        """Write frame `index` (0, 1, …)."""
        types = self._store.types
        stamp_ns = START_NS + index * PERIOD_NS
        stamp = types["builtin_interfaces/msg/Time"](
            sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000
        )
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=CAMERA_FRAME)
        image = types["sensor_msgs/msg/CompressedImage"]
        self._put(
            "/camera/pose",
            stamp_ns,
            types["geometry_msgs/msg/PoseStamped"](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=WORLD_FRAME),
                pose=self._pose(T_world_camera),
            ),
        )
        self._put("/rgb/camera_info", stamp_ns, self._camera_info(header))
        self._put(
            "/depth/image_raw/compressedDepth",
            stamp_ns,
            image(
                header=header,
                format="16UC1; compressedDepth png",
                data=np.frombuffer(COMPRESSED_DEPTH_HEADER + depth_png, np.uint8),
            ),
        )
        self._put(
            "/rgb/image_raw/compressed",
            stamp_ns,
            image(
                header=header,
                format="bgr8; jpeg compressed bgr8",
                data=np.frombuffer(jpeg, np.uint8),
            ),
        )

    def _put(self, topic: str, stamp_ns: int, message: object) -> None:
        connection = self._connections[topic]
        data = self._store.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, stamp_ns, data)

    def _pose(self, T_world_camera: NDArray[np.float64]) -> object:
        types = self._store.types
        x, y, z, w = quaternion_xyzw(T_world_camera[:3, :3])
        px, py, pz = (float(v) for v in T_world_camera[:3, 3])
        return types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](x=px, y=py, z=pz),
            orientation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
        )

    def _camera_info(self, header: object) -> object:
        types = self._store.types
        k = np.array([FOCAL_PX, 0, CX, 0, FOCAL_PX, CY, 0, 0, 1.0])
        return types["sensor_msgs/msg/CameraInfo"](
            header=header,
            height=HEIGHT,
            width=WIDTH,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=k,
            r=np.eye(3).ravel(),
            p=np.insert(k, [3, 6, 9], 0.0),
            binning_x=0,
            binning_y=0,
            roi=types["sensor_msgs/msg/RegionOfInterest"](
                x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
            ),
        )


def depth_png(depth_mm: NDArray[np.uint16]) -> bytes:
    """Lossless 16-bit PNG."""
    # Neighbouring pixels have equal values. Without a row filter the file is a third smaller.
    options = [cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
    ok, data = cv2.imencode(".png", depth_mm, options)
    if not ok:
        raise RuntimeError("OpenCV could not encode a 16-bit PNG")
    return bytes(data.tobytes())


def quaternion_xyzw(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Unit quaternion of a rotation matrix (3, 3), w ≥ 0."""
    r = rotation
    # Bar-Itzhack: the eigenvector of the largest eigenvalue. eigh reads the lower triangle.
    k = np.zeros((4, 4))
    k[0, 0] = r[0, 0] - r[1, 1] - r[2, 2]
    k[1, :2] = r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2]
    k[2, :3] = r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]
    k[3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)
    _, vectors = np.linalg.eigh(k, UPLO="L")
    q = vectors[:, -1] * (1 if vectors[3, -1] >= 0 else -1)
    return float(q[0]), float(q[1]), float(q[2]), float(q[3])
