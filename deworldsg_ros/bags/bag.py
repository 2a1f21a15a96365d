"""A rosbag2 bag as the messages of one posed RGB-D camera."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

from deworldsg_ros.bags.errors import RecordingError
from deworldsg_ros.bags.messages import (
    ODOMETRY,
    TF_MESSAGE,
    Role,
    RoleMessage,
    decode,
    encode,
    pose_stamped,
    stamp_ns_of_cdr,
)
from deworldsg_ros.bags.source import RawRoleMessage, UsedTopic
from deworldsg_ros.bags.storage import RawBag, RawMessage, Topic
from deworldsg_ros.bags.topics import TopicChoice, find_topics
from deworldsg_ros.bridge.transforms import TransformTree
from deworldsg_ros.config import InputsConfig
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.scene.errors import RefusedInput


class BagSource:
    """Messages of the four roles of a bag; see `Source`.

    Where the pose is in TF, a PoseStamped of the RGB frame is computed for every RGB image.

    Args:
        path: folder, .mcap or .db3 file.
        choice: topics named by the user.
        inputs: ``world_frame`` and ``pose_slop_s`` are used, for poses from TF.
        need_pose: whether a bag without poses is refused.

    Raises:
        RecordingError: where it cannot be read, or a topic is missing.
    """

    kind: ClassVar[str] = "rosbag2"

    def __init__(
        self,
        path: Path,
        choice: TopicChoice | None = None,
        inputs: InputsConfig | None = None,
        *,
        need_pose: bool = True,
    ) -> None:
        choice = choice or TopicChoice()
        self.name = path.name
        self._inputs = inputs or InputsConfig()
        self._bag = RawBag(path)
        self.losses = self._bag.losses
        self.drops: Counter[str] = Counter()
        try:
            found = find_topics(
                self._bag.topics, choice, str(path), self._inputs, need_pose=need_pose
            )
            if Role.POSE in found:
                self._prefer_tf(found, choice)
        except RecordingError:
            self._bag.close()
            raise
        self.topics = {
            role: UsedTopic(topic.name, topic.msgtype, topic.count) for role, topic in found.items()
        }
        self.frame_count = found[Role.RGB].count

    def raw_messages(self) -> Iterator[RawRoleMessage]:
        """Serialized messages in the order in which they were recorded."""
        roles = {topic.name: role for role, topic in self.topics.items()}
        poses = None
        if Role.POSE in self.topics and self.topics[Role.POSE].msgtype == TF_MESSAGE:
            del roles[self.topics[Role.POSE].name]
            poses = _TfPoses(self._bag, self._inputs)
        for raw in self._bag.messages(roles):
            role = roles[raw.topic]
            stamp_ns = stamp_ns_of_cdr(raw.data)
            if role is Role.RGB and poses is not None:
                pose = poses.at(stamp_ns, decode(raw.data, raw.msgtype).header.frame_id)
                if pose is not None:
                    data = encode(pose.message, pose.msgtype)
                    yield RawRoleMessage(Role.POSE, pose.msgtype, stamp_ns, raw.log_time_ns, data)
            yield RawRoleMessage(role, raw.msgtype, stamp_ns, raw.log_time_ns, raw.data)
        if poses is not None and poses.refusal:
            self.losses.append(poses.refusal)

    def messages(self) -> Iterator[RoleMessage]:
        """Decoded messages; what cannot be decoded is counted as ``invalid_message``."""
        for raw in self.raw_messages():
            try:
                message = decode(raw.data, raw.msgtype)
            except Exception:  # whatever rosbags raises on a broken message
                self.drops["invalid_message"] += 1
                continue
            yield RoleMessage(raw.role, raw.msgtype, raw.stamp_ns, message)

    def close(self) -> None:
        """Close the files."""
        self._bag.close()

    def _prefer_tf(self, found: dict[Role, Topic], choice: TopicChoice) -> None:
        """Take TF instead of the odometry of a frame that is not the camera's."""
        tf = next((t for t in self._bag.topics if t.msgtype == TF_MESSAGE and t.count), None)
        is_told = choice.pose or self._inputs.pose_source != "auto"
        if is_told or tf is None or found[Role.POSE].msgtype != ODOMETRY:
            return
        camera = self._first(found[Role.RGB]).header.frame_id
        child = self._first(found[Role.POSE]).child_frame_id
        if child.lstrip("/") != camera.lstrip("/"):
            found[Role.POSE] = next((t for t in self._bag.topics if t.name == "/tf"), tf)

    def _first(self, topic: Topic) -> Any:
        raw = next(self._bag.messages([topic.name]))
        return decode(raw.data, raw.msgtype)


class _TfPoses:
    """Poses of the camera out of /tf and /tf_static, read just as far ahead as is needed."""

    def __init__(self, bag: RawBag, inputs: InputsConfig) -> None:
        self._tree = TransformTree(round(inputs.pose_slop_s * 1e9), inputs.world_frame)
        names = [t.name for t in bag.topics if t.msgtype == TF_MESSAGE]
        static = [name for name in names if name.endswith("tf_static")]
        self.refusal = ""
        for raw in bag.messages(static):
            self._add(raw, is_static=True)
        self._moving = bag.messages([name for name in names if name not in static])

    def at(self, stamp_ns: int, camera_frame: str) -> RoleMessage | None:
        """PoseStamped of the camera; None, with the reason in `refusal`, where TF has none."""
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
        return pose_stamped(stamp_ns, world_frame, T[:3, 3], quaternion_from_rotation(T[:3, :3]))

    def _add(self, raw: RawMessage, *, is_static: bool) -> None:
        try:
            self._tree.add(decode(raw.data, raw.msgtype), static=is_static)
        except Exception as error:  # a broken message, or a transform that is not rigid
            self.refusal = f"poses from TF: {error}"
