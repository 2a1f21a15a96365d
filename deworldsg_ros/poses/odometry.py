"""RGB-D odometry: the pose of each frame out of the images alone, for robots without SLAM.

Each frame is aligned to a reference frame by OpenCV's RGB-D odometry (photometric and point-to-
plane residuals on an image pyramid). Where the depth then does not fit, that alignment and the
motion so far are refined on the depth (`depth_alignment`): a camera that turns fast leaves the
pyramid's reach. An OpenCV before 5 has no such odometry: there that refinement is all there is, of
the motion so far and of none. The reference is the frame before, or an older one while the camera
has hardly moved since: a camera that stands still does not drift. Nothing closes loops.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from deworldsg_ros.config import OdometryConfig
from deworldsg_ros.poses.depth_alignment import (
    LEAST_POINTS,
    fit_share,
    points_of,
    refine,
    surface_of,
)
from deworldsg_ros.poses.motion import rotation_angle_deg
from deworldsg_ros.scene.arrays import Float32, Float64, UInt8
from deworldsg_ros.scene.camera import Intrinsics, check_pose, interpolate_pose, invert_pose
from deworldsg_ros.scene.errors import RefusedInput

# Where the first camera is when nobody says: at the origin, looking along x, z up (REP 103).
LEVEL_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
# An alignment of which less than this fits is tried to be refined; it is, by this much more.
GOOD_FIT = 0.97
BETTER_BY = 0.005
# OpenCV has it from version 5 on, which needs numpy 2; beside a sourced ROS 2 Jazzy numpy is 1.
HAS_ODOMETRY = hasattr(cv2, "Odometry")
WITHOUT_ODOMETRY = (
    f"OpenCV {cv2.__version__} has no RGB-D odometry, which comes with version 5: depth alone is "
    "aligned, and drifts more"
)


@dataclass(frozen=True, eq=False)
class _View:
    """A frame prepared for alignment, some of its points, and its pose."""

    frame: Any
    points: Float64
    T_world_camera: Float64


class RgbdOdometry:
    """Tracks a camera from frame to frame.

    Args:
        config: method and limits.
        T_world_start: (4, 4) pose of the first frame; None = level, at the origin, looking along x.

    Attributes:
        tracked: frames that were given a pose.
        lost: frames that were not.
        restarts: times that tracking began anew at the last known pose.
    """

    def __init__(self, config: OdometryConfig, T_world_start: Float64 | None = None) -> None:
        self._config = config
        self._T_world_start = LEVEL_CAMERA if T_world_start is None else T_world_start
        check_pose(self._T_world_start)
        self._intrinsics: Intrinsics | None = None
        self._odometry: Any = None
        self._reference: _View | None = None
        self._newest: _View | None = None
        # Of the newest camera, since the one before it.
        self._motion = np.eye(4)
        self._lost_in_a_row = 0
        self.tracked = self.lost = self.restarts = 0

    def track(self, rgb: UInt8, depth_m: Float32, intrinsics: Intrinsics) -> Float64:
        """T_world_camera (4, 4) of the next frame.

        Args:
            rgb: (H, W, 3) uint8, RGB order.
            depth_m: (H, W) float32, metres; 0 = invalid.
            intrinsics: of both.

        Raises:
            RefusedInput: ``odometry_lost`` where the frame fits none before it. The reference is
                kept for the next one; after `restart_after` such frames the next that has depth
                becomes the reference, with the last known pose.
        """
        if intrinsics != self._intrinsics:
            self._begin(intrinsics)
        depth_m = np.where((depth_m > 0) & (depth_m <= self._config.max_depth_m), depth_m, 0)
        points = points_of(depth_m, intrinsics)
        if len(points) < LEAST_POINTS:
            raise self._lose(f"fewer than {LEAST_POINTS} of its pixels on the grid have depth")
        frame = self._prepare(rgb, depth_m)
        if self._newest is None or self._reference is None:
            return self._accept(_View(frame, points, self._T_world_start), restart=True)
        complaints = []
        for view in dict.fromkeys((self._reference, self._newest)):
            T_camera_view, complaint = self._align(view, frame, depth_m, intrinsics)
            if T_camera_view is not None:
                T_world_camera = _rigid(view.T_world_camera @ invert_pose(T_camera_view))
                return self._accept(_View(frame, points, T_world_camera))
            complaints.append(complaint)
        if self._lost_in_a_row >= self._config.restart_after:
            self.restarts += 1
            return self._accept(_View(frame, points, self._newest.T_world_camera), restart=True)
        raise self._lose(complaints[-1])

    def _begin(self, intrinsics: Intrinsics) -> None:
        """Set up the alignment; with other intrinsics, go on from the last known pose."""
        if self._newest is not None:
            self._T_world_start = self._newest.T_world_camera
            self.restarts += 1
        self._intrinsics = intrinsics
        self._reference = self._newest = None
        if not HAS_ODOMETRY:
            return
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(intrinsics.matrix.astype(np.float32))
        settings.setMaxDepth(self._config.max_depth_m)
        settings.setMaxTranslation(self._config.max_step_m)
        settings.setMaxRotation(self._config.max_rotation_deg)
        kind = (
            cv2.OdometryType_DEPTH if self._config.method == "depth" else cv2.OdometryType_RGB_DEPTH
        )
        self._odometry = cv2.Odometry(kind, settings, cv2.OdometryAlgoType_COMMON)

    def _prepare(self, rgb: UInt8, depth_m: Float32) -> Any:
        if not HAS_ODOMETRY:
            return None
        holes = np.where(depth_m > 0, depth_m, np.float32(np.nan)).astype(np.float32)
        frame = cv2.OdometryFrame(holes, np.ascontiguousarray(rgb[:, :, ::-1]))
        self._odometry.prepareFrame(frame)
        return frame

    def _align(
        self, view: _View, frame: Any, depth_m: Float32, intrinsics: Intrinsics
    ) -> tuple[Float64 | None, str]:
        """T_camera_view, or None and why it is not believed."""
        guesses = self._guesses(view, frame, depth_m, intrinsics)
        best, share = self._best(view.points, depth_m, guesses, intrinsics)
        step_m = float(np.linalg.norm(best[:3, 3]))
        if share < self._config.min_fit:
            return None, f"{share:.0%} of the depth fits (odometry.min_fit)"
        if step_m > self._config.max_step_m:
            return None, f"the camera would have moved {step_m:.2f} m (odometry.max_step_m)"
        if rotation_angle_deg(best[:3, :3]) > self._config.max_rotation_deg:
            return None, "the camera would have turned too far (odometry.max_rotation_deg)"
        return best, ""

    def _guesses(
        self, view: _View, frame: Any, depth_m: Float32, intrinsics: Intrinsics
    ) -> list[Float64]:
        """T_camera_view as it may be, most trusted first."""
        predicted = self._predicted(view)
        if not HAS_ODOMETRY:
            surface = surface_of(depth_m, intrinsics)
            starts = (predicted, np.eye(4))
            return [refine(view.points, surface, start, intrinsics) for start in starts]
        found, T_camera_view = self._odometry.compute(view.frame, frame)
        if found and np.isfinite(T_camera_view).all():
            return [np.asarray(T_camera_view, np.float64), predicted]
        return [predicted]

    def _predicted(self, view: _View) -> Float64:
        """T_camera_view if the camera goes on moving as it did."""
        assert self._newest is not None
        T_world_camera = self._newest.T_world_camera @ self._motion
        return invert_pose(T_world_camera) @ view.T_world_camera

    @staticmethod
    def _best(
        points: Float64,
        depth_m: Float32,
        guesses: list[Float64],
        intrinsics: Intrinsics,
    ) -> tuple[Float64, float]:
        """The first guess, or what a refinement of any of them makes better; and how it fits."""
        best, share = guesses[0], fit_share(points, depth_m, guesses[0], intrinsics)
        if share >= GOOD_FIT:
            return best, share
        surface = surface_of(depth_m, intrinsics)
        for guess in guesses:
            refined = refine(points, surface, guess, intrinsics)
            refined_share = fit_share(points, depth_m, refined, intrinsics)
            if refined_share > share + BETTER_BY:
                best, share = refined, refined_share
        return best, share

    def _accept(self, view: _View, *, restart: bool = False) -> Float64:
        if restart or self._newest is None:
            self._motion = np.eye(4)
        else:
            self._motion = invert_pose(self._newest.T_world_camera) @ view.T_world_camera
        self._newest = view
        if restart or self._reference is None or self._moved(self._reference, view):
            self._reference = view
        self._lost_in_a_row = 0
        self.tracked += 1
        return view.T_world_camera

    def _moved(self, a: _View, b: _View) -> bool:
        T_a_b = invert_pose(a.T_world_camera) @ b.T_world_camera
        return (
            float(np.linalg.norm(T_a_b[:3, 3])) > self._config.keyframe_m
            or rotation_angle_deg(T_a_b[:3, :3]) > self._config.keyframe_deg
        )

    def _lose(self, why: str) -> RefusedInput:
        self.lost += 1
        self._lost_in_a_row += 1
        return RefusedInput(
            "odometry_lost",
            f"odometry lost the camera: {why}; frame {self._lost_in_a_row} in a row, of "
            f"{self._config.restart_after} before it starts anew at the last known pose",
        )


def _rigid(T: Float64) -> Float64:
    """The same transform with a rotation that is exactly one: errors of products add up."""
    return interpolate_pose(T, T, 0.0)
