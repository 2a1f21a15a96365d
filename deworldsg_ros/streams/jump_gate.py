"""Refuse frames whose camera pose jumps."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.rigid import rotation_angle_deg

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


class JumpGate:
    """Refuses a frame whose camera jumped; accepts a new position that persists.

    A frame jumped if, since the last accepted frame, the camera moved more than `MAX_STEP_M` or
    rotated faster than `MAX_ROTATION_DEG_S`. After `RELOCALISED_AFTER_FRAMES` consecutive frames
    without a jump between them, the tracker has relocalised and the new position is accepted.
    """

    def __init__(self) -> None:
        self._accepted: tuple[int, Float64] | None = None
        self._candidate: tuple[int, Float64] | None = None
        self._consistent_frames = 0

    def check(self, T_world_camera: Float64, stamp_ns: int) -> None:
        """Accept the pose (4, 4) of a frame; raises RefusedInput ``pose_jump`` for a jump."""
        pose = (stamp_ns, T_world_camera.copy())
        jump = _jump(self._accepted, pose) if self._accepted else ""
        if jump:
            is_consistent = self._candidate is not None and not _jump(self._candidate, pose)
            self._consistent_frames = self._consistent_frames + 1 if is_consistent else 1
            self._candidate = pose
            if self._consistent_frames < RELOCALISED_AFTER_FRAMES:
                raise RefusedInput(
                    "pose_jump",
                    f"camera {jump}, or {RELOCALISED_AFTER_FRAMES} consistent frames at the new "
                    f"position (this is number {self._consistent_frames}). Check the localisation",
                )
        self._accepted = pose
        self._candidate = None
        self._consistent_frames = 0


def _jump(before: tuple[int, Float64], now: tuple[int, Float64]) -> str:
    """Which limit two poses exceed, in words; empty for a plausible motion."""
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
