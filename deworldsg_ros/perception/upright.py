"""Frames of a camera that is mounted on its side, turned upright for the detector.

A quarter turn moves pixels and does not change them: the pixel (u, v) of an image of width W
becomes (v, W - 1 - u). Boxes and instances are turned back exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from deworldsg_ros.scene.arrays import Float64, UInt16
from deworldsg_ros.scene.camera import Intrinsics, RgbdFrame
from deworldsg_ros.scene.frame_graph import FrameGraph
from deworldsg_ros.scene.up import UpEstimator, quarter_turns

# R_camera_turned of one quarter turn: the new x axis is y, the new y axis is -x.
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class UprightFrame:
    """A frame, and the same frame turned upright.

    Attributes:
        original: as the camera took it.
        upright: the same object if it needs no turn.
        turns: quarter turns counter-clockwise from `original` to `upright`, 0 to 3.
    """

    original: RgbdFrame
    upright: RgbdFrame
    turns: int = 0


class Uprighter:
    """Decides for each frame, in order of time, how it is turned.

    The turn changes only when up is clearly in the direction of another side of the image. A camera
    that looks straight down keeps its turn.

    Args:
        world_up: as `UpEstimator`.
    """

    def __init__(self, world_up: str) -> None:
        self._up = UpEstimator(world_up)
        self._turns = 0

    def turn(self, frame: RgbdFrame) -> UprightFrame:
        """The frame, upright."""
        self._up.observe(frame.T_world_camera)
        turns = quarter_turns(frame.T_world_camera[:3, :3].T @ self._up.up_world())
        self._turns = self._turns if turns is None else turns
        return UprightFrame(frame, turned(frame, self._turns), self._turns)


def turned(frame: RgbdFrame, turns: int) -> RgbdFrame:
    """A frame after so many quarter turns counter-clockwise; its pose is that of the turned camera.

    The same object for no turn.
    """
    if turns % 4 == 0:
        return frame
    intrinsics, T_world_camera = frame.intrinsics, frame.T_world_camera.copy()
    for _ in range(turns % 4):
        i = intrinsics
        intrinsics = Intrinsics(i.fy, i.fx, i.cy, i.width - 1 - i.cx, i.height, i.width)
        T_world_camera[:3, :3] = T_world_camera[:3, :3] @ QUARTER_TURN
    return replace(
        frame,
        rgb=np.ascontiguousarray(np.rot90(frame.rgb, turns)),
        depth_m=np.ascontiguousarray(np.rot90(frame.depth_m, turns)),
        intrinsics=intrinsics,
        T_world_camera=T_world_camera,
    )


def turned_back(
    frame_graph: FrameGraph, instances: UInt16, turns: int
) -> tuple[FrameGraph, UInt16]:
    """Frame graph and instance image (H, W) of `turned`, for the image before the turns."""
    if turns % 4 == 0:
        return frame_graph, instances
    instances = np.ascontiguousarray(np.rot90(instances, -turns))
    boxes, height = frame_graph.boxes_xyxy, frame_graph.height
    width = frame_graph.width
    for _ in range(turns % 4):
        boxes = _turned_back_once(boxes, height)
        width, height = height, width
    return replace(frame_graph, boxes_xyxy=boxes, width=width, height=height), instances


def _turned_back_once(boxes_xyxy: Float64, height: int) -> Float64:
    """Boxes (n, 4) before one quarter turn, which led to an image of this height."""
    u1, v1, u2, v2 = boxes_xyxy.T
    return np.stack([height - 1 - v2, u1, height - 1 - v1, u2], axis=1)
