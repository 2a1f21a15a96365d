"""Convert pose messages to T_world_camera; a buffer that interpolates poses."""

from __future__ import annotations

from bisect import bisect_left
from typing import Any

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import check_pose, interpolate_pose, pose_from_quaternion
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.names import checked_frame_id

# If neither the configuration nor the message names the world frame.
UNNAMED_FRAME = "world"


def stamp_ns_of(message: Any) -> int:
    """Time of a message's header, nanoseconds; raises RefusedInput ``invalid_stamp`` below 0."""
    stamp = message.header.stamp
    if stamp.sec < 0:
        raise RefusedInput("invalid_stamp", f"stamp is {stamp.sec} s: expected 0 or later")
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def set_stamp(message: Any, stamp_ns: int) -> None:
    """Set the time of a message's header."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)


def pose_from_message(message: Any) -> tuple[Float64, str]:
    """T_world_camera (4, 4) and the world frame of a PoseStamped or Odometry message.

    Raises:
        RefusedInput: ``invalid_pose`` for NaN, infinity, a position out of bounds, or a quaternion
            that is not of norm 1; ``invalid_frame_id``.
    """
    pose = message.pose
    if not hasattr(pose, "position"):  # Odometry: a PoseWithCovariance
        pose = pose.pose
    T = _rigid(pose.position, pose.orientation)
    check_pose(T)
    return T, checked_frame_id(str(message.header.frame_id)) or UNNAMED_FRAME


def pose_from_transform(transform: Any) -> Float64:
    """T_parent_child (4, 4) of a `geometry_msgs/Transform`; raises as `pose_from_message`."""
    return _rigid(transform.translation, transform.rotation)


def _rigid(position: Any, orientation: Any) -> Float64:
    return pose_from_quaternion(
        np.array([position.x, position.y, position.z], np.float64),
        np.array([orientation.x, orientation.y, orientation.z, orientation.w], np.float64),
    )


class PoseBuffer:
    """The newest poses in stamp order, interpolated at any stamp.

    Args:
        slop_ns: maximum time between a stamp and the poses that are used for it, nanoseconds.
        capacity: number of poses kept, at least; the default is 100 s at 100 Hz.
    """

    def __init__(self, slop_ns: int, capacity: int = 10000) -> None:
        self._slop_ns = slop_ns
        self._capacity = capacity
        self._stamps_ns: list[int] = []
        self._poses: list[Float64] = []

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, stamp_ns: int, T: Float64) -> None:
        """Keep a pose (4, 4); it replaces one with the same stamp."""
        row = bisect_left(self._stamps_ns, stamp_ns)
        if row < len(self._stamps_ns) and self._stamps_ns[row] == stamp_ns:
            self._poses[row] = T
            return
        self._stamps_ns.insert(row, stamp_ns)
        self._poses.insert(row, T)
        if len(self._stamps_ns) > 2 * self._capacity:
            self._forget(len(self._stamps_ns) - self._capacity)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop poses that are not needed for this stamp or later ones."""
        rows = bisect_left(self._stamps_ns, stamp_ns - self._slop_ns) - 1
        # Deleting from the front moves the rest of the list: delete many at once.
        if rows > 256:
            self._forget(rows)

    def _forget(self, rows: int) -> None:
        del self._stamps_ns[:rows]
        del self._poses[:rows]

    def settled(self, stamp_ns: int) -> bool:
        """Whether later poses, in stamp order, cannot change the pose at this stamp."""
        return bool(self._stamps_ns) and self._stamps_ns[-1] >= stamp_ns

    def at(self, stamp_ns: int) -> Float64:
        """The pose (4, 4) at a stamp: interpolated between both neighbours, or the nearest one.

        Raises:
            RefusedInput: ``no_pose`` if the nearest pose is further away than the slop.
        """
        stamps_ns = self._stamps_ns
        row = bisect_left(stamps_ns, stamp_ns)
        if row < len(stamps_ns) and stamps_ns[row] == stamp_ns:
            return self._poses[row]
        before_ns = stamp_ns - stamps_ns[row - 1] if row > 0 else None
        after_ns = stamps_ns[row] - stamp_ns if row < len(stamps_ns) else None
        has_before = before_ns is not None and before_ns <= self._slop_ns
        has_after = after_ns is not None and after_ns <= self._slop_ns
        if has_before and has_after:
            assert before_ns is not None and after_ns is not None
            fraction = before_ns / (before_ns + after_ns)
            return interpolate_pose(self._poses[row - 1], self._poses[row], fraction)
        if has_before or has_after:
            return self._poses[row if has_after else row - 1]
        known = [gap for gap in (before_ns, after_ns) if gap is not None]
        seen = f"the nearest pose is {min(known) / 1e9:.3f} s away" if known else "there is no pose"
        raise RefusedInput(
            "no_pose",
            f"image at {stamp_ns / 1e9:.3f} s: {seen}, expected one within "
            f"{self._slop_ns / 1e9:g} s (inputs.pose_slop_s)",
        )
