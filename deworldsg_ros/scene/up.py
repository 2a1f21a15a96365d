"""The up direction of the world frame, from the poses of the camera."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.array_checks import holds, within
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import ConfigurationError

AXES = {"z": (0.0, 0.0, 1.0), "y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0)}

MAX_POSES = 2**52

# Hand-held cameras roll less than this. A world axis is vertical if the image rows are orthogonal
# to it within this angle and it points up in the image.
_LEVEL_RADIANS = np.radians(15.0)


class UpEstimator:
    """Unit vector (3,) that points up in the world frame.

    A named axis is used as given. ``auto`` means +z (the ROS convention, REP 103) if the poses
    agree with it. Otherwise it is the direction that is most orthogonal to the image rows, because
    hands and mounts keep a camera level.

    Args:
        axis: ``auto`` or a key of AXES.

    Raises:
        ConfigurationError: for another axis.
    """

    def __init__(self, axis: str = "auto") -> None:
        if axis != "auto" and axis not in AXES:
            raise ConfigurationError(f"world_up {axis!r}: expected auto, {', '.join(AXES)}")
        self._axis = axis
        self._count = 0
        self._rows = np.zeros((3, 3))  # sum of x xᵀ over the cameras' x axes
        self._image_up = np.zeros(3)  # sum of the cameras' -y axes

    def observe(self, T_world_camera: Float64) -> None:
        """Add a camera pose (4, 4)."""
        x_axis = T_world_camera[:3, 0]
        self._rows += np.outer(x_axis, x_axis)
        self._image_up -= T_world_camera[:3, 1]
        self._count += 1

    def state(self) -> Float64:
        """Everything that it knows, (13,) float64, for `restore`."""
        return np.concatenate([[self._count], self._rows.ravel(), self._image_up])

    def restore(self, state: Float64) -> None:
        """Continue from a state; ValueError if it is none."""
        if state.shape != (13,) or state.dtype != np.float64:
            raise ValueError(
                f"state of the up direction has shape {state.shape} of {state.dtype}: expected "
                "(13,) of float64"
            )
        # The other numbers are sums of products of unit vectors, one for each pose.
        holds("state of the up direction", 0 <= state[0] <= MAX_POSES, "0 to 2^52 poses")
        most = state[0] * (1 + 1e-6)
        within("state of the up direction", state[1:], -most, most)
        self._count = int(state[0])
        self._rows = state[1:10].reshape(3, 3).copy()
        self._image_up = state[10:].copy()

    def up_world(self) -> Float64:
        """Up, (3,) float64 unit vector; +z before the first pose."""
        if self._axis != "auto":
            return np.array(AXES[self._axis])
        z = np.array(AXES["z"])
        if self._count == 0:
            return z
        tilt = float(np.sqrt(z @ self._rows @ z / self._count))
        if tilt < np.sin(_LEVEL_RADIANS) and z @ self._image_up > 0.3 * self._count:
            return z
        # With little rotation, the smallest eigenvector is not unique: prefer the image's up.
        mean_up = self._image_up / max(float(np.linalg.norm(self._image_up)), 1e-12)
        lean = 0.02 * self._count * np.outer(mean_up, mean_up)
        up = np.linalg.eigh(self._rows - lean)[1][:, 0]
        return np.asarray(up if up @ mean_up >= 0 else -up)
