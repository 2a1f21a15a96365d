"""The up direction of the world frame, from the poses of the camera."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.checks import holds, within
from deworldsg_ros.scene.errors import ConfigurationError

AXES = {"z": (0.0, 0.0, 1.0), "y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0)}

MAX_POSES = 2**52

# An estimate of all but this fraction of the poses is as good, and saves most estimates.
_NEW_POSES = 1 / 32

# Hand-held cameras roll less than this. A world axis is vertical if the image rows are orthogonal
# to it within this angle and it points up in the image.
_LEVEL_RADIANS = np.radians(15.0)
# A camera is on its side if up is within this angle of its image rows, and if at least this part of
# up lies in the image plane. Nobody holds a camera so by chance.
_SIDE_RADIANS = np.radians(30.0)
_IN_PLANE = 0.7
# The least mean of (x · z)² at which a camera that began on its side still is.
_STILL_ON_SIDE = 0.6


def quarter_turns(up_camera: Float64) -> int | None:
    """Quarter turns counter-clockwise, 0 to 3, that bring up to the top of the image.

    None if up points to no side of the image clearly: the camera looks down, or is tilted.

    Args:
        up_camera: (3,) unit vector in the optical frame: x right, y down.
    """
    x, y, _ = up_camera
    roll = float(np.arctan2(x, -y))
    turns = round(roll / (np.pi / 2))
    clear = np.hypot(x, y) >= _IN_PLANE and abs(roll - turns * np.pi / 2) <= _SIDE_RADIANS
    return turns % 4 if clear else None


class UpEstimator:
    """Unit vector (3,) that points up in the world frame.

    A named axis is used as given. ``auto`` means +z (the ROS convention, REP 103) if the poses
    agree with it. They also agree if the camera is mounted on its side: it began so, and its image
    rows are still vertical. Otherwise it is the direction that is most orthogonal to the image
    rows, because hands and mounts keep a camera level.

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
        self._began_on_side = False
        # The last estimate, and how many poses it is from.
        self._known: Float64 | None = None
        self._known_count = -1

    def observe(self, T_world_camera: Float64) -> None:
        """Add a camera pose (4, 4)."""
        x_axis = T_world_camera[:3, 0]
        if self._count == 0:
            self._began_on_side = quarter_turns(T_world_camera[2, :3]) in (1, 3)
        self._rows += x_axis[:, None] * x_axis
        self._image_up -= T_world_camera[:3, 1]
        self._count += 1

    def state(self) -> Float64:
        """Everything that it knows, (14,) float64, for `restore`."""
        began = float(self._began_on_side)
        return np.concatenate([[self._count], self._rows.ravel(), self._image_up, [began]])

    def restore(self, state: Float64) -> None:
        """Continue from a state, or from one of 13 numbers of an older release.

        Raises:
            ValueError: if it is none.
        """
        if state.shape == (13,):
            state = np.append(state, 0.0)
        if state.shape != (14,) or state.dtype != np.float64:
            raise ValueError(
                f"state of the up direction has shape {state.shape} of {state.dtype}: expected "
                "(14,) of float64"
            )
        # The other numbers are sums of products of vectors, one for each pose. Poses with a few
        # decimals, which `check_pose` lets pass, have vectors that are not quite unit vectors.
        holds("state of the up direction", 0 <= state[0] <= MAX_POSES, "0 to 2^52 poses")
        most = state[0] * 1.01
        within("state of the up direction", state[1:13], -most, most)
        holds("state of the up direction", state[13] in (0, 1), "0 or 1 at the end")
        self._count = int(state[0])
        self._rows = state[1:10].reshape(3, 3).copy()
        self._image_up = state[10:13].copy()
        self._began_on_side = bool(state[13])
        self._known_count = -1

    def up_world(self, exact: bool = True) -> Float64:
        """Up, (3,) float64 unit vector; +z before the first pose.

        Args:
            exact: false = the newest poses may be left out.
        """
        most = self._known_count if exact else self._known_count * (1 + _NEW_POSES)
        if self._known is None or not self._known_count <= self._count <= most:
            self._known, self._known_count = self._estimate(), self._count
        return self._known

    def _estimate(self) -> Float64:
        if self._axis != "auto":
            return np.array(AXES[self._axis])
        z = np.array(AXES["z"])
        if self._count == 0:
            return z
        tilt = float(np.sqrt(z @ self._rows @ z / self._count))
        if tilt < np.sin(_LEVEL_RADIANS) and z @ self._image_up > 0.3 * self._count:
            return z
        if self._began_on_side and tilt**2 > _STILL_ON_SIDE:
            return z
        # With little rotation, the smallest eigenvector is not unique: prefer the image's up.
        mean_up = self._image_up / max(float(np.linalg.norm(self._image_up)), 1e-12)
        lean = 0.02 * self._count * np.outer(mean_up, mean_up)
        up = np.linalg.eigh(self._rows - lean)[1][:, 0]
        return np.asarray(up if up @ mean_up >= 0 else -up)
