"""CameraInfo messages to intrinsics."""

from __future__ import annotations

from typing import Any

from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RefusedInput


def intrinsics_from_message(message: Any) -> Intrinsics:
    """Intrinsics of K of a `sensor_msgs/CameraInfo`.

    Raises:
        RefusedInput: ``invalid_intrinsics`` for a matrix of another size, NaN, or zeros as an
            uncalibrated camera sends them.
    """
    matrix = getattr(message, "k", None)
    if matrix is None:
        matrix = message.K  # ROS 1 bags
    if len(matrix) != 9:
        raise RefusedInput("invalid_intrinsics", f"K has {len(matrix)} values: wanted 9")
    return Intrinsics(
        fx=float(matrix[0]),
        fy=float(matrix[4]),
        cx=float(matrix[2]),
        cy=float(matrix[5]),
        width=int(message.width),
        height=int(message.height),
    )
