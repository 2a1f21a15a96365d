"""Pinhole intrinsics, rigid motions and poses, posed RGB-D frames, and what is up."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt8
from deworldsg_ros.scene.checks import holds, within
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.scene.limits import (
    MAX_COORDINATE_M,
    MAX_FOCAL_PX,
    MAX_SIDE_PX,
    MAX_TRANSFORM_M,
    MIN_FOCAL_PX,
)

# --- Small rigid motions, and the linear system of point-to-plane registration.


def rigid_motion(translation_m: Float64, rotation_vector: Float64) -> Float64:
    """Rigid transform (4, 4) of a translation and a rotation vector, radians (Rodrigues)."""
    T = np.eye(4)
    T[:3, 3] = translation_m
    angle = float(np.linalg.norm(rotation_vector))
    if angle > 0:
        x, y, z = rotation_vector / angle
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        T[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return T


def rotation_angle_deg(rotation: Float64) -> float:
    """Angle of a rotation matrix (3, 3), degrees."""
    return math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(rotation)) - 1) / 2))))


def point_to_plane(
    points: Float64, normals: Float64, distances: Float64, outlier_m: float
) -> tuple[Float64, Float64]:
    """Linear system of one Gauss-Newton step that moves points onto planes.

    The step (ω, t), a rotation vector about the origin and a translation, minimises
    Σ w (d - (x × n) · ω - n · t)².

    Args:
        points: (k, 3) x, metres.
        normals: (k, 3) n, unit normals of the planes.
        distances: (k,) d, signed distances from the points to the planes, metres.
        outlier_m: larger distances have small weights w (Cauchy).

    Returns:
        Jacobian (k, 6) with rows (x × n, n), and weights (k,) in (0, 1].
    """
    jacobian = np.concatenate((np.cross(points, normals), normals), axis=1)
    weights = 1.0 / (1.0 + (distances / outlier_m) ** 2)
    return jacobian, weights


# --- Pinhole intrinsics, rigid poses and posed RGB-D frames.
#
# Poses are 4x4 float64 matrices named `T_target_source`: they take points of the source frame into
# the target frame. The camera frame is the optical one: x right, y down, z forward. Pixel centres
# are at integers.

# Maximum difference of R Rᵀ from the identity: poses are often written with four decimals.
_ROTATION_TOLERANCE = 1e-3
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics of a rectified image, in pixels.

    Raises:
        RefusedInput: ``invalid_intrinsics`` for focal lengths or sizes <= 0, and for values that
            are not finite or beyond the limits of `scene.limits`.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        in_range = all(abs(value) <= MAX_FOCAL_PX for value in values)
        if not in_range or min(self.fx, self.fy) < MIN_FOCAL_PX:
            raise RefusedInput(
                "invalid_intrinsics",
                f"intrinsics fx={self.fx} fy={self.fy} cx={self.cx} cy={self.cy}: expected values "
                f"up to {MAX_FOCAL_PX:g}, fx and fy from {MIN_FOCAL_PX:g} on (is the camera "
                "calibrated?)",
            )
        if not (0 < self.width <= MAX_SIDE_PX and 0 < self.height <= MAX_SIDE_PX):
            raise RefusedInput(
                "invalid_intrinsics",
                f"image size {self.width}x{self.height}: expected 1 to {MAX_SIDE_PX}",
            )

    @property
    def matrix(self) -> Float64:
        """K, (3, 3) float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def back_project(self, columns: NDArray[Any], rows: NDArray[Any], depths_m: Float64) -> Float64:
        """Points of pixels in the camera frame, z K⁻¹ [u v 1]ᵀ (Eq. 3).

        Args:
            columns: (...) pixel coordinate u.
            rows: (...) pixel coordinate v.
            depths_m: (...) float64, metres along the optical axis.

        Returns:
            (..., 3) float64, metres.
        """
        x = (columns - self.cx) / self.fx * depths_m
        y = (rows - self.cy) / self.fy * depths_m
        return np.stack([x, y, depths_m], axis=-1)

    def project(self, points_camera: Float64) -> Float64:
        """Pixels u, v (..., 2) of points (..., 3) in the camera frame, with z > 0."""
        x, y, z = (points_camera[..., axis] for axis in range(3))
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)


