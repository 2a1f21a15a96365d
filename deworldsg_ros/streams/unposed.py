"""RGB-D frames without a pose, for odometry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from deworldsg_ros.config import InputsConfig
from deworldsg_ros.scene.arrays import Float32, UInt8
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.assembler import OnDrop
from deworldsg_ros.streams.clock_gate import ClockGate
from deworldsg_ros.streams.images import rgb_from_message
from deworldsg_ros.streams.posed import PosedAssembler

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
            stream.gate = ClockGate(MAX_GAP_NS)

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
