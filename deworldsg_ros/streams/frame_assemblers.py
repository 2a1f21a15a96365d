"""Assemblers of complete frames: for perception, for lifting and for relations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8, UInt16
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.frame_graph import FrameGraph, LocalGraph
from deworldsg_ros.streams.assembler import Assembler, OnDrop
from deworldsg_ros.streams.images import instances_from_message, rgb_from_message
from deworldsg_ros.streams.jump_gate import JumpGate
from deworldsg_ros.streams.posed import TOPICS, PosedAssembler
from deworldsg_ros.streams.stamped import Stream

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
    ) -> None:
        super().__init__("rgb", (), inputs, topics, capacity, max_wait_s, on_drop)
        self._gate = JumpGate()

    def add_rgb(self, message: Any, stamp_ns: int) -> None:
        """Keep an RGB image, Image or CompressedImage."""
        self._add(self._leader, stamp_ns, message)

    def _restart(self, stamp_ns: int) -> None:
        super()._restart(stamp_ns)
        self._gate = JumpGate()

    def _settled(self, stamp_ns: int, value: Any) -> bool:
        return self._posed(stamp_ns)

    def _build(self, stamp_ns: int, value: Any) -> Callable[[], RgbdFrame]:
        intrinsics = self._intrinsics_at(stamp_ns)
        T_world_camera, frame_id = self._source().at(stamp_ns, self.camera_frame)
        decode_depth = self._depth_at(stamp_ns)
        self._gate.check(T_world_camera, stamp_ns)

        def decode() -> RgbdFrame:
            depth_m, rgb = decode_depth(), rgb_from_message(value)
            return RgbdFrame(stamp_ns, rgb, depth_m, intrinsics, T_world_camera, frame_id)

        return decode


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
