"""Correction of poses that drift or tremble, before a frame is merged. Beyond the paper.

A map of the depth images (`surfels`) gives the error of each pose. Its mean is the drift, the rest
trembles. Each is corrected as far as the noise of its own estimate does not explain it (James and
Stein), so that exact poses stay as they are.
"""

from __future__ import annotations

import math
from itertools import accumulate

import numpy as np

from deworldsg_ros.poses.surfels import JOINT, SurfelMap, about_camera, difference, stepped
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import Intrinsics, invert_pose
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph, derived
from deworldsg_ros.scene.gaussian import transform

# Squared errors add rotation and translation: a radian counts as `surfels.RADIAN_M` metres.
# Error of a registration: with exact poses of two rendered rooms, 5-7 mm.
FIT_VARIANCE_M2 = 0.008**2
# Growth of the drift in a frame. With 4 mm, the mean error follows exact poses within 3 frames and
# poses that tremble by 2 cm and 1 degree within 20; 2 and 8 mm gave similar pose errors.
DRIFT_VARIANCE_M2 = 0.004**2
# Error of the map itself: alone, it drifts by 1 cm and 0.4 degrees in a tour of a room.
MAP_VARIANCE_M2 = 0.03**2
# The mean error is drift if its square exceeds the noise by this factor.
SHRINK = 4.0
# While the map consists of few frames, their trembling moves it; it returns to the mean of this
# number of frames. Error of that mean, as a fraction of a frame's.
FIRST_FRAMES, FIRST_FRACTION = 10.0, 0.1
# An offset that is no drift leaves the map within this path of the camera (metres plus radians).
LEAK_PATH = 10.0
# The variance of trembling is a mean over 20 frames. A frame counts at most 9 times the mean.
VARIANCE_GAIN, MAX_RATIO = 0.05, 9.0
# A frame's own error counts beyond twice the error of a registration.
OUTLIER = 4.0


class Drift:
    """Corrects the poses of frames.

    Attributes:
        T_graph_poses: (4, 4) drift at the newest frame, from the world of the poses to the
            graph's.
    """

    def __init__(self) -> None:
        self.T_graph_poses: Float64 = np.eye(4)
        self._map = SurfelMap()
        self._frames = 0
        self._T_map_poses: Float64 = np.eye(4)  # the mean error
        self._gain = 1.0  # of the mean
        self._error: Float64 = np.zeros(6)  # of the newest frame
        self._trembling_m2 = FIT_VARIANCE_M2  # variance of the errors around their mean
        self._T_last: Float64 | None = None

    def warm_up(self) -> None:
        """Compile the kernels before the first frame."""
        spare = SurfelMap()
        camera = Intrinsics(300.0, 300.0, 160.0, 160.0, 320, 320)
        grid = DepthGrid(np.full((40, 40), 1000, np.uint16), 8, camera)
        for _ in range(2):
            spare.register(np.eye(4), grid)
            spare.add(np.eye(4))
        difference(np.eye(4), about_camera(np.ones(6), np.eye(4)))
        stepped(np.zeros(6), np.eye(4))

    def align(self, local: LocalGraph) -> LocalGraph:
        """The local graph under the corrected pose; the same one without a depth grid."""
        T_given, grid = local.T_world_camera, local.depth_grid
        if grid is None:
            return local
        fitted = self._map.register(self._T_map_poses @ T_given, grid)
        own, rest = (0.0, np.zeros(6)) if fitted is None else self._learn(T_given, fitted)
        mean = difference(T_given, self._T_map_poses @ T_given)
        mean_noise_m2 = self._trembling_m2 * (self._gain / (2.0 - self._gain) + FIRST_FRACTION)
        drift = _shrunk(_squared(mean), SHRINK * mean_noise_m2 + MAP_VARIANCE_M2)
        self.T_graph_poses = about_camera(drift * mean, T_given)
        kept = 1.0 - self._leak(T_given) * (1.0 - drift)
        self._map.add(stepped(rest, stepped(kept * mean, T_given)))
        if drift == own == 0.0:
            return local
        T_corrected = stepped(own * rest, stepped(drift * mean, T_given))
        return moved(local, T_corrected @ invert_pose(T_given))

    def _learn(self, T_given: Float64, fitted: Float64) -> tuple[float, Float64]:
        """Update the mean error; returns the rest of this frame, and the part to correct."""
        self._frames += 1
        expected = self._T_map_poses @ T_given
        step, error = difference(expected, fitted), difference(T_given, fitted)
        # Steady gain of a Kalman filter of a random walk.
        ratio = DRIFT_VARIANCE_M2 / self._trembling_m2
        self._gain = (math.sqrt(ratio**2 + 4.0 * ratio) - ratio) / 2.0
        gain = max(self._gain, 1.0 / self._frames)
        self._T_map_poses = about_camera(gain * step, expected) @ self._T_map_poses
        # The difference of two successive errors contains no drift, and twice the trembling.
        change_m2 = min(_squared(error - self._error) / 2.0, MAX_RATIO * self._trembling_m2)
        self._error = error
        gain = max(VARIANCE_GAIN, 1.0 / (self._frames + 1))
        self._trembling_m2 += gain * (change_m2 - self._trembling_m2)
        own = _shrunk(max(self._trembling_m2, _squared(step) / OUTLIER), FIT_VARIANCE_M2)
        return own, difference(self._T_map_poses @ T_given, fitted)

    def _leak(self, T_given: Float64) -> float:
        """Fraction of an offset that is no drift by which this frame moves the map."""
        motion = np.zeros(6) if self._T_last is None else difference(self._T_last, T_given)
        self._T_last = T_given
        turn, step = motion[:3], motion[3:]
        path = math.sqrt(turn @ turn) + math.sqrt(step @ step)
        first = FIRST_FRAMES / (self._frames + 1) * _shrunk(self._trembling_m2, FIT_VARIANCE_M2)
        return min(1.0, first + path / LEAK_PATH)


def _squared(step: Float64) -> float:
    return float((step * step).dot(JOINT))


def _shrunk(squared: float, noise_squared: float) -> float:
    """The part of a value that its noise does not explain (James and Stein), 0 to 1."""
    return 1.0 - min(1.0, noise_squared / max(squared, 1e-12))


def moved(local: LocalGraph, T: Float64) -> LocalGraph:
    """A local graph with the camera pose T · T_world_camera instead of T_world_camera."""
    means_world, covariances_world = transform(local.means_world, local.covariances_world, T)
    ends = [*accumulate(map(len, local.surface_points_world))]
    points = np.concatenate([np.zeros((0, 3), np.float32), *local.surface_points_world])
    points = points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
    return derived(
        local,
        T_world_camera=T @ local.T_world_camera,
        means_world=means_world,
        covariances_world=covariances_world,
        surface_points_world=tuple([points[a:b] for a, b in zip([0, *ends], ends)]),
    )
