"""A rosbag2 bag as the messages of one posed RGB-D camera."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.doctor.frame_checks import Header
from deworldsg_ros.recordings.bags.storage import RawBag, RawMessage, Topic
from deworldsg_ros.recordings.bags.topics import TopicChoice, find_topics
from deworldsg_ros.recordings.source import (
    CAMERA_INFO,
    ODOMETRY,
    POSE_STAMPED,
    STRING,
    TF_MESSAGE,
    RawRoleMessage,
    Role,
    RoleMessage,
    UsedTopic,
    camera_info,
    decode,
    pose_stamped_from_matrix,
    serialize,
    stamp_ns_of_cdr,
    string_message,
)
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RecordingError, RefusedInput
from deworldsg_ros.streams.detections import read_detections
from deworldsg_ros.streams.images import (
    depth_from_message,
    header_of,
    info_topic,
    rgb_from_message,
)
from deworldsg_ros.streams.poses import TransformTree, pose_from_message
from deworldsg_ros.wire.messages import encode, ns_from_stamp

# Static transforms: also /robot/tf_static.
STATIC_SUFFIX = "tf_static"


class BagSource:
    """Messages of the roles of a bag; see `Source`.

    With poses from TF, each RGB image gets a PoseStamped of its frame. An Odometry of another frame
    is transformed to the RGB frame with /tf_static.

    Args:
        path: folder, .mcap or .db3 file.
        choice: topics that the user named.
        inputs: transport, pose source, and for TF the world frame and pose slop.
        need_pose: whether a bag without poses is refused.
        intrinsics: fx, fy, cx, cy of the RGB image in pixels, in place of the bag's CameraInfo.

    Raises:
        RecordingError: for a bag that cannot be read, without a topic for a role, or with pictures
            on the depth topic.
    """

    kind: ClassVar[str] = "rosbag2"

    def __init__(
        self,
        path: Path,
        choice: TopicChoice | None = None,
        inputs: InputsConfig | None = None,
        *,
        need_pose: bool = True,
        intrinsics: tuple[float, float, float, float] | None = None,
    ) -> None:
        choice = choice or TopicChoice()
        self.name = path.name
        self._inputs = inputs or InputsConfig()
        self._bag = RawBag(path)
        self.losses = self._bag.losses
        self.drops: Counter[str] = Counter()
        try:
            found = find_topics(
                self._bag.topics,
                choice,
                str(path),
                self._inputs,
                need_pose=need_pose,
                need_camera_info=intrinsics is None,
                encoding=self._encoding,
            )
            self._check_depth(found[Role.DEPTH])
            self._T_child_camera = self._mounting(found, choice)
            self._intrinsics = self._with_size(intrinsics, found[Role.RGB])
        except RecordingError:
            self._bag.close()
            raise
        self._found = found
        self.topics = {
            role: UsedTopic(topic.name, topic.msgtype, topic.count) for role, topic in found.items()
        }
        if self._T_child_camera is not None:
            odometry = found[Role.POSE]
            self.topics[Role.POSE] = UsedTopic(odometry.name, POSE_STAMPED, odometry.count)
        self.frame_count = found[Role.RGB].count
        if Role.DETECTIONS in found:
            sent = found[Role.DETECTIONS]
            self.topics[Role.DETECTIONS] = UsedTopic(sent.name, STRING, sent.count)
        if self._intrinsics is not None:
            self.topics[Role.CAMERA_INFO] = UsedTopic("--intrinsics", CAMERA_INFO, self.frame_count)

    def raw_messages(self) -> Iterator[RawRoleMessage]:
        """Serialized messages in the order in which they were recorded."""
        # A topic may have messages of several types.
        roles = {topic.key: role for role, topic in self._found.items()}
        poses = None
        if Role.POSE in self._found and self._found[Role.POSE].msgtype == TF_MESSAGE:
            del roles[self._found[Role.POSE].key]
            poses = _TfPoses(self._bag, self._inputs)
        # A detector sends its results after the image, and a frame needs both: so they are read
        # ahead, and come before it.
        ahead = [
            _Ahead(self._bag, roles.pop(self._found[role].key), self._found[role], self.drops)
            for role in (Role.DETECTIONS, Role.DETECTION_INSTANCES)
            if role in self._found
        ]
        for raw in self._bag.messages(roles):
            role = roles[raw.topic, raw.msgtype]
            try:
                stamp_ns = stamp_ns_of_cdr(raw.data)
                needs_frame = role is Role.RGB and (poses is not None or self._intrinsics)
                frame_id = decode(raw.data, raw.msgtype).header.frame_id if needs_frame else ""
            except Exception:  # rosbags raises errors of many types
                self.drops["invalid_message"] += 1
                continue
            if role is Role.RGB:
                for stream in ahead:
                    yield from stream.up_to(stamp_ns, raw.log_time_ns)
            if role is Role.RGB and self._intrinsics is not None:
                yield serialize(camera_info(stamp_ns, frame_id, self._intrinsics), raw.log_time_ns)
            if role is Role.RGB and poses is not None:
                pose = poses.at(stamp_ns, frame_id)
                if pose is not None:
                    yield serialize(pose, raw.log_time_ns)
            if role is Role.POSE and self._T_child_camera is not None:
                yield from self._at_camera(raw, self._T_child_camera)
                continue
            yield RawRoleMessage(role, raw.msgtype, stamp_ns, raw.log_time_ns, raw.data)
        if poses is not None and poses.refusal:
            self.losses.append(poses.refusal)

    def messages(self) -> Iterator[RoleMessage]:
        """Decoded messages; a message that cannot be decoded is counted as ``invalid_message``."""
        for raw in self.raw_messages():
            try:
                message = decode(raw.data, raw.msgtype)
            except Exception:  # rosbags raises errors of many types
                self.drops["invalid_message"] += 1
                continue
            yield RoleMessage(raw.role, raw.msgtype, raw.stamp_ns, message)

    def headers(self) -> dict[str, Header]:
        """What the first messages of the camera say, by role."""
        headers: dict[str, Header] = {}
        for role in (Role.RGB, Role.DEPTH, Role.CAMERA_INFO):
            message = self._first(self._found[role]) if role in self._found else None
            if message is not None:
                info, scale = None, None
                if role is Role.DEPTH:
                    info, scale = self._info_beside(), self._inputs.depth_scale
                name = self._found[role].name
                headers[role.value] = header_of(name, message, info, scale)
        return headers

    def close(self) -> None:
        """Close the files."""
        self._bag.close()

    def _info_beside(self) -> Any:
        """The first camera_info beside the depth images; None if there is none."""
        name = info_topic(self._found[Role.DEPTH].name)
        beside = [t for t in self._bag.topics if (t.name, t.msgtype) == (name, CAMERA_INFO)]
        return self._first(beside[0]) if beside else None

    def _mounting(self, found: dict[Role, Topic], choice: TopicChoice) -> Float64 | None:
        """T_child_camera (4, 4) for an odometry of another frame than the camera's, else None.

        If /tf_static does not connect the two frames, TF replaces the odometry in `found`.
        """
        pose = found.get(Role.POSE)
        if pose is None or pose.msgtype != ODOMETRY or self._inputs.pose_source != "auto":
            return None
        image, odometry = self._first(found[Role.RGB]), self._first(pose)
        if image is None or odometry is None:
            return None
        camera = image.header.frame_id.lstrip("/")
        child = odometry.child_frame_id.lstrip("/")
        if child in ("", camera):
            return None
        try:
            return _TfPoses(self._bag, self._inputs).mounting(child, camera)
        except RefusedInput:
            moving = [t for t in self._bag.topics if t.msgtype == TF_MESSAGE and t.count]
            moving = [t for t in moving if not t.name.endswith(STATIC_SUFFIX)]
            if moving and not choice.pose:
                found[Role.POSE] = next((t for t in moving if t.name == "/tf"), moving[0])
            return None

    def _at_camera(self, raw: RawMessage, T_child_camera: Float64) -> Iterator[RawRoleMessage]:
        """PoseStamped of the camera from an Odometry; a bad one is counted and left out."""
        try:
            T_world_child, frame_id = pose_from_message(decode(raw.data, raw.msgtype))
        except RefusedInput as refusal:
            self.drops[refusal.reason] += 1
            return
        except Exception:  # rosbags raises errors of many types
            self.drops["invalid_message"] += 1
            return
        T = T_world_child @ T_child_camera
        pose = pose_stamped_from_matrix(stamp_ns_of_cdr(raw.data), frame_id, T)
        yield serialize(pose, raw.log_time_ns)

    def _check_depth(self, topic: Topic) -> None:
        """Raise RecordingError if the first image of the depth topic is a picture."""
        image = self._first(topic)
        try:
            if image is not None:
                depth_from_message(image, depth_scale_m=0.0, max_depth_m=1.0)
        except RefusedInput as refusal:
            if refusal.reason == "not_depth":
                raise RecordingError(
                    f"recording {self.name}: {topic.name}: {refusal}; name a topic with --depth"
                ) from refusal

    def _with_size(
        self, intrinsics: tuple[float, float, float, float] | None, topic: Topic
    ) -> Intrinsics | None:
        """Intrinsics with the size of the first RGB image; None without intrinsics."""
        if intrinsics is None:
            return None
        try:
            height, width, _ = rgb_from_message(self._first(topic)).shape
            return Intrinsics(*intrinsics, width, height)
        except (RefusedInput, AttributeError) as error:
            raise RecordingError(
                f"recording {self.name}: --intrinsics needs the size of the images, and the first "
                f"on {topic.name} cannot be read ({error})"
            ) from error

    def _encoding(self, topic: Topic) -> str:
        """Encoding of the first image of a topic; empty if it cannot be read."""
        message = self._first(topic)
        return "" if message is None else header_of(topic.name, message).encoding

    def _first(self, topic: Topic) -> Any:
        """The first message that can be decoded; None if there is none."""
        for raw in self._bag.messages([topic.key]):
            with contextlib.suppress(Exception):  # rosbags raises errors of many types
                return decode(raw.data, raw.msgtype)
        return None


class _Ahead:
    """The detections of a bag, or their instance images, as messages that come with the image.

    Detections of vision_msgs become our JSON: the nodes need no package for them then.
    """

    def __init__(self, bag: RawBag, role: Role, topic: Topic, drops: Counter[str]) -> None:
        self._role, self._drops = role, drops
        self._messages = bag.messages([topic.key])
        self._next: RoleMessage | None = None

    def up_to(self, stamp_ns: int, log_time_ns: int) -> Iterator[RawRoleMessage]:
        """The next messages with a stamp up to this one, at that time of recording."""
        while True:
            if self._next is None:
                self._next = self._read()
            if self._next is None or self._next.stamp_ns > stamp_ns:
                return
            yield serialize(self._next, log_time_ns)
            self._next = None

    def _read(self) -> RoleMessage | None:
        """The next message that can be read; None at the end."""
        for raw in self._messages:
            try:
                message = decode(raw.data, raw.msgtype)
                if self._role is not Role.DETECTIONS:
                    return RoleMessage(self._role, raw.msgtype, stamp_ns_of_cdr(raw.data), message)
                sent = read_detections(message)
            except RefusedInput as refusal:
                self._drops[refusal.reason] += 1
                continue
            except Exception:  # rosbags raises errors of many types
                self._drops["invalid_message"] += 1
                continue
            return string_message(self._role, ns_from_stamp(sent.stamp), encode(sent))
        return None


class _TfPoses:
    """Poses of the camera from /tf and /tf_static; reads /tf only as far ahead as needed."""

    def __init__(self, bag: RawBag, inputs: InputsConfig) -> None:
        self._tree = TransformTree(round(inputs.pose_slop_s * 1e9), inputs.world_frame)
        keys = [t.key for t in bag.topics if t.msgtype == TF_MESSAGE]
        static = [key for key in keys if key[0].endswith(STATIC_SUFFIX)]
        self.refusal = ""
        for raw in bag.messages(static):
            self._add(raw, is_static=True)
        self._moving = bag.messages([key for key in keys if key not in static])

    def mounting(self, parent_frame: str, camera_frame: str) -> Float64:
        """T_parent_camera (4, 4) from static transforms; raises RefusedInput without them."""
        return self._tree.between(0, parent_frame, camera_frame)

    def at(self, stamp_ns: int, camera_frame: str) -> RoleMessage | None:
        """PoseStamped of the camera; None without a pose in TF, with the reason in `refusal`."""
        while not self._tree.settled(stamp_ns, camera_frame):
            raw = next(self._moving, None)
            if raw is None:
                break
            self._add(raw, is_static=False)
        try:
            T, world_frame = self._tree.at(stamp_ns, camera_frame)
        except RefusedInput as refusal:
            self.refusal = f"poses from TF: {refusal}"
            return None
        self._tree.forget_before(stamp_ns)
        return pose_stamped_from_matrix(stamp_ns, world_frame, T)

    def _add(self, raw: RawMessage, *, is_static: bool) -> None:
        try:
            self._tree.add(decode(raw.data, raw.msgtype), static=is_static)
        except Exception as error:  # a broken message, or a transform that is not rigid
            self.refusal = f"poses from TF: {error}"
