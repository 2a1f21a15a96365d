"""Poses of the camera from messages: pose topics, TF, interpolation, jumps, wrong clocks."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np

from deworldsg_ros.scene.arrays import Float32, Float64, Int64
from deworldsg_ros.scene.camera import (
    Intrinsics,
    check_pose,
    interpolate_pose,
    invert_pose,
    pose_from_quaternion,
    rotation_angle_deg,
)
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.limits import OBJECT_FRAME, RESTART_NS, checked_frame_id

# --- Convert pose messages to T_world_camera; a buffer that interpolates poses.

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


# As many as a day of SLAM has, at a pose a second.
MAX_TRAJECTORY = 100_000


def trajectory_from_message(message: Any) -> tuple[Int64, Float64, str]:
    """Stamps (m,), poses (m, 4, 4) and the world frame of a `nav_msgs/Path`.

    Raises:
        RefusedInput: ``invalid_trajectory`` for stamps that do not ascend, or too many; and as
            `pose_from_message`.
    """
    stamps_ns = [stamp_ns_of(pose) for pose in message.poses[: MAX_TRAJECTORY + 1]]
    return _trajectory(message, stamps_ns, [pose.pose for pose in message.poses])


class GraphTrajectory:
    """Trajectories of the `rtabmap_msgs/MapGraph` messages of one SLAM system, by their fields.

    They have ids of poses, and no stamps. The newest pose of a message is of the time of the
    message. So a pose has a stamp if the message in which it was the newest one has come.
    """

    def __init__(self) -> None:
        self._stamps_ns: dict[int, int] = {}

    def read(self, message: Any) -> tuple[Int64, Float64, str]:
        """As `trajectory_from_message`, of the poses whose stamps are known; there may be none."""
        by_id = dict(zip(message.poses_id, message.poses))
        newest, stamp_ns = max(by_id, default=0), stamp_ns_of(message)
        if newest > 0 and stamp_ns > max(self._stamps_ns.values(), default=0):
            self._stamps_ns.setdefault(newest, stamp_ns)
        if len(self._stamps_ns) > MAX_TRAJECTORY:
            self._stamps_ns.pop(min(self._stamps_ns))
        known = {stamp: by_id[i] for i, stamp in self._stamps_ns.items() if i in by_id}
        stamps_ns = sorted(known)
        return _trajectory(message, stamps_ns, [known[stamp] for stamp in stamps_ns])


def _trajectory(message: Any, stamps_ns: list[int], poses: list[Any]) -> tuple[Int64, Float64, str]:
    """A trajectory with ascending stamps."""
    if len(stamps_ns) > MAX_TRAJECTORY:
        raise RefusedInput(
            "invalid_trajectory", f"a trajectory has more than {MAX_TRAJECTORY} poses"
        )
    stamps = np.array(stamps_ns, np.int64)
    if (np.diff(stamps) <= 0).any():
        at = int((np.diff(stamps) <= 0).argmax())
        raise RefusedInput(
            "invalid_trajectory",
            f"pose {at + 1} of a trajectory is at {stamps[at + 1] / 1e9:.3f} s, the one before at "
            f"{stamps[at] / 1e9:.3f} s: expected ascending stamps of when the robot was there. "
            "RTAB-Map's mapPath has one stamp for all poses: use its mapGraph",
        )
    T = [_rigid(pose.position, pose.orientation) for pose in poses]
    frame_id = checked_frame_id(str(message.header.frame_id)) or UNNAMED_FRAME
    return stamps, np.array(T).reshape(-1, 4, 4), frame_id


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


# --- A clock that is wrong for one message costs one message.

T = TypeVar("T")

# Cameras, and detectors on a CPU, deliver more than a message a minute.
MAX_STEP_NS = 60 * 10**9


class ClockGate(Generic[T]):
    """Holds back a message whose stamp jumps, until later ones confirm the jump.

    A stamp jumps if it is more than `max_step_ns` after the newest one, or more than `RESTART_NS`
    before it. A message confirms the jump if its stamp follows that of the held one, and jumps in
    the same direction. Otherwise the held ones had wrong stamps, and are lost.

    Args:
        max_step_ns: as above.
        confirmed_by: number of messages that confirm a jump.

    Attributes:
        newest_ns: stamp of the newest message that passed; None before the first.
    """

    def __init__(self, max_step_ns: int = MAX_STEP_NS, confirmed_by: int = 1) -> None:
        self.max_step_ns = max_step_ns
        self.newest_ns: int | None = None
        self._confirmed_by = confirmed_by
        self._held: list[tuple[int, T]] = []

    def admit(self, stamp_ns: int, value: T) -> tuple[list[tuple[int, T]], list[int]]:
        """Add a message.

        Returns:
            stamps and values of the messages to take now, in order; and the stamps of those that
            are lost.
        """
        held, self._held = self._held, []
        side = self._side(stamp_ns)
        if side == 0:
            self.newest_ns = max(stamp_ns, self.newest_ns or 0)
            return [(stamp_ns, value)], [lost for lost, _ in held]
        if held and (stamp_ns <= held[-1][0] or self._side(held[-1][0]) != side):
            self._held = [(stamp_ns, value)]
            return [], [lost for lost, _ in held]
        self._held = [*held, (stamp_ns, value)]
        if len(self._held) <= self._confirmed_by:
            return [], []
        self.newest_ns = stamp_ns
        return self.release(), []

    def release(self) -> list[tuple[int, T]]:
        """The messages that are held back: no other will follow."""
        held, self._held = self._held, []
        return held

    def _side(self, stamp_ns: int) -> int:
        """1 or -1 for a jump forward or back, 0 for none."""
        if self.newest_ns is None:
            return 0
        if stamp_ns < self.newest_ns - RESTART_NS:
            return -1
        return int(stamp_ns > self.newest_ns + self.max_step_ns)


def jump_text(name: str, stamp_ns: int, max_step_ns: int = MAX_STEP_NS) -> str:
    """The message of a drop."""
    return (
        f"{name} at {stamp_ns / 1e9:.3f} s is more than {max_step_ns / 1e9:g} s after, or a second "
        "before, its neighbours: expected increasing stamps. Check the clock"
    )


# --- A small TF tree, built from /tf and /tf_static messages.

# A humanoid has a hundred frames. With more, some node gives its frames ever new names.
MAX_FRAMES = 1000
# A moving frame without a transform for so long is dropped: it has ended, or is of no use. A buffer
# keeps as much at 100 Hz.
SILENT_NS = 100 * 10**9
# The objects of graph_node (`output.publish_tf`), also those of robots with a namespace.
_OBJECT = re.compile(rf"(.+/)?{OBJECT_FRAME}[0-9]+")


def _no_room_text(child: str) -> str:
    return f"TF has {MAX_FRAMES} frames: expected no more, and '{child}' is ignored"


class TransformTree:
    """Frames and the transforms between them, interpolated at any stamp.

    It keeps at most `MAX_FRAMES`. Moving ones that are silent for `SILENT_NS` are dropped, unless
    they connect the two frames that were asked for last. Objects of the graph are no frames of a
    camera: they are ignored.

    Args:
        slop_ns: maximum time between a stamp and the transforms that are used for it, nanoseconds.
        world_frame: world frame of the poses; empty = the root of the tree above the camera when
            the first pose is read. A transform between the two must be a moving one.

    Attributes:
        newest_ns: stamp of the newest moving transform; 0 = none.
    """

    def __init__(self, slop_ns: int, world_frame: str = "") -> None:
        self._slop_ns = slop_ns
        self._world_frame = world_frame
        self._parents: dict[str, str] = {}
        self._static: dict[str, Float64] = {}
        self._moving: dict[str, PoseBuffer] = {}
        self._gates: dict[str, ClockGate[Float64]] = {}
        self._asked: tuple[str, ...] = ()
        self.newest_ns = 0

    def __len__(self) -> int:
        return len(self._parents)

    def add(self, message: Any, *, static: bool) -> None:
        """Keep the transforms of a `tf2_msgs/TFMessage`.

        Raises:
            RefusedInput: ``invalid_pose``, ``invalid_frame_id`` or ``invalid_stamp``; the
                transforms before the bad one are kept. ``time_jump`` for a transform that is lost,
                ``too_many_frames`` for one that has no room; the others are kept.
        """
        refused: list[RefusedInput] = []
        for transform in message.transforms:
            # Old bags write frames with a leading slash.
            parent = checked_frame_id(str(transform.header.frame_id).lstrip("/"))
            child = checked_frame_id(str(transform.child_frame_id).lstrip("/"))
            T_parent_child = pose_from_transform(transform.transform)
            if not static and self._is_object(child):
                continue
            if not self._has_room(child):
                refused.append(RefusedInput("too_many_frames", _no_room_text(child)))
                continue
            if static:
                self._static[child] = T_parent_child
            else:
                for lost_ns in self._add_moving(child, stamp_ns_of(transform), T_parent_child):
                    text = jump_text(f"transform of '{child}'", lost_ns)
                    refused.append(RefusedInput("time_jump", text))
            # Last: a reader in another thread then finds the transform of each frame in the tree.
            self._parents[child] = parent
        if refused:
            raise refused[0]

    def _add_moving(self, child: str, stamp_ns: int, T_parent_child: Float64) -> list[int]:
        """Keep a transform; returns the stamps of those that are lost (`ClockGate`)."""
        buffer = self._moving.setdefault(child, PoseBuffer(self._slop_ns))
        gate = self._gates.setdefault(child, ClockGate())
        admitted, lost = gate.admit(stamp_ns, T_parent_child)
        for at_ns, T in admitted:
            buffer.add(at_ns, T)
            self.newest_ns = max(self.newest_ns, at_ns)
        return lost

    def _has_room(self, child: str) -> bool:
        is_known = child in self._gates or child in self._static
        return is_known or len(self._gates) + len(self._static) < MAX_FRAMES

    def _is_object(self, child: str) -> bool:
        """Whether a frame is an object of graph_node, and not what a camera is mounted on."""
        return (
            _OBJECT.fullmatch(child) is not None
            and child not in self._asked
            and child not in self._parents.values()
        )

    def settled(self, stamp_ns: int, camera_frame: str, parent_frame: str = "") -> bool:
        """Whether later transforms cannot change the result of `at` or `between`."""
        parent_frame = parent_frame or self._world_frame
        try:
            ours, theirs, _ = self._paths(camera_frame, parent_frame)
        except RefusedInput:
            return False
        moving = [frame for frame in ours + theirs if frame not in self._static]
        if not moving and not parent_frame:
            return False  # The rest of the tree has not arrived yet.
        return all(self._moving[frame].settled(stamp_ns) for frame in moving)

    def at(self, stamp_ns: int, camera_frame: str) -> tuple[Float64, str]:
        """T_world_camera (4, 4) and the world frame at a stamp.

        Raises:
            RefusedInput: as `between`; ``no_pose`` if no world frame is configured and all
                transforms above the camera are static: the root is then its mounting, no world.
        """
        ours, _, world_frame = self._paths(camera_frame, self._world_frame)
        if not self._world_frame and all(frame in self._static for frame in ours):
            raise RefusedInput(
                "no_pose",
                f"TF has camera frame '{camera_frame}' fixed to '{world_frame}', which does "
                "not move in any world: expected transforms of a localisation, or "
                "inputs.world_frame",
            )
        T_world_camera = self.between(stamp_ns, world_frame, camera_frame)
        self._world_frame = world_frame
        return T_world_camera, world_frame

    def between(self, stamp_ns: int, parent_frame: str, child_frame: str) -> Float64:
        """T_parent_child (4, 4) at a stamp.

        Raises:
            RefusedInput: ``no_pose`` if the frames are not connected, or if a transform is
                further away in time than the slop.
        """
        ours, theirs, _ = self._paths(child_frame, parent_frame)
        return invert_pose(self._chain(theirs, stamp_ns)) @ self._chain(ours, stamp_ns)

    def root(self, frame: str) -> str:
        """The root of the tree above a frame; the frame itself if it has no parent."""
        return self._ancestry(frame)[-1]

    def forget_before(self, stamp_ns: int) -> None:
        """Drop transforms that are not needed for this stamp or later ones, and silent frames."""
        for buffer in self._moving.values():
            buffer.forget_before(stamp_ns)
        before_ns = stamp_ns - SILENT_NS
        silent = {frame for frame, gate in self._gates.items() if (gate.newest_ns or 0) < before_ns}
        if silent:
            for frame in silent - self._connecting():
                self._drop(frame)

    def restart(self) -> None:
        """Drop the moving transforms; static ones are published only once, and stay."""
        connecting = self._connecting()
        # The gates stay: a late transform of the old time is a jump, too.
        gates = {frame: gate for frame, gate in self._gates.items() if frame in connecting}
        for frame in list(self._gates):
            self._drop(frame)
        self._gates.update(gates)
        self.newest_ns = 0

    def _drop(self, frame: str) -> None:
        del self._gates[frame]
        self._moving.pop(frame, None)
        if frame not in self._static:
            self._parents.pop(frame, None)

    def _connecting(self) -> set[str]:
        """The frames above the two that were asked for last, and these."""
        return {above for frame in self._asked for above in self._ancestry(frame)}

    def _chain(self, frames: list[str], stamp_ns: int) -> Float64:
        """T_ancestor_frame (4, 4) along a path from the frame upwards."""
        T = np.eye(4)
        for frame in frames:
            step = self._static.get(frame)
            T = (self._moving[frame].at(stamp_ns) if step is None else step) @ T
        return T

    def _ancestry(self, frame: str) -> list[str]:
        path = [frame]
        while path[-1] in self._parents and len(path) <= len(self._parents):
            path.append(self._parents[path[-1]])
        return path

    def _paths(self, camera_frame: str, world_frame: str) -> tuple[list[str], list[str], str]:
        """Paths from the camera and from the world up to their common ancestor, without it.

        The third value is the world frame; if it has no name, the root above the camera.
        """
        ours = self._ancestry(camera_frame.lstrip("/"))
        world_frame = world_frame.lstrip("/") or ours[-1]
        self._asked = (ours[0], world_frame)
        theirs = self._ancestry(world_frame)
        common = next((frame for frame in ours if frame in theirs), None)
        if common is None or camera_frame.lstrip("/") == world_frame:
            raise RefusedInput(
                "no_pose",
                f"TF does not connect camera frame '{camera_frame}' with "
                f"'{world_frame}': known frames are "
                f"{', '.join(sorted({*self._parents, *self._parents.values()})) or 'none'}",
            )
        return ours[: ours.index(common)], theirs[: theirs.index(common)], world_frame


# --- The poses of one topic, transformed to the camera if they are of another frame.


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


# --- Refuse frames whose camera pose jumps.

# Between two frames at 10 Hz this is 10 m/s: faster than a person walks or an indoor robot drives,
# and shorter than the jump of a tracker that lost itself.
MAX_STEP_M = 1.0
# Hands and heads rotate at up to about 300 degrees a second, and images blur far below that.
MAX_ROTATION_DEG_S = 360.0
# The rotation rate of frames that are closer in time is computed with this interval: over a few
# milliseconds, the noise of the poses exceeds the motion of the camera.
MIN_INTERVAL_S = 1 / 15
# Half a second at 10 Hz: longer than a tracker's usual slip, short enough after a relocalisation.
RELOCALISED_AFTER_FRAMES = 5
# Two depth images can be compared if this fraction of the pixels of each lies in the other. They
# show one place if this fraction of these has the other's depth, up to a constant and a part of the
# depth; they contradict each other if this fraction lies where the other sees free space.
SHARED_FRACTION, AGREED_FRACTION, CONTRADICTED_FRACTION = 0.2, 0.6, 0.3
DEPTH_TOLERANCE_M, DEPTH_TOLERANCE_FRACTION = 0.05, 0.03
# Every so many pixels, in both directions, one is compared.
COMPARED_STEP = 8

# Decodes a depth image in metres, (H, W) float32, 0 = invalid; and its camera.
DepthView = tuple[Callable[[], Float32], Intrinsics]


class JumpGate:
    """Refuses a frame whose camera jumped; accepts a new position that persists.

    A frame jumped if, since the last accepted frame, the camera moved more than `MAX_STEP_M` or
    rotated faster than `MAX_ROTATION_DEG_S`. Sparse pictures do so, too: if both depth images show
    the same surfaces under the poses, it is no jump. After `RELOCALISED_AFTER_FRAMES` consecutive
    frames without a jump between them, the tracker has relocalised and the new position is
    accepted.

    Args:
        sparse: whether the frames are pictures without stamps. Their steps may be of any size:
            only a jump that depth contradicts is one.
    """

    def __init__(self, sparse: bool = False) -> None:
        self._sparse = sparse
        self._accepted: tuple[int, Float64] | None = None
        self._view: DepthView | None = None
        self._candidate: tuple[int, Float64] | None = None
        self._consistent_frames = 0

    def check(self, T_world_camera: Float64, stamp_ns: int, view: DepthView | None = None) -> None:
        """Accept a frame.

        Args:
            T_world_camera: (4, 4).
            stamp_ns: of the frame.
            view: its depth, which is decoded if the camera may have jumped.

        Raises:
            RefusedInput: ``pose_jump``.
        """
        pose = (stamp_ns, T_world_camera.copy())
        jump = unlikely_motion(self._accepted, pose) if self._accepted else ""
        if jump and not self._is_confirmed(pose, view):
            is_consistent = self._candidate is not None and not unlikely_motion(
                self._candidate, pose
            )
            self._consistent_frames = self._consistent_frames + 1 if is_consistent else 1
            self._candidate = pose
            if self._consistent_frames < RELOCALISED_AFTER_FRAMES:
                raise RefusedInput(
                    "pose_jump",
                    f"camera {jump}, or {RELOCALISED_AFTER_FRAMES} consistent frames at the new "
                    f"position (this is number {self._consistent_frames}). Check the localisation",
                )
        self._accepted, self._view = pose, view
        self._candidate = None
        self._consistent_frames = 0

    def _is_confirmed(self, pose: tuple[int, Float64], view: DepthView | None) -> bool:
        """Whether the depth of the last accepted frame and of this one agrees with a wide step."""
        if self._accepted is None or self._view is None or view is None:
            return False
        try:
            before, now = self._view[0](), view[0]()
        except RefusedInput:
            return False
        T_before_now = invert_pose(self._accepted[1]) @ pose[1]
        there = _compare(now, view[1], T_before_now, before, self._view[1])
        back = _compare(before, self._view[1], invert_pose(T_before_now), now, view[1])
        if min(there[0], back[0]) < SHARED_FRACTION:
            return self._sparse
        contradicted = max(there[2], back[2])
        if self._sparse:
            return contradicted < CONTRADICTED_FRACTION
        # What is near hides more of the other image in one of the two directions.
        agreed = sorted((there[1], back[1]))
        is_agreed = agreed[1] >= AGREED_FRACTION and agreed[0] >= AGREED_FRACTION / 2
        return is_agreed and contradicted < CONTRADICTED_FRACTION / 3


def unlikely_motion(before: tuple[int, Float64], now: tuple[int, Float64]) -> str:
    """Which limit the motion between two stamps and poses exceeds, in words; empty for none."""
    step_m = float(np.linalg.norm(now[1][:3, 3] - before[1][:3, 3]))
    if step_m > MAX_STEP_M:
        return (
            f"moved {step_m:.2f} m since the last accepted frame: expected at most {MAX_STEP_M:g} m"
        )
    elapsed_s = max((now[0] - before[0]) / 1e9, MIN_INTERVAL_S)
    turn_deg = rotation_angle_deg(before[1][:3, :3].T @ now[1][:3, :3])
    if turn_deg > MAX_ROTATION_DEG_S * elapsed_s:
        return (
            f"rotated {turn_deg:.0f} degrees in the {elapsed_s:.2f} s since the last accepted "
            f"frame: expected at most {MAX_ROTATION_DEG_S:g} a second"
        )
    return ""


def _compare(
    depth_m: Float32,
    camera: Intrinsics,
    T_other_camera: Float64,
    other_depth_m: Float32,
    other: Intrinsics,
) -> tuple[float, float, float]:
    """Of the pixels of a depth image, the fraction that lies in another one; of these, those at its
    depth, and those before it, where it sees free space.
    """
    rows, columns = np.mgrid[: depth_m.shape[0] : COMPARED_STEP, : depth_m.shape[1] : COMPARED_STEP]
    z = depth_m[rows, columns].astype(np.float64)
    valid = z > 0
    rays = [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(z.shape)]
    points = np.stack(rays)[:, valid] * z[valid]
    x, y, z = T_other_camera[:3, :3] @ points + T_other_camera[:3, 3:]
    front = z > 0
    x, y, z = x[front], y[front], z[front]
    u = np.rint(other.fx * x / z + other.cx)
    v = np.rint(other.fy * y / z + other.cy)
    height, width = other_depth_m.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    seen = other_depth_m[v[inside].astype(np.int64), u[inside].astype(np.int64)]
    z, seen = z[inside][seen > 0], seen[seen > 0]
    if not len(z):
        return 0.0, 0.0, 0.0
    tolerance = DEPTH_TOLERANCE_M + DEPTH_TOLERANCE_FRACTION * z
    shared = len(z) / np.count_nonzero(valid)
    return (
        shared,
        float(np.mean(np.abs(seen - z) < tolerance)),
        float(np.mean(z + tolerance < seen)),
    )
