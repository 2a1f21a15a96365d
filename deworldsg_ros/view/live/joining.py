"""Joins the topics of a frame by its stamp: image, masks, objects, and the nodes they became."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

from deworldsg_ros.scene.arrays import UInt8, UInt16
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.view.live.camera import CameraView, view_of

# Frames that wait for their last part: three seconds of images at 10 Hz.
MOST_WAITING = 30
PARTS = ("rgb", "instances", "local", "node_ids")


class FrameJoiner:
    """Collects the parts of frames, as functions that decode them.

    Args:
        period_s: a frame that is complete earlier after the one before is left out, undecoded.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._waiting: OrderedDict[int, dict[str, Callable[[], Any]]] = OrderedDict()
        self._given_s = float("-inf")

    def add(
        self, part: str, stamp_ns: int, decode: Callable[[], Any], now_s: float
    ) -> CameraView | None:
        """Add a part, one of PARTS; returns the frame if it is complete and not too early.

        Raises:
            RefusedInput: if a part of a complete frame cannot be used.
        """
        parts = self._waiting.setdefault(stamp_ns, {})
        parts[part] = decode
        if len(self._waiting) > MOST_WAITING:
            self._waiting.popitem(last=False)
        if len(parts) < len(PARTS):
            return None
        del self._waiting[stamp_ns]
        if now_s - self._given_s < self._period_s:
            return None
        self._given_s = now_s
        rgb: UInt8 = parts["rgb"]()
        instances: UInt16 = parts["instances"]()
        local: LocalGraph = parts["local"]()
        node_ids: Sequence[int] = parts["node_ids"]()
        return view_of(local, node_ids, rgb, instances)
