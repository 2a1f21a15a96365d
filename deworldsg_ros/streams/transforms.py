"""A small TF tree, built from /tf and /tf_static messages."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.names import OBJECT_FRAME, checked_frame_id
from deworldsg_ros.streams.clock_gate import ClockGate, jump_text
from deworldsg_ros.streams.poses import PoseBuffer, pose_from_transform, stamp_ns_of

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
                lost_ns = self._add_moving(child, stamp_ns_of(transform), T_parent_child)
                if lost_ns is not None:
                    text = jump_text(f"transform of '{child}'", lost_ns)
                    refused.append(RefusedInput("time_jump", text))
            # Last: a reader in another thread then finds the transform of each frame in the tree.
            self._parents[child] = parent
        if refused:
            raise refused[0]

    def _add_moving(self, child: str, stamp_ns: int, T_parent_child: Float64) -> int | None:
        """Keep a transform; returns the stamp of one that is lost (`ClockGate`)."""
        buffer = self._moving.setdefault(child, PoseBuffer(self._slop_ns))
        gate = self._gates.setdefault(child, ClockGate())
        admitted, lost_ns = gate.admit(stamp_ns, T_parent_child)
        for at_ns, T in admitted:
            buffer.add(at_ns, T)
            self.newest_ns = max(self.newest_ns, at_ns)
        return lost_ns

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