@dataclass(frozen=True)
class MaskPatch:
    """Mask of one object, stored as the part of the image around it.

    Attributes:
        top, left: image row and column of the patch's first pixel.
        pixels: (h, w) bool; h or w is 0 if the object has no pixel.
    """

    top: int
    left: int
    pixels: Bool

    @property
    def window(self) -> tuple[slice, slice]:
        """The slices of the image that the patch covers."""
        height, width = self.pixels.shape
        return slice(self.top, self.top + height), slice(self.left, self.left + width)


@dataclass(frozen=True)
class SentDetections:
    """Objects that another process has found in an image (n objects), checked.

    Attributes:
        boxes_xyxy: (n, 4) float64 pixels, corners x1, y1, x2, y2.
        scores: (n,) float64 in [0, 1].
        names: what each object may be: at least one name, with
        name_scores: the score of each name in [0, 1].
        masks: a mask of each object, inside the image; None = the source has none.
        embeddings: (n, D) float32; None = the source has none.
        embedding_model: name of the model that made them.
    """

    boxes_xyxy: Float64
    scores: Float64
    names: tuple[tuple[str, ...], ...]
    name_scores: tuple[tuple[float, ...], ...]
    masks: tuple[MaskPatch, ...] | None = None
    embeddings: Float32 | None = None
    embedding_model: str = ""

    def __len__(self) -> int:
        return len(self.scores)


class Trajectory(NamedTuple):
    """Corrected poses of earlier frames, as a closed loop gives them.

    Attributes:
        stamps_ns: (k,) ascending.
        T_world_camera: (k, 4, 4) corrected poses.
        T_new_old: (k, 4, 4) how each one was corrected, world frame.
    """

    stamps_ns: Int64
    T_world_camera: Float64
    T_new_old: Float64

    @property
    def moved_m(self) -> float:
        """How far the newest pose was moved."""
        new, T = self.T_world_camera[-1], self.T_new_old[-1]
        return float(np.linalg.norm((new - invert_pose(T) @ new)[:3, 3]))

    def at(self, stamps_ns: Int64) -> Float64:
        """How poses (n, 4, 4) at n stamps were corrected, between the keyframes evenly."""
        return interpolate_poses(self.stamps_ns, self.T_new_old, stamps_ns)


@dataclass(frozen=True)
class RgbdFrame:
    """One registered RGB-D image with its pose, checked.

    Attributes:
        stamp_ns: time of the RGB image, nanoseconds.
        rgb: (H, W, 3) uint8, RGB order.
        depth_m: (H, W) float32, metres along the optical axis; 0 = invalid.
        intrinsics: of both images.
        T_world_camera: (4, 4) float64, camera optical frame to world.
        frame_id: name of the world frame.
        sent: objects that another process has found in the image; None = none was asked.
        trajectory: of the frames before, if it was corrected with this frame; the poses from this
            frame on are corrected.

    Raises:
        RefusedInput: ``grid_mismatch`` if the sizes differ, ``invalid_pose`` for a bad pose.
    """

    stamp_ns: int
    rgb: UInt8
    depth_m: Float32
    intrinsics: Intrinsics
    T_world_camera: Float64
    frame_id: str = "world"
    sent: SentDetections | None = None
    trajectory: Trajectory | None = None

    def __post_init__(self) -> None:
        grid = (self.intrinsics.height, self.intrinsics.width)
        if self.rgb.shape != (*grid, 3) or self.depth_m.shape != grid:
            raise RefusedInput(
                "grid_mismatch",
                f"RGB is {_size(self.rgb)}, depth {_size(self.depth_m)}, camera_info "
                f"{grid[1]}x{grid[0]}: expected one size (is depth registered to RGB?)",
            )
        check_pose(self.T_world_camera)


def _size(image: NDArray[Any]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}" if image.ndim >= 2 else f"of shape {image.shape}"


