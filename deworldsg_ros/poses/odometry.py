"""RGB-D odometry: camera poses from the images alone, for robots without SLAM."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt8
from deworldsg_ros.scene.camera import (
    Intrinsics,
    RgbdFrame,
    check_pose,
    interpolate_pose,
    invert_pose,
    point_to_plane,
    rigid_motion,
    rotation_angle_deg,
)
from deworldsg_ros.scene.errors import RefusedInput

# --- Fit of two depth images, and point-to-plane refinement of the motion between them.
#
# The refinement is projective ICP on a coarse grid. It needs an initial guess and takes a few
# milliseconds. For fast rotations it reaches further than the image pyramid of the odometry.

# Points are compared on every N-th pixel; normals are computed on a finer grid.
POINT_STEP_PX = 8
NORMAL_STEP_PX = 4
# A point fits if its depth differs from the measured depth by less than FIT_M and FIT_FRACTION of
# the depth.
FIT_M = 0.03
FIT_FRACTION = 0.02
# With fewer points, nothing is aligned.
MIN_POINTS = 50
# Maximum distance of corresponding points, iteration by iteration: coarse first, then fine.
REACHES_M = (0.3, 0.3, 0.3, 0.3, 0.2, 0.2, 0.1, 0.1, 0.05, 0.05)
# Residuals beyond this fraction of the reach have small weights (Cauchy).
OUTLIER_FRACTION = 0.3
# On a plane, inverse depth is linear. If it bends by more than this fraction, the pixels do not
# belong to one surface.
MAX_BEND_FRACTION = 0.04
# Damping of the normal equations, times the sum of the weights: directions that the geometry does
# not constrain do not move.
DAMPING = 1e-4


class Surface(NamedTuple):
    """Surface of a depth image on the normals' grid, camera frame.

    Attributes:
        points: (h, w, 3) float64, metres; NaN = no depth.
        normals: (h, w, 3) float64, unit; NaN = unknown.
    """

    points: Float64
    normals: Float64


def points_of(depth_m: Float32, intrinsics: Intrinsics, step_px: int = POINT_STEP_PX) -> Float64:
    """Points (n, 3) float64 of the valid pixels on a grid, camera frame, metres."""
    rows, columns = np.nonzero(depth_m[::step_px, ::step_px])
    z = depth_m[::step_px, ::step_px][rows, columns].astype(np.float64)
    return intrinsics.back_project(columns * step_px, rows * step_px, z)


def fit_fraction(
    points_a: Float64, depth_b_m: Float32, T_b_a: Float64, intrinsics: Intrinsics
) -> float:
    """Fraction of the points (n, 3) of camera a, visible in camera b, that fit depth image b.

    0 if too few points can be compared.
    """
    moved = points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    row, column, inside = _pixels_of(moved, intrinsics)
    measured_m = depth_b_m[row[inside], column[inside]].astype(np.float64)
    gap_m = np.abs(measured_m - moved[inside, 2])[measured_m > 0]
    if len(gap_m) < max(MIN_POINTS, len(points_a) // 8):
        return 0.0
    return float(np.mean(gap_m < FIT_M + FIT_FRACTION * measured_m[measured_m > 0]))


def surface_of(depth_m: Float32, intrinsics: Intrinsics) -> Surface:
    """Points and normals of a depth image (H, W), metres, 0 = invalid."""
    step = NORMAL_STEP_PX
    z = depth_m[::step, ::step].astype(np.float64)
    z[z <= 0] = np.nan
    rows, columns = np.mgrid[: z.shape[0], : z.shape[1]]
    points = intrinsics.back_project(columns * step, rows * step, z)
    normals = np.full(points.shape, np.nan)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normal = np.cross(across, down)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    inverse = 1.0 / z
    middle = inverse[1:-1, 1:-1]
    bend = np.maximum(
        np.abs(inverse[1:-1, 2:] + inverse[1:-1, :-2] - 2 * middle),
        np.abs(inverse[2:, 1:-1] + inverse[:-2, 1:-1] - 2 * middle),
    )
    is_edge = bend > MAX_BEND_FRACTION * middle
    with np.errstate(invalid="ignore", divide="ignore"):
        normals[1:-1, 1:-1] = np.where(is_edge[..., None], np.nan, normal / length)
    return Surface(points, normals)


def refine(
    points_a: Float64, surface_b: Surface, T_b_a: Float64, intrinsics: Intrinsics
) -> Float64:
    """T_b_a (4, 4) that moves the points of camera a onto the surface of camera b.

    Directions that the geometry leaves open, such as along a bare wall, keep the initial guess.

    Args:
        points_a: (n, 3) metres, camera a.
        surface_b: of camera b.
        T_b_a: (4, 4) initial guess.
        intrinsics: of camera b.
    """
    height, width = surface_b.points.shape[:2]
    for reach_m in REACHES_M:
        moved = points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]
        row, column, inside = _pixels_of(moved, intrinsics)
        moved = moved[inside]
        row, column = (
            np.minimum((row[inside] + NORMAL_STEP_PX // 2) // NORMAL_STEP_PX, height - 1),
            np.minimum((column[inside] + NORMAL_STEP_PX // 2) // NORMAL_STEP_PX, width - 1),
        )
        gaps, normals = surface_b.points[row, column] - moved, surface_b.normals[row, column]
        distances = np.einsum("ij,ij->i", gaps, normals)
        # Comparisons with NaN are false: points without a normal are ignored.
        near = np.abs(distances) < reach_m
        near &= np.linalg.norm(gaps, axis=1) < 2 * reach_m
        if np.count_nonzero(near) < MIN_POINTS:
            return T_b_a
        distances = distances[near]
        jacobian, weights = point_to_plane(
            moved[near], normals[near], distances, OUTLIER_FRACTION * reach_m
        )
        weighted = jacobian * weights[:, None]
        hessian = jacobian.T @ weighted + DAMPING * weights.sum() * np.eye(6)
        step = np.linalg.solve(hessian, weighted.T @ distances)
        T_b_a = rigid_motion(step[3:], step[:3]) @ T_b_a
    return T_b_a


def _pixels_of(points: Float64, intrinsics: Intrinsics) -> tuple[Int64, Int64, Bool]:
    """Row and column of the pixel of each point (n, 3), and whether it is in the image."""
    z = np.where(points[:, 2] > 1e-3, points[:, 2], np.inf)
    uv = intrinsics.project(np.column_stack((points[:, :2], z)))
    column, row = np.rint(uv).astype(np.int64).T
    inside = (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
    return row, column, inside & np.isfinite(z)


# --- RGB-D odometry: camera poses from the images alone, for robots without SLAM.
#
# 1. OpenCV's RGB-D odometry aligns each frame with a reference frame. It minimises photometric and
#    point-to-plane residuals on an image pyramid.
# 2. If the depth does not fit afterwards, `depth_alignment` refines that alignment and a constant-
#    motion prediction. A fast rotation exceeds the reach of the pyramid.
# 3. The reference is the last frame, or an older one while the camera has hardly moved.
#
# OpenCV before version 5 has no RGB-D odometry. Then `depth_alignment` alone refines the constant-
# motion prediction and the identity. There is no loop closure.

# Pose of the first camera unless one is given: at the origin, looking along x, z up (REP 103).
LEVEL_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
# Name of the world frame if `inputs.world_frame` is empty; the usual name of an odometry frame
# (REP 105).
ODOMETRY_FRAME = "odom"
# With the following limits no frame of the recordings in docs/dev/poses.md is lost.
# Depth beyond this is not aligned: the noise of depth cameras grows with the square of the depth.
MAX_DEPTH_M = 4.0
# A frame is lost if the camera would have moved by more than this since the reference: 9 m/s at
# 30 frames/s.
MAX_STEP_M = 0.3
MAX_ROTATION_DEG = 30.0
# A frame is lost if a smaller fraction of the depth fits.
MIN_FIT = 0.6
# The reference frame is kept while the camera has moved by less than this: a camera that stands
# still does not drift.
KEYFRAME_M = 0.02
KEYFRAME_DEG = 1.0
# After this many lost frames in a row, half a second at 30 frames/s, tracking restarts at the last
# known pose.
RESTART_AFTER = 15
# An alignment is refined if a smaller fraction of the depth fits, and the refinement is kept if
# the fraction grows by at least MIN_GAIN.
GOOD_FIT = 0.97
MIN_GAIN = 0.005
# OpenCV has RGB-D odometry from version 5 on. Version 5 needs numpy 2; a sourced ROS 2 Jazzy has
# numpy 1.
HAS_ODOMETRY = hasattr(cv2, "Odometry")
WITHOUT_ODOMETRY = (
    f"OpenCV {cv2.__version__} has no RGB-D odometry (version 5 has): only depth is aligned, and "
    "the poses drift more"
)


@dataclass(frozen=True, eq=False)
class _TrackedFrame:
    """A frame prepared for alignment, some of its points, and its pose."""

    frame: Any
    points: Float64
    T_world_camera: Float64


class RgbdOdometry:
    """Tracks a camera from frame to frame.

    Args:
        T_world_start: (4, 4) pose of the first frame; None = level, at the origin, looking along x.
        restart_after: lost frames in a row after which tracking restarts at the last known pose.
        depth_only: align depth only, without OpenCV's RGB-D odometry.

    Attributes:
        tracked: number of frames with a pose.
        lost: number of frames without a pose.
        restarts: number of restarts at the last known pose.

    Raises:
        RefusedInput: ``invalid_pose`` if `T_world_start` is no rigid transform.
    """

    def __init__(
        self,
        T_world_start: Float64 | None = None,
        *,
        restart_after: int = RESTART_AFTER,
        depth_only: bool = not HAS_ODOMETRY,
    ) -> None:
        self._T_world_start = LEVEL_CAMERA if T_world_start is None else T_world_start
        check_pose(self._T_world_start)
        self._restart_after = restart_after
        self._depth_only = depth_only
        self._intrinsics: Intrinsics | None = None
        self._odometry: Any = None
        self._reference: _TrackedFrame | None = None
        self._newest: _TrackedFrame | None = None
        # Motion of the camera between the two newest frames.
        self._motion = np.eye(4)
        self._lost_in_a_row = 0
        self.tracked = self.lost = self.restarts = 0

    def track(self, rgb: UInt8, depth_m: Float32, intrinsics: Intrinsics) -> Float64:
        """T_world_camera (4, 4) of the next frame.

        Args:
            rgb: (H, W, 3) uint8, RGB order.
            depth_m: (H, W) float32, metres; 0 = invalid.
            intrinsics: of both images.

        Raises:
            RefusedInput: ``odometry_lost`` if the frame fits no earlier one. The reference frame
                stays the same. After `restart_after` lost frames in a row, the next frame with
                depth becomes the reference, at the last known pose.
        """
        if intrinsics != self._intrinsics:
            self._begin(intrinsics)
        depth_m = np.where((depth_m > 0) & (depth_m <= MAX_DEPTH_M), depth_m, 0)
        points = points_of(depth_m, intrinsics)
        if len(points) < MIN_POINTS:
            raise self._lose(f"fewer than {MIN_POINTS} pixels of its grid have depth")
        frame = self._prepare(rgb, depth_m)
        if self._newest is None or self._reference is None:
            return self._accept(_TrackedFrame(frame, points, self._T_world_start), restart=True)
        reasons = []
        for earlier in dict.fromkeys((self._reference, self._newest)):
            T_camera_earlier, reason = self._align(earlier, frame, depth_m, intrinsics)
            if T_camera_earlier is not None:
                T_world_camera = _rigid(earlier.T_world_camera @ invert_pose(T_camera_earlier))
                return self._accept(_TrackedFrame(frame, points, T_world_camera))
            reasons.append(reason)
        if self._lost_in_a_row >= self._restart_after:
            self.restarts += 1
            last_pose = self._newest.T_world_camera
            return self._accept(_TrackedFrame(frame, points, last_pose), restart=True)
        raise self._lose(reasons[-1])

    def _begin(self, intrinsics: Intrinsics) -> None:
        """Set up the alignment; with new intrinsics, continue from the last known pose."""
        if self._newest is not None:
            self._T_world_start = self._newest.T_world_camera
            self.restarts += 1
        self._intrinsics = intrinsics
        self._reference = self._newest = None
        if self._depth_only:
            return
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(intrinsics.matrix.astype(np.float32))
        settings.setMaxDepth(MAX_DEPTH_M)
        settings.setMaxTranslation(MAX_STEP_M)
        settings.setMaxRotation(MAX_ROTATION_DEG)
        self._odometry = cv2.Odometry(
            cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON
        )

    def _prepare(self, rgb: UInt8, depth_m: Float32) -> Any:
        if self._depth_only:
            return None
        with_nan = np.where(depth_m > 0, depth_m, np.float32(np.nan)).astype(np.float32)
        frame = cv2.OdometryFrame(with_nan, np.ascontiguousarray(rgb[:, :, ::-1]))
        self._odometry.prepareFrame(frame)
        return frame

    def _align(
        self,
        earlier: _TrackedFrame,
        frame: Any,
        depth_m: Float32,
        intrinsics: Intrinsics,
    ) -> tuple[Float64 | None, str]:
        """T_camera_earlier; or None and the reason for rejecting it."""
        guesses = self._guesses(earlier, frame, depth_m, intrinsics)
        best, fit = _refined(earlier.points, depth_m, guesses, intrinsics)
        step_m = float(np.linalg.norm(best[:3, 3]))
        if fit < MIN_FIT:
            return None, f"{fit:.0%} of the depth fits, expected at least {MIN_FIT:.0%}"
        if step_m > MAX_STEP_M:
            return None, f"the camera would have moved {step_m:.2f} m, expected <= {MAX_STEP_M} m"
        rotation_deg = rotation_angle_deg(best[:3, :3])
        if rotation_deg > MAX_ROTATION_DEG:
            return None, (
                f"the camera would have rotated {rotation_deg:.0f} degrees, expected <= "
                f"{MAX_ROTATION_DEG:.0f}"
            )
        return best, ""

    def _guesses(
        self,
        earlier: _TrackedFrame,
        frame: Any,
        depth_m: Float32,
        intrinsics: Intrinsics,
    ) -> list[Float64]:
        """Candidates for T_camera_earlier, the most trusted first."""
        predicted = self._predicted(earlier)
        if self._depth_only:
            surface = surface_of(depth_m, intrinsics)
            starts = (predicted, np.eye(4))
            return [refine(earlier.points, surface, start, intrinsics) for start in starts]
        found, T_camera_earlier = self._odometry.compute(earlier.frame, frame)
        if found and np.isfinite(T_camera_earlier).all():
            return [np.asarray(T_camera_earlier, np.float64), predicted]
        return [predicted]

    def _predicted(self, earlier: _TrackedFrame) -> Float64:
        """T_camera_earlier if the camera continues its last motion."""
        assert self._newest is not None
        T_world_camera = self._newest.T_world_camera @ self._motion
        return invert_pose(T_world_camera) @ earlier.T_world_camera

    def _accept(self, tracked: _TrackedFrame, *, restart: bool = False) -> Float64:
        if restart or self._newest is None:
            self._motion = np.eye(4)
        else:
            self._motion = invert_pose(self._newest.T_world_camera) @ tracked.T_world_camera
        self._newest = tracked
        if restart or self._reference is None or _moved(self._reference, tracked):
            self._reference = tracked
        self._lost_in_a_row = 0
        self.tracked += 1
        return tracked.T_world_camera

    def _lose(self, why: str) -> RefusedInput:
        self.lost += 1
        self._lost_in_a_row += 1
        return RefusedInput(
            "odometry_lost",
            f"odometry lost the camera: {why}; lost frame {self._lost_in_a_row} in a row, tracking "
            f"restarts at the last known pose after {self._restart_after}",
        )


def _refined(
    points: Float64, depth_m: Float32, guesses: list[Float64], intrinsics: Intrinsics
) -> tuple[Float64, float]:
    """The first guess, or a better refinement of any guess; and its fit, a fraction."""
    best, best_fit = guesses[0], fit_fraction(points, depth_m, guesses[0], intrinsics)
    if best_fit >= GOOD_FIT:
        return best, best_fit
    surface = surface_of(depth_m, intrinsics)
    for guess in guesses:
        refined = refine(points, surface, guess, intrinsics)
        fit = fit_fraction(points, depth_m, refined, intrinsics)
        if fit > best_fit + MIN_GAIN:
            best, best_fit = refined, fit
    return best, best_fit


def _moved(a: _TrackedFrame, b: _TrackedFrame) -> bool:
    """Whether the camera has moved enough for a new reference frame."""
    T_a_b = invert_pose(a.T_world_camera) @ b.T_world_camera
    return (
        float(np.linalg.norm(T_a_b[:3, 3])) > KEYFRAME_M
        or rotation_angle_deg(T_a_b[:3, :3]) > KEYFRAME_DEG
    )


def _rigid(T: Float64) -> Float64:
    """The same transform with an exact rotation: rounding errors of products accumulate."""
    return interpolate_pose(T, T, 0.0)


# --- Streams of frames whose poses come from odometry.

OnRefusal = Callable[[RefusedInput], None]


def track_poses(
    frames: Iterable[RgbdFrame],
    T_world_start: Float64 | None = None,
    on_lost: OnRefusal | None = None,
) -> Iterator[RgbdFrame]:
    """Replace the poses of frames by those of RGB-D odometry; lost frames are left out.

    Args:
        frames: their own poses are ignored.
        T_world_start: (4, 4) pose of the first frame; None = level, at the origin.
        on_lost: called with the refusal of each lost frame.
    """
    odometry = RgbdOdometry(T_world_start)
    for frame in frames:
        try:
            T_world_camera = odometry.track(frame.rgb, frame.depth_m, frame.intrinsics)
        except RefusedInput as refusal:
            if on_lost is not None:
                on_lost(refusal)
            continue
        yield replace(frame, T_world_camera=T_world_camera)
