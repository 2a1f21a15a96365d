"""Which way is up in the world frame, from how the camera is held."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import ConfigurationError

AXES = {"z": (0.0, 0.0, 1.0), "y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0)}

# A hand rolls a camera less than this; a world axis that the camera's rows are level with within
# it, and that points up in the image, is taken to be vertical.
LEVEL_RADIANS = np.radians(15.0)


class UpEstimator:
    """Unit vector (3,) that points up in the world frame.

    A named axis is used as it stands. With ``auto`` it is +z (the ROS convention, REP 103) as
    long as the poses agree with that; otherwise the direction to which the camera's image rows
    have been closest to orthogonal, because hands and mounts keep a camera level.

    Args:
        axis: ``auto`` or a key of AXES.

    Raises:
        ConfigurationError: for another axis.
    """

    def __init__(self, axis: str = "auto") -> None:
        if axis != "auto" and axis not in AXES:
            raise ConfigurationError(f"world_up {axis!r}: wanted auto, {', '.join(AXES)}")
        self._axis = axis
        self._count = 0
        self._rows = np.zeros((3, 3))  # sum of x xᵀ over the cameras' x axes
        self._image_up = np.zeros(3)  # sum of the cameras' -y axes

    def observe(self, T_world_camera: Float64) -> None:
        """Take one more camera pose (4, 4) into account."""
        x_axis = T_world_camera[:3, 0]
        self._rows += np.outer(x_axis, x_axis)
        self._image_up -= T_world_camera[:3, 1]
        self._count += 1

    def up_world(self) -> Float64:
        """Up, (3,) float64 unit vector; +z before any pose was seen."""
        if self._axis != "auto":
            return np.array(AXES[self._axis])
        z = np.array(AXES["z"])
        if self._count == 0:
            return z
        tilt = float(np.sqrt(z @ self._rows @ z / self._count))
        if tilt < np.sin(LEVEL_RADIANS) and z @ self._image_up > 0.3 * self._count:
            return z
        # With little turning, the least eigenvector is not unique: lean towards the image's up.
        mean_up = self._image_up / max(float(np.linalg.norm(self._image_up)), 1e-12)
        lean = 0.02 * self._count * np.outer(mean_up, mean_up)
        up = np.linalg.eigh(self._rows - lean)[1][:, 0]
        return np.asarray(up if up @ mean_up >= 0 else -up)
