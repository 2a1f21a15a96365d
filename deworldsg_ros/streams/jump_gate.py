"""A gate against poses that jump."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.poses.motion import rotation_angle_deg
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import RefusedInput

# Frames that come faster are judged as if they came at this interval: of two of them the noise of
# the poses, and not the camera, makes most of the rotation.
SHORTEST_S = 1 / 15


class JumpGate:
    """Refuses a frame whose camera jumped; a place that is held is believed after a while.

    A tracker that loses itself for a frame must not smear the graph; one that relocalises must
    not silence it for good.

    Args:
        max_step_m: camera movement between frames above which it is a jump.
        max_turn_deg_s: rotation above which it is one, degrees a second of the frames' stamps.
        believed_after: consecutive frames without a jump between them that make a new place true.
    """

    def __init__(self, max_step_m: float, max_turn_deg_s: float, believed_after: int = 5) -> None:
        self._max_step_m = max_step_m
        self._max_turn_deg_s = max_turn_deg_s
        self._believed_after = believed_after
        self._accepted: tuple[int, Float64] | None = None
        self._candidate: tuple[int, Float64] | None = None
        self._held = 0

    def check(self, T_world_camera: Float64, stamp_ns: int) -> None:
        """Accept a frame's pose, or refuse it: ``pose_jump``."""
        pose = (stamp_ns, T_world_camera.copy())
        jump = self._jump(self._accepted, pose) if self._accepted else ""
        if jump:
            is_held = self._candidate is not None and not self._jump(self._candidate, pose)
            self._held = self._held + 1 if is_held else 1
            self._candidate = pose
            if self._held < self._believed_after:
                raise RefusedInput(
                    "pose_jump",
                    f"camera {jump}, or {self._believed_after} frames at the new place (this is "
                    f"number {self._held})",
                )
        self._accepted = pose
        self._candidate = None
        self._held = 0

    def _jump(self, before: tuple[int, Float64], now: tuple[int, Float64]) -> str:
        """What is too much between two frames, in words; empty where nothing is."""
        step_m = float(np.linalg.norm(now[1][:3, 3] - before[1][:3, 3]))
        if step_m > self._max_step_m:
            return (
                f"moved {step_m:.2f} m since the last accepted frame: wanted at most "
                f"{self._max_step_m:g} m (inputs.max_step_m)"
            )
        elapsed_s = max((now[0] - before[0]) / 1e9, SHORTEST_S)
        turn_deg = rotation_angle_deg(before[1][:3, :3].T @ now[1][:3, :3])
        if turn_deg > self._max_turn_deg_s * elapsed_s:
            return (
                f"turned {turn_deg:.0f} degrees in the {elapsed_s:.2f} s since the last accepted "
                f"frame: wanted at most {self._max_turn_deg_s:g} a second (inputs.max_turn_deg_s)"
            )
        return ""
