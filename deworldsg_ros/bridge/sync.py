"""What belongs together: RGB, depth, camera_info and pose; what lifting and relations need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.bridge.camera_info import intrinsics_from_message
from deworldsg_ros.bridge.images import (
    depth_from_message,
    instances_from_message,
    rgb_from_message,
)
from deworldsg_ros.bridge.poses import JumpGate, PoseStream, stamp_ns_of
from deworldsg_ros.bridge.streams import Assembler, OnDrop, Out, Stream, T
from deworldsg_ros.bridge.transforms import TransformTree
from deworldsg_ros.config import InputsConfig
from deworldsg_ros.scene.camera import Float64, Intrinsics, RgbdFrame
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, LocalGraph

# Topics as the nodes name them; a caller that knows the remapped names gives those.
TOPICS = {
    "rgb": "rgb/image_raw",
    "depth": "depth/image_raw",
    "camera_info": "rgb/camera_info",
    "pose": "camera/pose",
    "frame_graph": "deworldsg/frame_graph",
    "instances": "deworldsg/instances",
    "local_graph": "deworldsg/local_graph",
}


@dataclass(frozen=True)
class LiftingFrame:
    """What lifting needs of one frame.

    Attributes:
        frame_graph: objects of the image.
        instances: (H, W) uint16, k = k-th object of the frame graph, from 1.
        depth_m: (H, W) float32, metres; 0 = invalid.
        intrinsics: of the image.
        T_world_camera: (4, 4) float64.
        frame_id: world frame.
    """

    frame_graph: FrameGraph
    instances: NDArray[np.uint16]
    depth_m: NDArray[np.float32]
    intrinsics: Intrinsics
    T_world_camera: Float64
    frame_id: str


@dataclass(frozen=True)
class PairingFrame:
    """What relations need of one frame: its local graph and its image, (H, W, 3) uint8 RGB."""

    local: LocalGraph
    rgb: NDArray[np.uint8]


class _PosedAssembler(Assembler[T, Out]):
    """Depth, camera_info and pose for the items of a leading stream.

    Attributes:
        camera_frame: the optical frame, as camera_info names it.
    """

    def __init__(
        self,
        leader: str,
        others: tuple[str, ...],
        inputs: InputsConfig,
        topics: Mapping[str, str] | None,
        capacity: int,
        patience_s: float,
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
            patience_s=patience_s,
            on_drop=on_drop,
        )
        self._slop_ns = round(inputs.slop_s * 1e9)
        self._intrinsics: list[tuple[int, Intrinsics]] = []
        self.camera_frame = ""
        self._pose_slop_ns = round(inputs.pose_slop_s * 1e9)
        self._poses = PoseStream(self._pose_slop_ns, inputs.world_frame)
        self._transforms = TransformTree(self._pose_slop_ns, inputs.world_frame)

    def add_depth(self, message: Any, stamp_ns: int) -> None:
        """Keep a depth image, Image or CompressedImage."""
        self._add(self._depth, stamp_ns, message)

    def add_camera_info(self, message: Any, stamp_ns: int) -> None:
        """Keep a CameraInfo; a change counts from its stamp on.

        It is not in the streams' order: one that is latched may come at any time.
        """
        self._info.heard()
        try:
            intrinsics = intrinsics_from_message(message)
        except RefusedInput as refusal:
            self._drop(refusal.reason, str(refusal))
            return
        self.camera_frame = str(message.header.frame_id)
        if not self._intrinsics or self._intrinsics[-1][1] != intrinsics:
            self._intrinsics = [*self._intrinsics[-15:], (stamp_ns, intrinsics)]

    def add_pose(self, message: Any, stamp_ns: int) -> None:
        """Keep a PoseStamped or Odometry of the camera's optical frame."""
        self._hear_pose(stamp_ns)
        try:
            self._poses.add(message, stamp_ns)
        except RefusedInput as refusal:
            self._drop(refusal.reason, str(refusal))

    def add_transforms(self, message: Any, static: bool = False) -> None:
        """Keep the transforms of a TFMessage of /tf, or of /tf_static."""
        if not static:
            self._hear_pose(max(map(stamp_ns_of, message.transforms), default=0))
        try:
            self._transforms.add(message, static=static)
        except RefusedInput as refusal:
            self._drop(refusal.reason, str(refusal))

    def _hear_pose(self, stamp_ns: int) -> None:
        """Note the stamp; poses lie in a buffer of their own, not in the stream."""
        if self._pose.restarts(stamp_ns):
            self._restart()
        self._pose.heard()
        self._pose.newest_ns = max(stamp_ns, self._pose.newest_ns or stamp_ns)

    def _restart(self) -> None:
        super()._restart()
        self._poses = PoseStream(self._pose_slop_ns, self._poses.world_frame)
        self._transforms.restart()

    def _source(self) -> PoseStream | TransformTree:
        wanted = self._inputs.pose_source
        if wanted == "tf" or (wanted == "auto" and not len(self._poses) and len(self._transforms)):
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
                f"frame at {stamp_ns / 1e9:.3f} s: no usable camera_info on {self._info.topic}",
            )
        current = self._intrinsics[0][1]
        for since_ns, intrinsics in self._intrinsics:
            if since_ns <= stamp_ns:
                current = intrinsics
        return current

    def _depth_at(self, stamp_ns: int) -> NDArray[np.float32]:
        return depth_from_message(
            self._depth.nearest(stamp_ns, self._slop_ns),
            depth_scale_m=self._inputs.depth_scale,
            max_depth_m=self._inputs.max_depth_m,
        )

    def _forget(self, stamp_ns: int) -> None:
        self._drop_unmatched(self._depth, self._depth.forget_before(stamp_ns - self._slop_ns))
        self._poses.forget_before(stamp_ns)
        self._transforms.forget_before(stamp_ns)


