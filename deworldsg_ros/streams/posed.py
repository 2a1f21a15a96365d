"""Join depth, camera_info and pose to the items of a leading stream."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.scene.arrays import Float32
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.names import checked_frame_id
from deworldsg_ros.streams.assembler import Assembler, OnDrop, Out, T
from deworldsg_ros.streams.camera_info import intrinsics_from_message
from deworldsg_ros.streams.images import depth_from_message
from deworldsg_ros.streams.pose_stream import PoseStream
from deworldsg_ros.streams.stamped import Stream
from deworldsg_ros.streams.transforms import TransformTree

# Topics before remapping; a caller may pass the remapped names instead.
TOPICS = {
    "rgb": "rgb/image_raw",
    "depth": "depth/image_raw",
    "camera_info": "rgb/camera_info",
    "pose": "camera/pose",
    "frame_graph": "deworldsg/frame_graph",
    "instances": "deworldsg/instances",
    "local_graph": "deworldsg/local_graph",
}
# Changes of the intrinsics that are remembered: a zoom camera changes them often, and frames that
# still wait for depth or pose need only the newest.
MAX_INTRINSICS = 16


class PosedAssembler(Assembler[T, Out]):
    """Depth, camera_info and pose for the items of a leading stream.

    Attributes:
        camera_frame: the optical frame, as camera_info names it; empty before the first.
    """

    def __init__(
        self,
        leader: str,
        others: tuple[str, ...],
        inputs: InputsConfig,
        topics: Mapping[str, str] | None,
        capacity: int,
        max_wait_s: float,
        on_drop: OnDrop | None,
    ) -> None:
        names = {**TOPICS, **(topics or {})}

        def stream(name: str) -> Stream[Any]:
            return Stream(name, names[name], capacity)

        self._inputs = inputs
        self._depth = stream("depth")
        self._info = stream("camera_info")
        self._pose = stream("pose")
        self._others = {name: stream(name) for name in others}
        super().__init__(
            stream(leader),
            [self._depth, self._info, self._pose, *self._others.values()],
            max_wait_s=max_wait_s,
            on_drop=on_drop,
        )
        self._slop_ns = round(inputs.slop_s * 1e9)
        self._intrinsics: list[tuple[int, Intrinsics]] = []
        self.camera_frame = ""
        self._pose_slop_ns = round(inputs.pose_slop_s * 1e9)
        self._poses = PoseStream(self._pose_slop_ns, inputs.world_frame)
        self._transforms = TransformTree(self._pose_slop_ns, inputs.world_frame)
        # After the first pose message, `auto` never changes to TF, not even after a restart.
        self._had_poses = False

    def add_depth(self, message: Any, stamp_ns: int) -> None:
        """Keep a depth image, Image or CompressedImage."""
        self._add(self._depth, stamp_ns, message)

    def add_camera_info(self, message: Any, stamp_ns: int) -> None:
        """Keep a CameraInfo; new intrinsics are valid from its stamp on.

        It is not part of the stamp order: a latched message may arrive at any time.
        """
        self._info.heard()
        try:
            intrinsics = intrinsics_from_message(message)
            camera_frame = checked_frame_id(str(message.header.frame_id))
        except RefusedInput as refusal:
            self._drop(refusal.reason, str(refusal))
            return
        self.camera_frame = camera_frame
        if not self._intrinsics or self._intrinsics[-1][1] != intrinsics:
            self._intrinsics = [*self._intrinsics, (stamp_ns, intrinsics)][-MAX_INTRINSICS:]

    def expect_transforms(self) -> None:
        """Transform an Odometry of another frame to the camera, with TF from `add_transforms`."""
        self._poses.transforms = self._transforms

    def add_pose(self, message: Any, stamp_ns: int) -> None:
        """Keep a PoseStamped or Odometry of the camera's optical frame."""
        self._add(self._pose, stamp_ns, message)

    def _take(self, stream: Stream[Any], stamp_ns: int, value: Any) -> None:
        if stream is not self._pose:
            super()._take(stream, stamp_ns, value)
            return
        self._hear_pose(stamp_ns)
        try:
            self._poses.add(value, stamp_ns)
            self._had_poses = True
        except RefusedInput as refusal:
            self._drop(refusal.reason, str(refusal))

    def add_transforms(self, message: Any, static: bool = False) -> None:
        """Keep the transforms of a TFMessage of /tf, or of /tf_static."""
        try:
            self._transforms.add(message, static=static)
        except RefusedInput as refusal:
            self._drop(refusal.reason, str(refusal))
        if self._source() is not self._transforms:
            return
        # /tf has many publishers with different stamps: an older stamp is no jump back in time.
        self._pose.heard()
        if not static:
            self._pose.newest_ns = max(self._pose.newest_ns or 0, self._transforms.newest_ns)

    def _hear_pose(self, stamp_ns: int) -> None:
        """Note the stamp of a pose; the poses themselves are in `self._poses`."""
        if self._pose.restarts(stamp_ns):
            self._restart(stamp_ns)
        self._pose.newest_ns = max(stamp_ns, self._pose.newest_ns or stamp_ns)

    def _restart(self, stamp_ns: int) -> None:
        if self._pose.restarts(stamp_ns):
            self._poses = PoseStream(
                self._pose_slop_ns, self._poses.world_frame, self._poses.transforms
            )
            self._transforms.restart()
        super()._restart(stamp_ns)

    def _source(self) -> PoseStream | TransformTree:
        choice = self._inputs.pose_source
        if choice == "tf" or (choice == "auto" and not self._had_poses and len(self._transforms)):
            return self._transforms
        return self._poses

    def _posed(self, stamp_ns: int) -> bool:
        """Whether depth, camera_info and pose of this stamp are settled."""
        return (
            bool(self._intrinsics)
            and self._depth.settled(stamp_ns)
            and self._source().settled(stamp_ns, self.camera_frame)
        )

    def _intrinsics_at(self, stamp_ns: int) -> Intrinsics:
        if not self._intrinsics:
            raise RefusedInput(
                "no_camera_info",
                f"frame at {stamp_ns / 1e9:.3f} s: there is no camera_info: expected a valid one "
                f"on {self._info.topic}",
            )
        current = self._intrinsics[0][1]
        for since_ns, intrinsics in self._intrinsics:
            if since_ns <= stamp_ns:
                current = intrinsics
        return current

    def _depth_at(self, stamp_ns: int) -> Callable[[], Float32]:
        """A function that decodes the depth image nearest to a stamp."""
        return partial(
            depth_from_message,
            self._depth.nearest(stamp_ns, self._slop_ns),
            depth_scale_m=self._inputs.depth_scale,
            max_depth_m=self._inputs.max_depth_m,
        )

    def _forget(self, stamp_ns: int) -> None:
        self._drop_unmatched(self._depth, self._depth.forget_before(stamp_ns - self._slop_ns))
        self._poses.forget_before(stamp_ns)
        self._transforms.forget_before(stamp_ns)
