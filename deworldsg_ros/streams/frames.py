"""Assemblers of complete frames: for perception, lifting, relations and odometry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8, UInt16
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame, SentDetections
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, LocalGraph
from deworldsg_ros.scene.limits import checked_frame_id
from deworldsg_ros.streams.assembler import Assembler, OnDrop, Out, Stream, T
from deworldsg_ros.streams.detections import sent_detections
from deworldsg_ros.streams.images import (
    depth_from_message,
    instances_from_message,
    intrinsics_from_message,
    rgb_from_message,
)
from deworldsg_ros.streams.poses import ClockGate, JumpGate, PoseStream, TransformTree
from deworldsg_ros.wire.messages import DetectionsMessage, ns_from_stamp

# --- Join depth, camera_info and pose to the items of a leading stream.

# Topics before remapping; a caller may pass the remapped names instead.
TOPICS = {
    "rgb": "rgb/image_raw",
    "depth": "depth/image_raw",
    "camera_info": "rgb/camera_info",
    "pose": "camera/pose",
    "frame_graph": "deworldsg/frame_graph",
    "instances": "deworldsg/instances",
    "local_graph": "deworldsg/local_graph",
    "detections": "deworldsg/detections",
    "detection_instances": "deworldsg/detections/instances",
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


# --- RGB-D frames without a pose, for odometry.

# After a stamp of the future, the next ones are earlier. Odometry would begin anew at the origin,
# for good: so a stamp is held back if a camera that odometry can follow does not reach it.
MAX_GAP_NS = 10**9


@dataclass(frozen=True)
class UnposedFrame:
    """One RGB-D image; depth is registered to colour.

    Attributes:
        stamp_ns: time of the RGB image.
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32, metres; 0 = invalid.
        intrinsics: of both images.
    """

    stamp_ns: int
    rgb: UInt8
    depth_m: Float32
    intrinsics: Intrinsics


class UnposedAssembler(PosedAssembler[Any, UnposedFrame]):
    """RGB images with depth and camera_info, in stamp order; arguments as `FrameAssembler`."""

    def __init__(
        self,
        inputs: InputsConfig,
        *,
        topics: Mapping[str, str] | None = None,
        capacity: int = 64,
        max_wait_s: float = 2.0,
        on_drop: OnDrop | None = None,
    ) -> None:
        super().__init__("rgb", (), inputs, topics, capacity, max_wait_s, on_drop)
        self._streams.remove(self._pose)
        for stream in self._streams:
            # A jump begins odometry anew, so it has to be sure.
            stream.gate = ClockGate(MAX_GAP_NS, confirmed_by=3)

    def add_rgb(self, message: Any, stamp_ns: int) -> None:
        """Keep an RGB image, Image or CompressedImage."""
        self._add(self._leader, stamp_ns, message)

    def _settled(self, stamp_ns: int, value: Any) -> bool:
        return bool(self._intrinsics) and self._depth.settled(stamp_ns)

    def _build(self, stamp_ns: int, value: Any) -> Callable[[], UnposedFrame]:
        return partial(
            _decode, stamp_ns, value, self._depth_at(stamp_ns), self._intrinsics_at(stamp_ns)
        )


def _decode(
    stamp_ns: int, message: Any, decode_depth: Callable[[], Float32], intrinsics: Intrinsics
) -> UnposedFrame:
    depth_m = decode_depth()
    rgb = rgb_from_message(message)
    if rgb.shape[:2] != (intrinsics.height, intrinsics.width) or rgb.shape[:2] != depth_m.shape:
        raise RefusedInput(
            "grid_mismatch",
            f"RGB is {rgb.shape[1]}x{rgb.shape[0]}, depth {depth_m.shape[1]}x"
            f"{depth_m.shape[0]}, camera_info {intrinsics.width}x{intrinsics.height}: expected "
            "one size. Register the depth to the RGB image",
        )
    return UnposedFrame(stamp_ns, rgb, depth_m, intrinsics)


# --- Assemblers of complete frames: for perception, for lifting and for relations.

NO_IMAGE: UInt8 = np.zeros((0, 0, 3), np.uint8)


@dataclass(frozen=True)
class LiftingFrame:
    """The input of lifting for one frame.

    Attributes:
        frame_graph: objects of the image.
        instances: (H, W) uint16; 0 = no object, k = k-th object of the frame graph.
        depth_m: (H, W) float32, metres; 0 = invalid.
        intrinsics: of the image.
        T_world_camera: (4, 4) float64.
        frame_id: name of the world frame.
    """

    frame_graph: FrameGraph
    instances: UInt16
    depth_m: Float32
    intrinsics: Intrinsics
    T_world_camera: Float64
    frame_id: str


@dataclass(frozen=True)
class PairingFrame:
    """The input of relations for one frame: its local graph and its image, (H, W, 3) uint8 RGB.

    The image is empty if the assembler does not wait for images.
    """

    local: LocalGraph
    rgb: UInt8


class FrameAssembler(PosedAssembler[Any, RgbdFrame]):
    """Complete RGB-D frames with poses, in order of the stamps of the RGB images.

    Messages may be of ROS or of a bag: PoseStamped, Odometry or TF; Image or CompressedImage.

    Args:
        inputs: section ``inputs`` of the configuration.
        topics: topic of each stream, for the diagnostics.
        capacity: maximum number of messages in the buffer of each stream.
        max_wait_s: maximum time that an RGB image waits for the other streams.
        on_drop: called with the reason, a message and the number of items of each drop.
        with_detections: whether each image waits for the detections of another process; one
            without is dropped.
        sparse: whether the frames are single pictures, see `JumpGate`.

    Attributes:
        drops: number of dropped items by reason.
    """

    def __init__(
        self,
        inputs: InputsConfig,
        *,
        topics: Mapping[str, str] | None = None,
        capacity: int = 64,
        max_wait_s: float = 2.0,
        on_drop: OnDrop | None = None,
        with_detections: bool = False,
        sparse: bool = False,
    ) -> None:
        others = ("detections",) if with_detections else ()
        super().__init__("rgb", others, inputs, topics, capacity, max_wait_s, on_drop)
        self._sparse = sparse
        self._gate = JumpGate(sparse)
        self._detections: Stream[DetectionsMessage] | None = self._others.get("detections")
        # The instance image is optional: images wait for it after the first one.
        name = "detection_instances"
        self._instances: Stream[Any] = Stream(name, {**TOPICS, **(topics or {})}[name], capacity)

    def add_rgb(self, message: Any, stamp_ns: int) -> None:
        """Keep an RGB image, Image or CompressedImage."""
        self._add(self._leader, stamp_ns, message)

    def add_detections(self, message: DetectionsMessage) -> None:
        """Keep the detections of an image."""
        if self._detections is not None:
            self._add(self._detections, ns_from_stamp(message.stamp), message)

    def add_detection_instances(self, message: Any, stamp_ns: int) -> None:
        """Keep the instance image of detections: mono16, k + 1 on the pixels of the k-th one."""
        if self._detections is not None:
            self._add(self._instances, stamp_ns, message)

    def _restart(self, stamp_ns: int) -> None:
        super()._restart(stamp_ns)
        if self._instances.restarts(stamp_ns):
            self._instances.clear()
        self._gate = JumpGate(self._sparse)

    def _settled(self, stamp_ns: int, value: Any) -> bool:
        if self._detections is None:
            return self._posed(stamp_ns)
        has_masks = self._instances.newest_ns is None or self._instances.settled(stamp_ns)
        return self._detections.settled(stamp_ns) and has_masks and self._posed(stamp_ns)

    def _build(self, stamp_ns: int, value: Any) -> Callable[[], RgbdFrame]:
        intrinsics = self._intrinsics_at(stamp_ns)
        T_world_camera, frame_id = self._source().at(stamp_ns, self.camera_frame)
        decode_depth = self._depth_at(stamp_ns)
        decode_sent = self._sent_at(stamp_ns, intrinsics)
        self._gate.check(T_world_camera, stamp_ns, (decode_depth, intrinsics))

        def decode() -> RgbdFrame:
            depth_m, rgb = decode_depth(), rgb_from_message(value)
            sent = None if decode_sent is None else decode_sent()
            return RgbdFrame(stamp_ns, rgb, depth_m, intrinsics, T_world_camera, frame_id, sent)

        return decode

    def _sent_at(
        self, stamp_ns: int, intrinsics: Intrinsics
    ) -> Callable[[], SentDetections] | None:
        """A function that decodes the detections of an image; None = they are not wanted."""
        if self._detections is None:
            return None
        message = self._detections.exact(stamp_ns)
        masks = None
        if self._instances.newest_ns is not None:
            masks = self._instances.exact(stamp_ns)

        def decode() -> SentDetections:
            instances = None if masks is None else instances_from_message(masks)
            return sent_detections(message, intrinsics.width, intrinsics.height, instances)

        return decode

    def _forget(self, stamp_ns: int) -> None:
        super()._forget(stamp_ns)
        for stream in filter(None, (self._detections, self._instances)):
            self._drop_unmatched(stream, stream.forget_before(stamp_ns + 1))


class LiftingAssembler(PosedAssembler[FrameGraph, LiftingFrame]):
    """Frame graphs with the instances, depth, intrinsics and pose that lift them.

    Lifting checks the sizes. The segmentation refuses pose jumps: a frame with a frame graph has
    passed that gate.
    """

    def __init__(
        self,
        inputs: InputsConfig,
        *,
        topics: Mapping[str, str] | None = None,
        capacity: int = 256,
        max_wait_s: float = 2.0,
        on_drop: OnDrop | None = None,
    ) -> None:
        super().__init__(
            "frame_graph", ("instances",), inputs, topics, capacity, max_wait_s, on_drop
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

    def _build(self, stamp_ns: int, value: FrameGraph) -> Callable[[], LiftingFrame]:
        intrinsics = self._intrinsics_at(stamp_ns)
        T_world_camera, frame_id = self._source().at(stamp_ns, self.camera_frame)
        decode_depth = self._depth_at(stamp_ns)
        message = self._instances.exact(stamp_ns)

        def decode() -> LiftingFrame:
            depth_m, instances = decode_depth(), instances_from_message(message)
            return LiftingFrame(value, instances, depth_m, intrinsics, T_world_camera, frame_id)

        return decode

    def _forget(self, stamp_ns: int) -> None:
        super()._forget(stamp_ns)
        self._drop_unmatched(self._instances, self._instances.forget_before(stamp_ns + 1))


class RelationAssembler(Assembler[LocalGraph, PairingFrame]):
    """Local graphs with the RGB image of the same stamp.

    Args:
        with_rgb: whether to wait for images; without, the image of each frame is empty.
        topics, capacity, max_wait_s, on_drop: as `FrameAssembler`.
    """

    def __init__(
        self,
        *,
        with_rgb: bool = True,
        topics: Mapping[str, str] | None = None,
        capacity: int = 256,
        max_wait_s: float = 2.0,
        on_drop: OnDrop | None = None,
    ) -> None:
        names = {**TOPICS, **(topics or {})}
        rgb: Stream[Any] = Stream("rgb", names["rgb"], capacity)
        self._rgb = rgb if with_rgb else None
        leader: Stream[LocalGraph] = Stream("local_graph", names["local_graph"], capacity)
        others = [rgb] if with_rgb else []
        super().__init__(leader, others, max_wait_s=max_wait_s, on_drop=on_drop)

    def add_rgb(self, message: Any, stamp_ns: int) -> None:
        """Keep an RGB image, Image or CompressedImage."""
        assert self._rgb is not None
        self._add(self._rgb, stamp_ns, message)

    def add_local_graph(self, graph: LocalGraph) -> None:
        """Keep a local graph."""
        self._add(self._leader, graph.stamp_ns, graph)

    def _settled(self, stamp_ns: int, value: LocalGraph) -> bool:
        return self._rgb is None or self._rgb.settled(stamp_ns)

    def _build(self, stamp_ns: int, value: LocalGraph) -> Callable[[], PairingFrame]:
        if self._rgb is None:
            return lambda: PairingFrame(value, NO_IMAGE)
        message = self._rgb.exact(stamp_ns)
        return lambda: PairingFrame(value, rgb_from_message(message))

    def _forget(self, stamp_ns: int) -> None:
        if self._rgb is not None:
            self._drop_unmatched(self._rgb, self._rgb.forget_before(stamp_ns + 1))