class FrameAssembler(_PosedAssembler[Any, RgbdFrame]):
    """Complete RGB-D frames with poses, in the order of the RGB images' stamps.

    Messages are those of ROS or of a bag: PoseStamped or Odometry, Image or CompressedImage.

    Args:
        inputs: slops, frames, scales and limits.
        topics: names for the diagnostics, by stream.
        capacity: messages kept of each image stream.
        patience_s: how long an RGB image waits for what it lacks.
        on_drop: called with the reason, the message and the number of every drop.

    Attributes:
        drops: number of drops by reason.
    """

    def __init__(
        self,
        inputs: InputsConfig,
        *,
        topics: Mapping[str, str] | None = None,
        capacity: int = 64,
        patience_s: float = 2.0,
        on_drop: OnDrop | None = None,
    ) -> None:
        super().__init__("rgb", (), inputs, topics, capacity, patience_s, on_drop)
        self._gate = JumpGate(inputs.max_step_m)

    def add_rgb(self, message: Any, stamp_ns: int) -> None:
        """Keep an RGB image, Image or CompressedImage."""
        self._add(self._leader, stamp_ns, message)

    def _restart(self) -> None:
        super()._restart()
        self._gate = JumpGate(self._inputs.max_step_m)

    def _settled(self, stamp_ns: int, value: Any) -> bool:
        return self._posed(stamp_ns)

    def _build(self, stamp_ns: int, value: Any) -> RgbdFrame:
        # Cheap questions first: what is refused need not be decoded.
        intrinsics = self._intrinsics_at(stamp_ns)
        T_world_camera, frame_id = self._source().at(stamp_ns, self.camera_frame)
        depth_m = self._depth_at(stamp_ns)
        rgb = rgb_from_message(value)
        frame = RgbdFrame(stamp_ns, rgb, depth_m, intrinsics, T_world_camera, frame_id)
        self._gate.check(T_world_camera)
        return frame


class LiftingAssembler(_PosedAssembler[FrameGraph, LiftingFrame]):
    """Frame graphs with the instances, depth, intrinsics and pose that lift them.

    That their sizes agree is lifting's to check. Jumps of the pose are the segmentation's to
    refuse: what has a frame graph is accepted.
    """

    def __init__(
        self,
        inputs: InputsConfig,
        *,
        topics: Mapping[str, str] | None = None,
        capacity: int = 256,
        patience_s: float = 2.0,
        on_drop: OnDrop | None = None,
    ) -> None:
        super().__init__(
            "frame_graph", ("instances",), inputs, topics, capacity, patience_s, on_drop
        )
        self._instances = self._others["instances"]

    def add_frame_graph(self, graph: FrameGraph) -> None:
        """Keep a frame graph."""
        self._add(self._leader, graph.stamp_ns, graph)

    def add_instances(self, message: Any, stamp_ns: int) -> None:
        """Keep an instance image."""
        self._add(self._instances, stamp_ns, message)

    def _settled(self, stamp_ns: int, value: FrameGraph) -> bool:
        return self._instances.settled(stamp_ns) and self._posed(stamp_ns)

    def _build(self, stamp_ns: int, value: FrameGraph) -> LiftingFrame:
        intrinsics = self._intrinsics_at(stamp_ns)
        T_world_camera, frame_id = self._source().at(stamp_ns, self.camera_frame)
        depth_m = self._depth_at(stamp_ns)
        instances = instances_from_message(self._instances.exact(stamp_ns))
        return LiftingFrame(value, instances, depth_m, intrinsics, T_world_camera, frame_id)

    def _forget(self, stamp_ns: int) -> None:
        super()._forget(stamp_ns)
        self._drop_unmatched(self._instances, self._instances.forget_before(stamp_ns + 1))


class RelationAssembler(Assembler[LocalGraph, PairingFrame]):
    """Local graphs with the RGB image of the same stamp."""

    def __init__(
        self,
        *,
        topics: Mapping[str, str] | None = None,
        capacity: int = 256,
        patience_s: float = 2.0,
        on_drop: OnDrop | None = None,
    ) -> None:
        names = {**TOPICS, **(topics or {})}
        self._rgb: Stream[Any] = Stream("rgb", names["rgb"], capacity)
        leader: Stream[LocalGraph] = Stream("local_graph", names["local_graph"], capacity)
        super().__init__(leader, [self._rgb], patience_s=patience_s, on_drop=on_drop)

    def add_rgb(self, message: Any, stamp_ns: int) -> None:
        """Keep an RGB image, Image or CompressedImage."""
        self._add(self._rgb, stamp_ns, message)

    def add_local_graph(self, graph: LocalGraph) -> None:
        """Keep a local graph."""
        self._add(self._leader, graph.stamp_ns, graph)

    def _settled(self, stamp_ns: int, value: LocalGraph) -> bool:
        return self._rgb.settled(stamp_ns)

    def _build(self, stamp_ns: int, value: LocalGraph) -> PairingFrame:
        return PairingFrame(value, rgb_from_message(self._rgb.exact(stamp_ns)))

    def _forget(self, stamp_ns: int) -> None:
        self._drop_unmatched(self._rgb, self._rgb.forget_before(stamp_ns + 1))
