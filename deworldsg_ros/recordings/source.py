"""A source of messages by role, and these messages as classes of rosbags, without ROS."""

from __future__ import annotations

import functools
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple, Protocol

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import Intrinsics, quaternion_from_rotation

# --- The ROS messages of a posed RGB-D camera, as message classes of rosbags, without ROS.
#
# Bags and data set folders give these messages. `streams` reads attributes only, so a recording
# becomes the same frames in one process as in a replay through DDS.

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
STRING = "std_msgs/msg/String"
DETECTIONS = "vision_msgs/msg/Detection2DArray"

# vision_msgs 4, of ROS 2 Humble and later; rosbags does not have it.
_VISION_MSGS = {
    "Point2D": "float64 x\nfloat64 y",
    "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose",
    "Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox2D bbox\nstring id",
    "Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
}

# compressed_depth_image_transport writes this struct before the PNG: format, depth quantisation.
COMPRESSED_DEPTH_HEADER = struct.pack("<iff", 0, 0.0, 0.0)


class Role(str, Enum):
    """Role of a message in the pipeline."""

    RGB = "rgb"
    DEPTH = "depth"
    CAMERA_INFO = "camera_info"
    POSE = "pose"
    DETECTIONS = "detections"
    DETECTION_INSTANCES = "detection_instances"


@dataclass(frozen=True)
class RoleMessage:
    """One message of a recording.

    Attributes:
        role: its role in the pipeline.
        msgtype: e.g. ``sensor_msgs/msg/Image``.
        stamp_ns: time in its header, nanoseconds.
        message: the decoded message; attributes as in ROS.
    """

    role: Role
    msgtype: str
    stamp_ns: int
    message: Any


@functools.lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Message classes and CDR of ROS 2 Jazzy, with detections of vision_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, fields in _VISION_MSGS.items():
        store.register(get_types_from_msg(fields, f"vision_msgs/msg/{name}"))
    return store


def decode(data: bytes, msgtype: str) -> Any:
    """Message of CDR bytes."""
    return typestore().deserialize_cdr(data, msgtype)


def encode(message: Any, msgtype: str) -> bytes:
    """CDR bytes of a message."""
    return bytes(typestore().serialize_cdr(message, msgtype))


def stamp_ns_of_cdr(data: bytes) -> int:
    """Stamp of a serialized message, nanoseconds, without decoding it; its header comes first."""
    sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(sec) * 10**9 + int(nanosec)


def header(stamp_ns: int, frame_id: str) -> Any:
    """std_msgs/Header."""
    types = typestore().types
    sec, nanosec = divmod(stamp_ns, 10**9)
    return types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec), frame_id=frame_id
    )


def compressed_image(
    stamp_ns: int, frame_id: str, encoded: bytes, image_format: str
) -> RoleMessage:
    """RGB image as CompressedImage; `encoded` is the content of a JPEG or PNG file."""
    message = typestore().types[COMPRESSED_IMAGE](
        header=header(stamp_ns, frame_id),
        format=image_format,
        data=np.frombuffer(encoded, np.uint8),
    )
    return RoleMessage(Role.RGB, COMPRESSED_IMAGE, stamp_ns, message)


def compressed_depth(stamp_ns: int, frame_id: str, png: bytes) -> RoleMessage:
    """Depth image as CompressedImage; `png` is a 16-bit PNG file, millimetres, 0 = invalid."""
    message = typestore().types[COMPRESSED_IMAGE](
        header=header(stamp_ns, frame_id),
        format="16UC1; compressedDepth png",
        data=np.frombuffer(COMPRESSED_DEPTH_HEADER + png, np.uint8),
    )
    return RoleMessage(Role.DEPTH, COMPRESSED_IMAGE, stamp_ns, message)


def camera_info(stamp_ns: int, frame_id: str, intrinsics: Intrinsics) -> RoleMessage:
    """CameraInfo of a rectified pinhole camera."""
    types = typestore().types
    k = intrinsics.matrix
    message = types[CAMERA_INFO](
        header=header(stamp_ns, frame_id),
        height=intrinsics.height,
        width=intrinsics.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=k.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([k, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
    )
    return RoleMessage(Role.CAMERA_INFO, CAMERA_INFO, stamp_ns, message)


def string_message(role: Role, stamp_ns: int, text: str) -> RoleMessage:
    """A text, such as JSON, as std_msgs/String."""
    return RoleMessage(role, STRING, stamp_ns, typestore().types[STRING](data=text))


def pose_stamped(
    stamp_ns: int, frame_id: str, translation_m: Float64, quat_xyzw: Float64
) -> RoleMessage:
    """PoseStamped of the RGB optical frame in the world frame `frame_id`."""
    types = typestore().types
    x, y, z = (float(value) for value in translation_m)
    qx, qy, qz, qw = (float(value) for value in quat_xyzw)
    message = types[POSE_STAMPED](
        header=header(stamp_ns, frame_id),
        pose=types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](x=x, y=y, z=z),
            orientation=types["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
        ),
    )
    return RoleMessage(Role.POSE, POSE_STAMPED, stamp_ns, message)


def pose_stamped_from_matrix(stamp_ns: int, frame_id: str, T_world_camera: Float64) -> RoleMessage:
    """PoseStamped of the RGB optical frame, from its pose (4, 4) in the world frame `frame_id`."""
    quat_xyzw = quaternion_from_rotation(T_world_camera[:3, :3])
    return pose_stamped(stamp_ns, frame_id, T_world_camera[:3, 3], quat_xyzw)


# --- A source of messages by role: the common interface of bags and folders.


class RawRoleMessage(NamedTuple):
    """One serialized message of a recording.

    `stamp_ns` is the time in its header; `log_time_ns` is the time of recording, for the replay.
    """

    role: Role
    msgtype: str
    stamp_ns: int
    log_time_ns: int
    data: bytes


def serialize(item: RoleMessage, log_time_ns: int | None = None) -> RawRoleMessage:
    """A message as CDR bytes; without a time of recording, its stamp is used."""
    data = encode(item.message, item.msgtype)
    log_time_ns = item.stamp_ns if log_time_ns is None else log_time_ns
    return RawRoleMessage(item.role, item.msgtype, item.stamp_ns, log_time_ns, data)


@dataclass(frozen=True)
class UsedTopic:
    """Origin of the messages of a role: a topic of a bag, or files of a folder."""

    name: str
    msgtype: str
    count: int


class Source(Protocol):
    """A bag or a folder, open for reading.

    Attributes:
        name: of the bag or folder, for messages to the user.
        topics: origin of each role.
        frame_count: number of RGB images, an estimate of the frames.
        drops: frames and messages left out so far, by reason.
        losses: sentences about data that the recording has lost.
    """

    name: str
    topics: dict[Role, UsedTopic]
    frame_count: int
    drops: Counter[str]
    losses: list[str]

    @property
    def kind(self) -> str:
        """``rosbag2`` or the name of a data set."""
        ...

    def messages(self) -> Iterator[RoleMessage]:
        """Decoded messages in order of time."""
        ...

    def raw_messages(self) -> Iterator[RawRoleMessage]:
        """The same messages, serialized, for a replay."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...
