"""Convert CameraInfo messages to intrinsics."""

from __future__ import annotations

from typing import Any

from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RefusedInput


def intrinsics_from_message(message: Any) -> Intrinsics:
    """Intrinsics from the matrix K of a `sensor_msgs/CameraInfo`.

    Raises:
        RefusedInput: ``invalid_intrinsics`` for a message without K, for a matrix of another size,
            for NaN, or for zeros, which an uncalibrated camera publishes.
    """
    matrix = getattr(message, "k", None)
    if matrix is None:
        matrix = getattr(message, "K", None)  # ROS 1 bags
    if matrix is None:
        kind = type(message).__name__
        raise RefusedInput("invalid_intrinsics", f"camera_info is a {kind}: expected a CameraInfo")
    if len(matrix) != 9:
        raise RefusedInput(
            "invalid_intrinsics", f"camera_info: K has {len(matrix)} values: expected 9"
        )
    return Intrinsics(
        fx=float(matrix[0]),
        fy=float(matrix[4]),
        cx=float(matrix[2]),
        cy=float(matrix[5]),
        width=int(message.width),
        height=int(message.height),
    )