def check_pose(T: Float64) -> None:
    """Check a rigid transform (4, 4); raises RefusedInput ``invalid_pose``."""
    if T.shape != (4, 4) or not np.abs(T).max() <= MAX_COORDINATE_M:
        raise RefusedInput(
            "invalid_pose",
            f"pose {T.tolist()}: expected a finite 4x4 matrix, at most {MAX_COORDINATE_M:g} m from "
            "the origin",
        )
    if np.abs(T[3] - _LAST_ROW).max() > 1e-6:
        raise RefusedInput(
            "invalid_pose", f"last row of the pose is {T[3].tolist()}: expected 0, 0, 0, 1"
        )
    (a, b, c, _), (d, e, f, _), (g, h, i, _) = T[:3].tolist()
    error = max(
        abs(a * a + b * b + c * c - 1.0),
        abs(d * d + e * e + f * f - 1.0),
        abs(g * g + h * h + i * i - 1.0),
        abs(a * d + b * e + c * f),
        abs(a * g + b * h + c * i),
        abs(d * g + e * h + f * i),
    )
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if error > _ROTATION_TOLERANCE or determinant < 0:
        raise RefusedInput(
            "invalid_pose",
            f"pose rotation is off orthonormal by {error:.2g} (determinant "
            f"{determinant:.3f}): expected a right-handed rotation",
        )


def pose_from_quaternion(translation_m: Float64, quat_xyzw: Float64) -> Float64:
    """Rigid transform from a translation (3,) in metres and a quaternion (4,) x, y, z, w.

    Raises:
        RefusedInput: ``invalid_pose`` for NaN, infinity, an absurd translation, or a quaternion
            whose norm is not about 1.
    """
    quat = np.asarray(quat_xyzw, dtype=np.float64)
    translation = np.asarray(translation_m, dtype=np.float64)
    if not (np.abs(quat).max() <= 2.0 and np.abs(translation).max() <= MAX_TRANSFORM_M):
        raise RefusedInput(
            "invalid_pose",
            f"pose position {translation.tolist()}, orientation {quat.tolist()}: expected finite "
            f"values, at most {MAX_TRANSFORM_M:g} m and a quaternion of norm 1",
        )
    norm = float(np.linalg.norm(quat))
    if abs(norm - 1.0) > 1e-2:
        raise RefusedInput(
            "invalid_pose", f"orientation {quat.tolist()} has norm {norm:.4f}: expected 1"
        )
    x, y, z, w = quat / norm
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = translation
    return T


def quaternion_from_rotation(rotation: Float64) -> Float64:
    """Unit quaternion (4,) x, y, z, w with w >= 0 of a rotation matrix (3, 3)."""
    # The eigenvector form of Bar-Itzhack has no special cases.
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    quat = np.linalg.eigh(k / 3.0)[1][:, -1]
    return np.asarray(-quat if quat[3] < 0 else quat)


def invert_pose(T: Float64) -> Float64:
    """Inverse of a rigid transform (4, 4)."""
    inverse = np.zeros((4, 4))
    inverse[3, 3] = 1.0
    inverse[:3, :3] = turn = T[:3, :3].T
    inverse[:3, 3] = -turn @ T[:3, 3]
    return inverse


def interpolate_pose(T_a: Float64, T_b: Float64, fraction: float) -> Float64:
    """Pose between two poses: linear in translation, spherical in rotation; 0 gives T_a."""
    quat_a = quaternion_from_rotation(T_a[:3, :3])
    quat_b = quaternion_from_rotation(T_b[:3, :3])
    dot = float(quat_a @ quat_b)
    if dot < 0:
        quat_b, dot = -quat_b, -dot
    angle = math.acos(min(dot, 1.0))
    if angle < 1e-6:
        quat = (1 - fraction) * quat_a + fraction * quat_b
    else:
        quat = math.sin((1 - fraction) * angle) * quat_a + math.sin(fraction * angle) * quat_b
    translation = (1 - fraction) * T_a[:3, 3] + fraction * T_b[:3, 3]
    return pose_from_quaternion(translation, quat / np.linalg.norm(quat))


