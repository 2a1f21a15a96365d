"""RGB-D odometry: camera poses from the images alone, for robots without SLAM."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt8
from deworldsg_ros.scene.camera import (
    Intrinsics,
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
# 1. ORB features of the images that have depth are matched with those of a reference frame
#    [E. Rublee et al., "ORB", ICCV 2011]. RANSAC finds the rigid motion that most of them agree on
#    [M. Fischler and R. Bolles, 1981].
# 2. If the depth does not fit afterwards, or nothing was matched, point-to-plane ICP refines that
#    motion and a constant-motion prediction.
# 3. The reference is the last frame, or an older one while the camera has hardly moved.

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
# Features of an image, samples of three matches, and matches that have to agree on a motion.
FEATURES, SAMPLES, MIN_AGREE = 600, 200, 25
# They are found in an image of this width: larger ones take longer, small ones have few.
FEATURE_COLUMNS = 640
# Matched points agree if they are this far apart after the motion: noise of depth, at its square.
AGREE_M, AGREE_PER_M = 0.015, 0.005


class Features(NamedTuple):
    """ORB features of an image, with depth.

    Attributes:
        points: (n, 3) camera frame, metres.
        descriptors: (n, 32) uint8.
    """

    points: Float64
    descriptors: UInt8


NO_FEATURES = Features(np.zeros((0, 3)), np.zeros((0, 32), np.uint8))


def features_of(rgb: UInt8, depth_m: Float32, intrinsics: Intrinsics) -> Features:
    """The features of an image (H, W, 3) whose pixels have depth (H, W)."""
    grey, scale = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), FEATURE_COLUMNS / rgb.shape[1]
    if scale != 1.0:
        method = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=method)
    found, descriptors = cv2.ORB.create(FEATURES, fastThreshold=7).detectAndCompute(grey, None)
    if not found:
        return NO_FEATURES
    columns, rows = ((np.array([point.pt for point in found]) + 0.5) / scale - 0.5).T
    last_row, last_column = np.subtract(depth_m.shape, 1)
    at = (
        np.clip(np.rint(rows).astype(int), 0, last_row),
        np.clip(np.rint(columns).astype(int), 0, last_column),
    )
    z = depth_m[at].astype(np.float64)
    points = intrinsics.back_project(columns, rows, z)
    return Features(points[z > 0], descriptors[z > 0])


def motion_of(a: Features, b: Features) -> tuple[Float64, int]:
    """T_b_a (4, 4) that most matches agree on, and their number; the identity and 0 if too few."""
    if min(len(a.points), len(b.points)) < MIN_AGREE:
        return np.eye(4), 0
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    pairs = matcher.match(a.descriptors, b.descriptors)
    if len(pairs) < MIN_AGREE:
        return np.eye(4), 0
    x = a.points[[pair.queryIdx for pair in pairs]]
    y = b.points[[pair.trainIdx for pair in pairs]]
    near = AGREE_M + AGREE_PER_M * y[:, 2] ** 2
    chosen = np.random.default_rng(0).integers(0, len(x), (SAMPLES, 3))
    T = _rigid_motions(x[chosen], y[chosen])
    for _ in range(3):  # the best sample, then what agrees with it
        moved = x @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3]
        agree = np.linalg.norm(moved - y, axis=2) < near
        best = agree[agree.sum(axis=1).argmax()]
        if best.sum() < MIN_AGREE:
            return np.eye(4), 0
        T = _rigid_motions(x[best][None], y[best][None])
    return T[0], int(best.sum())


def _rigid_motions(x: Float64, y: Float64) -> Float64:
    """The rigid motions (k, 4, 4) that take points x (k, n, 3) nearest to y (Kabsch 1976)."""
    mean_x, mean_y = x.mean(axis=1, keepdims=True), y.mean(axis=1, keepdims=True)
    u, _, v = np.linalg.svd((x - mean_x).swapaxes(1, 2) @ (y - mean_y))
    sign = np.sign(np.linalg.det(u @ v))
    u[:, :, 2] *= sign[:, None]
    T = np.broadcast_to(np.eye(4), (len(x), 4, 4)).copy()
    T[:, :3, :3] = (u @ v).swapaxes(1, 2)
    T[:, :3, 3] = mean_y[:, 0] - (T[:, :3, :3] @ mean_x.swapaxes(1, 2))[:, :, 0]
    return T


@dataclass(frozen=True, eq=False)
class _TrackedFrame:
    """A frame prepared for alignment, some of its points, and its pose."""

    features: Features
    points: Float64
    T_world_camera: Float64


class RgbdOdometry:
    """Tracks a camera from frame to frame.

    Args:
        T_world_start: (4, 4) pose of the first frame; None = level, at the origin, looking along x.
        restart_after: lost frames in a row after which tracking restarts at the last known pose.

    Attributes:
        tracked: number of frames with a pose.
        lost: number of frames without a pose.
        restarts: number of restarts at the last known pose.
        features: of the newest frame with depth, tracked or lost.

    Raises:
        RefusedInput: ``invalid_pose`` if `T_world_start` is no rigid transform.
    """

    def __init__(
        self,
        T_world_start: Float64 | None = None,
        *,
        restart_after: int = RESTART_AFTER,
    ) -> None:
        self._T_world_start = LEVEL_CAMERA if T_world_start is None else T_world_start
        check_pose(self._T_world_start)
        self._restart_after = restart_after
        self._intrinsics: Intrinsics | None = None
        self._reference: _TrackedFrame | None = None
        self._newest: _TrackedFrame | None = None
        # Motion of the camera between the two newest frames.
        self._motion = np.eye(4)
        self._lost_in_a_row = 0
        self.tracked = self.lost = self.restarts = 0
        self.features, self._points = NO_FEATURES, np.zeros((0, 3))

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
        features = self.features = features_of(rgb, depth_m, intrinsics)
        self._points = points
        if self._newest is None or self._reference is None:
            return self._accept(_TrackedFrame(features, points, self._T_world_start), restart=True)
        reasons = []
        for earlier in dict.fromkeys((self._reference, self._newest)):
            T_camera_earlier, reason = self._align(earlier, features, depth_m, intrinsics)
            if T_camera_earlier is not None:
                T_world_camera = rigid(earlier.T_world_camera @ invert_pose(T_camera_earlier))
                return self._accept(_TrackedFrame(features, points, T_world_camera))
            reasons.append(reason)
        if self._lost_in_a_row >= self._restart_after:
            self.restarts += 1
            last_pose = self._newest.T_world_camera
            return self._accept(_TrackedFrame(features, points, last_pose), restart=True)
        raise self._lose(reasons[-1])

    def resume(self, T_world_camera: Float64) -> None:
        """Go on from the newest frame, which was lost, at a pose (4, 4) that is known otherwise."""
        self.lost -= 1
        self._accept(_TrackedFrame(self.features, self._points, T_world_camera), restart=True)

    def _begin(self, intrinsics: Intrinsics) -> None:
        """Set up the alignment; with new intrinsics, continue from the last known pose."""
        if self._newest is not None:
            self._T_world_start = self._newest.T_world_camera
            self.restarts += 1
        self._intrinsics = intrinsics
        self._reference = self._newest = None

    def _align(
        self,
        earlier: _TrackedFrame,
        features: Features,
        depth_m: Float32,
        intrinsics: Intrinsics,
    ) -> tuple[Float64 | None, str]:
        """T_camera_earlier; or None and the reason for rejecting it."""
        T_matched, agree = motion_of(earlier.features, features)
        predicted = self._predicted(earlier)
        guesses = [T_matched, predicted]
        if not agree:
            surface = surface_of(depth_m, intrinsics)
            starts = (predicted, np.eye(4))
            guesses = [refine(earlier.points, surface, start, intrinsics) for start in starts]
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


def rigid(T: Float64) -> Float64:
    """The same transform with an exact rotation: rounding errors of products accumulate."""
    return interpolate_pose(T, T, 0.0)
