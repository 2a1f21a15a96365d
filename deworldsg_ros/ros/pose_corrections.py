"""Pose corrections after loop closures: the nodes follow."""

from __future__ import annotations

from typing import Any

from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.streams.poses import pose_from_message, stamp_ns_of

CORRECTION_TOPIC = "deworldsg/pose_correction"


class PoseCorrections:
    """Applies the corrections, and counts them and the nodes that moved."""

    def __init__(self) -> None:
        self._corrections = self._nodes = 0

    def apply(self, message: Any, builder: GraphBuilder | None) -> None:
        """Move the nodes first observed at the stamp or later; the pose is the rigid transform.

        Args:
            message: PoseStamped.
            builder: of the graph; None before the first local graph.

        Raises:
            RefusedInput: ``no_graph``, ``wrong_frame`` or ``invalid_pose``.
        """
        T_correction, frame_id = pose_from_message(message)
        if builder is None:
            raise RefusedInput(
                "no_graph", "pose correction before the first local graph: no node to correct"
            )
        if frame_id != builder.graph.frame_id:
            raise RefusedInput(
                "wrong_frame",
                f"pose correction is in frame '{frame_id}', expected '{builder.graph.frame_id}'",
            )
        self._nodes += len(builder.apply_correction(T_correction, stamp_ns_of(message)))
        self._corrections += 1

    def values(self) -> dict[str, str]:
        """Both counts, for /diagnostics."""
        return {
            "pose corrections": str(self._corrections),
            "nodes moved by corrections": str(self._nodes),
        }