def interpolate_poses(stamps_ns: Int64, T: Float64, at_ns: Int64) -> Float64:
    """Rigid transforms (n, 4, 4) at n stamps, between those (m, 4, 4) at m ascending ones.

    Linear in translation and rotation matrix, which is then made a rotation: for small turns
    between the two, as `interpolate_pose`. Beyond the ends, the first and the last.
    """
    after = np.clip(stamps_ns.searchsorted(at_ns), 1, max(len(stamps_ns) - 1, 1))
    after = np.minimum(after, len(stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    length = np.maximum(stamps_ns[after] - stamps_ns[before], 1)
    part = np.clip((at_ns - stamps_ns[before]) / length, 0.0, 1.0)[:, None, None]
    found = np.where(part == 1.0, T[after], T[before] + part * (T[after] - T[before]))
    between = ((part > 0.0) & (part < 1.0)).ravel()
    found[between, :3, :3] = nearest_rotations(found[between, :3, :3])
    return np.asarray(found)


def nearest_rotations(matrices: Float64) -> Float64:
    """The rotations (n, 3, 3) nearest to matrices that are nearly some (Newton-Schulz)."""
    for _ in range(6):
        squares = matrices.swapaxes(1, 2) @ matrices
        matrices = matrices @ (1.5 * np.eye(3) - 0.5 * squares)
    return matrices


def invert_poses(T: Float64) -> Float64:
    """Inverses of rigid transforms (n, 4, 4)."""
    inverse = np.broadcast_to(np.eye(4), T.shape).copy()
    turns = T[:, :3, :3].swapaxes(1, 2)
    inverse[:, :3, :3], inverse[:, :3, 3] = turns, -(turns @ T[:, :3, 3:])[:, :, 0]
    return inverse


# --- The up direction of the world frame, from the poses of the camera.

AXES = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}

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
            self._known, self._known_count = self.estimate(), self._count
        return self._known

    def estimate(self) -> Float64:
        """Up of all poses so far, computed anew: `up_world` may keep an older answer."""
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


# --- Frames of a camera that is mounted on its side, turned upright.
#
# A quarter turn moves pixels and does not change them: the pixel (u, v) of an image of width W
# becomes (v, W - 1 - u).

# R_camera_turned of one quarter turn: the new x axis is y, the new y axis is -x.
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class UprightFrame:
    """A frame, and the same frame turned upright.

    Attributes:
        original: as the camera took it.
        upright: the same object if it needs no turn.
        turns: quarter turns counter-clockwise from `original` to `upright`, 0 to 3.
    """

    original: RgbdFrame
    upright: RgbdFrame
    turns: int = 0


class Uprighter:
    """Decides for each frame, in order of time, how it is turned.

    The turn changes only when up is clearly in the direction of another side of the image. A camera
    that looks straight down keeps its turn.

    Args:
        world_up: as `UpEstimator`.
    """

    def __init__(self, world_up: str) -> None:
        self._up = UpEstimator(world_up)
        self._turns = 0

    def turn(self, frame: RgbdFrame) -> UprightFrame:
        """The frame, upright."""
        self._up.observe(frame.T_world_camera)
        turns = quarter_turns(frame.T_world_camera[:3, :3].T @ self._up.up_world())
        self._turns = self._turns if turns is None else turns
        return UprightFrame(frame, turned(frame, self._turns), self._turns)


def turned(frame: RgbdFrame, turns: int) -> RgbdFrame:
    """A frame after so many quarter turns counter-clockwise; its pose is that of the turned camera.

    The same object for no turn.
    """
    if turns % 4 == 0:
        return frame
    intrinsics, T_world_camera = frame.intrinsics, frame.T_world_camera.copy()
    for _ in range(turns % 4):
        i = intrinsics
        intrinsics = Intrinsics(i.fy, i.fx, i.cy, i.width - 1 - i.cx, i.height, i.width)
        T_world_camera[:3, :3] = T_world_camera[:3, :3] @ QUARTER_TURN
    return replace(
        frame,
        rgb=np.ascontiguousarray(np.rot90(frame.rgb, turns)),
        depth_m=np.ascontiguousarray(np.rot90(frame.depth_m, turns)),
        intrinsics=intrinsics,
        T_world_camera=T_world_camera,
    )
