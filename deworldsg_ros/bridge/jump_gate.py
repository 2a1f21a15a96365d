"""A gate against poses that jump."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.camera import Float64
from deworldsg_ros.scene.errors import RefusedInput


class JumpGate:
    """Refuses a frame whose camera jumped; a place that is held is believed after a while.

    A tracker that loses itself for a frame must not smear the graph; one that relocalises must
    not silence it for good.

    Args:
        max_step_m: camera movement between frames above which it is a jump.
        believed_after: consecutive frames without a jump between them that make a new place true.
    """

    def __init__(self, max_step_m: float, believed_after: int = 5) -> None:
        self._max_step_m = max_step_m
        self._believed_after = believed_after
        self._accepted: Float64 | None = None
        self._candidate: Float64 | None = None
        self._held = 0

    def check(self, T_world_camera: Float64) -> None:
        """Accept a frame's pose, or refuse it: ``pose_jump``."""
        position = T_world_camera[:3, 3].copy()
        if self._accepted is None or self._near(self._accepted, position):
            self._accept(position)
            return
        near_candidate = self._candidate is not None and self._near(self._candidate, position)
        self._held = self._held + 1 if near_candidate else 1
        self._candidate = position
        if self._held >= self._believed_after:
            self._accept(position)
            return
        step_m = float(np.linalg.norm(position - self._accepted))
        raise RefusedInput(
            "pose_jump",
            f"camera moved {step_m:.2f} m since the last accepted frame: wanted at most "
            f"{self._max_step_m:g} m (inputs.max_step_m), or {self._believed_after} frames at the "
            f"new place (this is number {self._held})",
        )

    def _near(self, a: Float64, b: Float64) -> bool:
        return float(np.linalg.norm(a - b)) <= self._max_step_m

    def _accept(self, position: Float64) -> None:
        self._accepted = position
        self._candidate = None
        self._held = 0
