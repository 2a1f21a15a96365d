"""The poses of one topic, transformed to the camera if they are of another frame."""

from __future__ import annotations

from typing import Any

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.poses import PoseBuffer, pose_from_message
from deworldsg_ros.streams.transforms import TransformTree


class PoseStream:
    """Camera poses in one world frame.

    An Odometry names the frame whose pose it contains. If this is another frame than the camera's,
    e.g. base_link, `transforms` transforms the pose to the camera.

    Args:
        slop_ns: as `PoseBuffer`.
        world_frame: expected frame_id of the poses; empty = that of the first pose.
        transforms: as the attribute.

    Attributes:
        world_frame: frame_id of the poses; empty before the first.
        transforms: TF tree that contains the mounting of the camera; None = each pose is taken as
            the camera's.
    """

    def __init__(
        self, slop_ns: int, world_frame: str = "", transforms: TransformTree | None = None
    ) -> None:
        self._buffer = PoseBuffer(slop_ns)
        self._child_frame = ""
        self.world_frame = world_frame
        self.transforms = transforms

    def add(self, message: Any, stamp_ns: int) -> None:
        """Keep a pose.

        Raises:
            RefusedInput: ``invalid_pose``, or ``wrong_frame`` for another world frame.
        """
        T, frame_id = pose_from_message(message)
        if self.world_frame and frame_id != self.world_frame:
            raise RefusedInput(
                "wrong_frame", f"pose is in frame '{frame_id}', expected '{self.world_frame}'"
            )
        self.world_frame = frame_id
        self._child_frame = str(getattr(message, "child_frame_id", "")).lstrip("/")
        self._buffer.add(stamp_ns, T)

    def is_of(self, camera_frame: str) -> bool:
        """Whether the poses are of the camera frame, or name no frame."""
        return self._child_frame in ("", camera_frame.lstrip("/")) or not camera_frame

    def settled(self, stamp_ns: int, camera_frame: str) -> bool:
        """Whether later messages cannot change the pose at this stamp."""
        return self._buffer.settled(stamp_ns) and (
            self.transforms is None
            or self.is_of(camera_frame)
            or self.transforms.settled(stamp_ns, camera_frame, self._child_frame)
        )

    def at(self, stamp_ns: int, camera_frame: str) -> tuple[Float64, str]:
        """T_world_camera (4, 4) and the world frame at a stamp.

        Raises:
            RefusedInput: ``no_pose`` as `PoseBuffer.at`; ``no_transform`` if TF does not contain
                the mounting of the camera.
        """
        T_world_child = self._buffer.at(stamp_ns)
        if self.transforms is None or self.is_of(camera_frame):
            return T_world_child, self.world_frame
        try:
            T_child_camera = self.transforms.between(stamp_ns, self._child_frame, camera_frame)
        except RefusedInput as refusal:
            raise RefusedInput(
                "no_transform", f"the odometry is of frame '{self._child_frame}': {refusal}"
            ) from refusal
        return T_world_child @ T_child_camera, self.world_frame

    def forget_before(self, stamp_ns: int) -> None:
        """Drop poses that are not needed for this stamp or later ones."""
        self._buffer.forget_before(stamp_ns)
