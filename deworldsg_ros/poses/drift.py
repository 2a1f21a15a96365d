"""Correction of poses that drift or tremble, by a map of surfels. Beyond the paper."""

from __future__ import annotations

import math
from itertools import accumulate

import numpy as np

from deworldsg_ros.base.kernels import kernel, read_only
from deworldsg_ros.scene.arrays import Bool, Float64, Int64, UInt16
from deworldsg_ros.scene.camera import Intrinsics, invert_pose
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph, derived
from deworldsg_ros.scene.gaussian import transform

# --- A map of surfels, small planes of the depth images, that frames are registered with.

# A full map drops the half that was not in view for the longest time. A room needs 10 000.
MAX_SURFELS = 20_000
# At most this number of surfels is compared with a frame; fewer than MIN_MATCHES decide nothing.
SAMPLES, MIN_MATCHES = 400, 100
MAX_FRAME = 1 << 62
# Maximum distance of a surfel from the depth image in each Gauss-Newton step: coarse, then fine.
REACHES_M = (0.3, 0.2, 0.1, 0.1)
# Weight of no motion, as a fraction of the mean weight of a translation axis. A radian weighs as
# much as RADIAN_M metres: the usual distance of surfaces.
DAMPING, RADIAN_M = 0.03, 2.5
# Directions of a motion that the planes hold by less than this part of all are not corrected. With
# exact poses in three simulated homes, the mean correction is 0.5 cm (6.4 cm without this, and with
# the far sides of walls); with poses that tremble and drift, 0.005 and more lose accuracy.
MIN_HELD = 0.003
JOINT = np.array([RADIAN_M**2] * 3 + [1.0] * 3)  # squared rotation and translation, in m²
# Standard deviation of depth, metres: constant, and times squared depth (structured light).
# Residuals beyond OUTLIER of them have small weights (Cauchy).
NOISE_M, NOISE_PER_M, OUTLIER_NOISE = 0.004, 0.002, 3.0
# Depth is used in this range: noise grows with its square.
NEAR_M, FAR_M = 0.2, 4.0
# A surfel covers this distance around it. It moves onto depth at most ON_M away.
SURFEL_M, ON_M = 0.05, 0.05
# A surfel is the mean of its first MAX_COUNT frames: a map that follows its frames would drift
# with them. Beyond TRUSTED of them, its weight grows no more.
MAX_COUNT, TRUSTED = 50.0, 10.0
# Inverse depth is linear on a plane; if it bends by more than this fraction, there is an edge.
MAX_BEND = 0.02

# fx, fy, cx, cy in pixels of a depth grid, and that grid.
_View = tuple[float, float, float, float, UInt16]


class SurfelMap:
    """Surfels: position, normal (metres, world frame), number of frames, newest frame.

    Args:
        most: surfels; a full map drops the half that was not in view for the longest time.

    Attributes:
        frame: number of frames that were added.
        seen: rows in view in the last `register`.
    """

    def __init__(self, most: int = MAX_SURFELS) -> None:
        self._most, self._rows = most, np.zeros((MAX_SURFELS, 8))
        self._count = self.frame = 0
        self.seen = np.zeros(0, np.int64)
        self._view: _View

    @property
    def rows(self) -> Float64:
        """The surfels (n, 8), not a copy."""
        return self._rows[: self._count]

    def register(
        self, T_world_camera: Float64, grid: DepthGrid, since: int = 0, until: int = MAX_FRAME
    ) -> Float64 | None:
        """The pose (4, 4) near a given one at which a frame fits the map; None if unknown.

        Gauss-Newton on the distances of the frame's depth from the planes of the surfels in view,
        projected into the frame. Directions that these planes leave open are not corrected.

        Args:
            T_world_camera: (4, 4) given pose.
            grid: depth of the frame.
            since: of surfels that count, the first newest frame.
            until: the last one.
        """
        self._view = _view(grid)
        poses = T_world_camera, invert_pose(T_world_camera)
        fitted = _register(self.rows, *poses, self._view, since, until)
        self.seen, is_found, T_fitted, hessian = fitted
        return _as_held(T_world_camera, T_fitted, hessian) if is_found else None

    def misfit(self, T_world_camera: Float64) -> float:
        """How badly the frame of the last `register` fits the map at a pose; 0 = exactly."""
        return float(_system(self.rows, self.seen, T_world_camera, self._view, REACHES_M[-1])[3])

    def add(self, T_world_camera: Float64) -> None:
        """Fuse the frame of the last `register`."""
        new = self._view[4].size // 4
        if self._count + new > self._most:
            newest = np.argsort(-self._rows[: self._count, 7], kind="stable")[: self._most // 2]
            self._count = len(newest)
            self._rows[: self._count] = self._rows[newest]
            self.seen = np.zeros(0, np.int64)
        if self._count + new > len(self._rows):
            more = max(new, min(len(self._rows), self._most - len(self._rows)))
            self._rows = np.concatenate((self._rows, np.zeros((more, 8))))
        self.frame += 1
        arguments = T_world_camera, invert_pose(T_world_camera), self._view, self.frame
        self._count = _fuse(self._rows, self._count, self.seen, *arguments)

    def move(self, T_new_old: Float64, firsts: Int64) -> None:
        """Move surfels with the keyframe that saw them last.

        Args:
            T_new_old: (k, 4, 4) of the keyframes.
            firsts: (k,) the first frame of each, ascending.
        """
        rows = self.rows
        T = T_new_old[np.maximum(firsts.searchsorted(rows[:, 7], "right") - 1, 0)]
        rows[:, :3] = np.einsum("nij,nj->ni", T[:, :3, :3], rows[:, :3]) + T[:, :3, 3]
        rows[:, 3:6] = np.einsum("nij,nj->ni", T[:, :3, :3], rows[:, 3:6])


def about_camera(step: Float64, T_world_camera: Float64) -> Float64:
    """A rotation vector about the camera and a translation (6,), world axes, as (4, 4)."""
    T, camera_world, turn = np.eye(4), T_world_camera[:3, 3], _turn(step)
    x, y, z = (turn * camera_world).T
    # One after the other: a matrix product rounds in another order.
    T[:3, :3], T[:3, 3] = turn, step[3:] + camera_world - x - y - z
    return T


@kernel
def stepped(step: Float64, T_world_camera: Float64) -> Float64:
    """The camera pose (4, 4) after a step (6,) of `about_camera`."""
    T, turn = T_world_camera.copy(), _turn(step)
    for i in range(3):
        T[i, 3] += step[3 + i]
        for j in range(3):
            T[i, j] = 0.0
            for k in range(3):
                T[i, j] += turn[i, k] * T_world_camera[k, j]
    return T


@kernel
def _turn(step: Float64) -> Float64:
    """The rotation (3, 3) of a rotation vector (Rodrigues)."""
    turn, cross = np.zeros((3, 3), np.float64), np.zeros((3, 3), np.float64)
    x, y, z = step[0], step[1], step[2]
    angle = math.sqrt(x * x + y * y + z * z)
    if angle > 0:
        x, y, z = x / angle, y / angle, z / angle
        cross[0, 1], cross[0, 2], cross[1, 2] = -z, y, -x
        cross[1, 0], cross[2, 0], cross[2, 1] = z, -y, x
    sine, versine = math.sin(angle), 1 - math.cos(angle)
    for i in range(3):
        for j in range(3):
            turn[i, j] = sine * cross[i, j] + (1.0 if i == j else 0.0)
            for k in range(3):
                turn[i, j] += versine * cross[i, k] * cross[k, j]
    return turn


@kernel
def difference(T_a: Float64, T_b: Float64) -> Float64:
    """The step (6,) of `about_camera` from camera pose a to b."""
    R, step, double_sine = np.zeros((3, 3), np.float64), np.empty(6, np.float64), 0.0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                R[i, j] += T_b[i, k] * T_a[j, k]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        step[i], step[3 + i] = R[k, j] - R[j, k], T_b[i, 3] - T_a[i, 3]
        double_sine += step[i] * step[i]
    double_sine = math.sqrt(double_sine)
    angle = math.atan2(double_sine, R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    for i in range(3):
        step[i] *= angle / double_sine if double_sine > 1e-12 else 0.5
    return step


def _view(grid: DepthGrid) -> _View:
    camera, stride = grid.intrinsics, grid.stride_px
    cx, cy = (camera.cx - stride // 2) / stride, (camera.cy - stride // 2) / stride
    return camera.fx / stride, camera.fy / stride, cx, cy, read_only(grid.depth_mm)


@kernel
def _pixel(T: Float64, surfel: Float64, view: _View) -> tuple[int, int, float, float]:
    """Row and column of a surfel, its depth and the measured one, metres; row -1 if not in view."""
    fx, fy, cx, cy, depth_mm = view
    x, y, z = surfel[0], surfel[1], surfel[2]
    ahead = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
    if ahead < NEAR_M:
        return -1, 0, ahead, 0.0
    right = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    down = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    column, row = int(fx * right / ahead + cx + 0.5), int(fy * down / ahead + cy + 0.5)
    if row < 0 or column < 0 or row >= depth_mm.shape[0] or column >= depth_mm.shape[1]:
        return -1, 0, ahead, 0.0
    measured = 0.001 * depth_mm[row, column]
    return (row if measured > NEAR_M else -1), column, ahead, measured


@kernel
def _ray(row: int, column: int, view: _View) -> tuple[float, float, float]:
    fx, fy, cx, cy, depth_mm = view
    z = 0.001 * depth_mm[row, column]
    return (column - cx) / fx * z, (row - cy) / fy * z, z


@kernel
def _turned(T: Float64, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )


@kernel
def _system(
    rows: Float64, seen: Int64, T: Float64, view: _View, reach_m: float
) -> tuple[Float64, Float64, int, float]:
    """Damped normal equations (6, 6) and (6,) of a point-to-plane step; the number of matches.

    Last, the mean robust cost (Cauchy) of the surfels in view: one beyond reach costs as at reach.
    """
    hessian, gradient = np.zeros((6, 6), np.float64), np.zeros(6, np.float64)
    jacobian, matches, cost, weights = np.empty(6, np.float64), 0, 0.0, 1e-9
    inverse = np.zeros((3, 4), np.float64)
    for i in range(3):
        for j in range(3):
            inverse[i, j] = T[j, i]
            inverse[i, 3] -= T[j, i] * T[j, 3]
    for index in range(0, len(seen), max(1, len(seen) // SAMPLES)):
        surfel = rows[seen[index]]
        row, column, _, measured = _pixel(inverse, surfel, view)
        if row < 0 or measured > FAR_M:
            continue
        x, y, z = _ray(row, column, view)
        x, y, z = _turned(T, x, y, z)
        a, b, c = surfel[0] - T[0, 3] - x, surfel[1] - T[1, 3] - y, surfel[2] - T[2, 3] - z
        distance = a * surfel[3] + b * surfel[4] + c * surfel[5]
        noise_m = NOISE_M + NOISE_PER_M * measured**2
        outlier_m = OUTLIER_NOISE * noise_m * reach_m / REACHES_M[-1]
        weights += min(surfel[6], TRUSTED)
        if abs(distance) > reach_m or a * a + b * b + c * c > 4 * reach_m**2:
            cost += min(surfel[6], TRUSTED) * math.log(1 + (reach_m / outlier_m) ** 2)
            continue
        cost += min(surfel[6], TRUSTED) * math.log(1 + (distance / outlier_m) ** 2)
        weight = min(surfel[6], TRUSTED) / (1 + (distance / outlier_m) ** 2) / noise_m**2
        jacobian[0] = y * surfel[5] - z * surfel[4]
        jacobian[1] = z * surfel[3] - x * surfel[5]
        jacobian[2] = x * surfel[4] - y * surfel[3]
        for i in range(6):
            if i > 2:
                jacobian[i] = surfel[i]
            gradient[i] += weight * distance * jacobian[i]
            for j in range(i + 1):
                hessian[i, j] += weight * jacobian[i] * jacobian[j]
        matches += 1
    for i in range(6):
        for j in range(i):
            hessian[j, i] = hessian[i, j]
    mean = (hessian[3, 3] + hessian[4, 4] + hessian[5, 5]) / 3
    for i in range(6):
        hessian[i, i] += DAMPING * mean * (RADIAN_M**2 if i < 3 else 1.0)
    return hessian, gradient, matches, cost / weights


def _as_held(T: Float64, T_fitted: Float64, hessian: Float64) -> Float64:
    """The pose T, moved to a fitted one in the directions that the planes hold.

    In the others, noise would move it [J. Zhang, M. Kaess and S. Singh, "On degeneracy of
    optimization-based state estimation problems", ICRA 2016].
    """
    scale = np.sqrt(JOINT)
    values, directions = np.linalg.eigh(hessian / np.outer(scale, scale))
    values -= DAMPING / 3.0 * np.trace(hessian[3:, 3:]) / (1.0 + DAMPING)
    free = directions[:, values < MIN_HELD * values.sum()]
    if not free.size:
        return T_fitted
    step = scale * difference(T, T_fitted)
    return stepped((step - free @ (free.T @ step)) / scale, T)


@kernel
def _register(
    rows: Float64, T: Float64, T_camera_world: Float64, view: _View, since: int, until: int
) -> tuple[Int64, bool, Float64, Float64]:
    """The surfels in view that the depth image does not hide; whether enough fit, at which pose.

    Last, the damped normal equations (6, 6) of the last step.
    """
    system = np.eye(6)
    seen, count = np.empty(len(rows), np.int64), 0
    for index in range(len(rows)):
        if not since <= rows[index, 7] <= until:
            continue
        # The other side of a wall is not in view. Normals point away from the camera.
        facing = 0.0
        for axis in range(3):
            facing += (rows[index, axis] - T[axis, 3]) * rows[index, 3 + axis]
        if facing < 0.0:
            continue
        row, _, depth, measured = _pixel(T_camera_world, rows[index], view)
        if row >= 0 and depth < measured + REACHES_M[0]:
            seen[count] = index
            count += 1
    seen = seen[:count]
    for reach_m in REACHES_M:
        hessian, step, matches, _ = _system(rows, seen, T, view, reach_m)
        if matches < MIN_MATCHES:
            return seen, False, T, system
        system[:] = hessian
        # Gauss: the equations are positive definite, or singular.
        for k in range(6):
            if not hessian[k, k] > 0.0:
                return seen, False, T, system
            for i in range(k + 1, 6):
                factor = hessian[i, k] / hessian[k, k]
                step[i] -= factor * step[k]
                for j in range(k, 6):
                    hessian[i, j] -= factor * hessian[k, j]
        for i in range(5, -1, -1):
            for j in range(i + 1, 6):
                step[i] -= hessian[i, j] * step[j]
            step[i] /= hessian[i, i]
        T = stepped(step, T)
    return seen, True, T, system


@kernel
def _normal(row: int, column: int, view: _View) -> tuple[float, float, float]:
    """Unit normal of the depth image at a pixel, camera axes; zero at edges."""
    depth_mm = view[4]
    if not (0 < row < depth_mm.shape[0] - 1 and 0 < column < depth_mm.shape[1] - 1):
        return 0.0, 0.0, 0.0
    a, b = depth_mm[row, column - 1], depth_mm[row, column + 1]
    c, d = depth_mm[row - 1, column], depth_mm[row + 1, column]
    if min(a, b, c, d, depth_mm[row, column]) == 0:
        return 0.0, 0.0, 0.0
    middle = 2.0 / depth_mm[row, column]
    if max(abs(1 / a + 1 / b - middle), abs(1 / c + 1 / d - middle)) > MAX_BEND * middle:
        return 0.0, 0.0, 0.0
    (ax, ay, az), (bx, by, bz) = _ray(row, column - 1, view), _ray(row, column + 1, view)
    (cx, cy, cz), (dx, dy, dz) = _ray(row - 1, column, view), _ray(row + 1, column, view)
    ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, dx - cx, dy - cy, dz - cz
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@kernel
def _cover(covered: Bool, row: int, column: int, half: int) -> None:
    """Mark the odd pixels at most `half` pixels away."""
    for i in range(max(0, (row - half) // 2), min(len(covered), (row + half + 1) // 2)):
        for j in range(
            max(0, (column - half) // 2), min(covered.shape[1], (column + half + 1) // 2)
        ):
            covered[i, j] = True


@kernel
def _update(surfel: Float64, row: int, column: int, T: Float64, view: _View) -> bool:
    """Average a surfel with a pixel; false if the pixel does not lie on its plane."""
    x, y, z = _ray(row, column, view)
    x, y, z = _turned(T, x, y, z)
    x, y, z = x + T[0, 3] - surfel[0], y + T[1, 3] - surfel[1], z + T[2, 3] - surfel[2]
    distance = x * surfel[3] + y * surfel[4] + z * surfel[5]
    if abs(distance) > ON_M or x * x + y * y + z * z > REACHES_M[0] ** 2:
        return False
    if surfel[6] < MAX_COUNT:
        share = 1.0 / (surfel[6] + 1.0)
        for axis in range(3):
            surfel[axis] += share * distance * surfel[3 + axis]
        x, y, z = _normal(row, column, view)
        if x * x + y * y + z * z > 0:
            x, y, z = _turned(T, x, y, z)
            x = (1.0 - share) * surfel[3] + share * x
            y = (1.0 - share) * surfel[4] + share * y
            z = (1.0 - share) * surfel[5] + share * z
            length = np.sqrt(x * x + y * y + z * z)
            surfel[3], surfel[4], surfel[5] = x / length, y / length, z / length
        surfel[6] += 1.0
    return True


@kernel
def _fuse(
    rows: Float64,
    count: int,
    seen: Int64,
    T: Float64,
    T_camera_world: Float64,
    view: _View,
    frame: int,
) -> int:
    """Update the surfels in view, and add new ones where there are none; returns their number."""
    depth_mm = view[4]
    covered = np.zeros((depth_mm.shape[0] // 2, depth_mm.shape[1] // 2), np.bool_)
    for index in seen[::-1]:
        surfel = rows[index]
        row, column, depth, measured = _pixel(T_camera_world, surfel, view)
        if row < 0:
            continue
        if measured > depth + REACHES_M[0]:  # seen through: the surface is gone
            surfel[6] *= 0.8
            if surfel[6] < 0.5:
                count -= 1
                for item in range(8):
                    rows[index, item] = rows[count, item]
        elif measured <= FAR_M and _update(surfel, row, column, T, view):
            surfel[7] = frame
            _cover(covered, row, column, int(SURFEL_M * view[0] / depth))
    for i in range(covered.shape[0]):
        for j in range(covered.shape[1]):
            row, column = 2 * i + 1, 2 * j + 1
            depth = 0.001 * depth_mm[row, column]
            if covered[i, j] or not NEAR_M < depth < FAR_M:
                continue
            x, y, z = _normal(row, column, view)
            if x * x + y * y + z * z == 0:
                continue
            surfel = rows[count]
            surfel[3], surfel[4], surfel[5] = _turned(T, x, y, z)
            x, y, z = _ray(row, column, view)
            x, y, z = _turned(T, x, y, z)
            surfel[0], surfel[1], surfel[2] = x + T[0, 3], y + T[1, 3], z + T[2, 3]
            surfel[6], surfel[7] = 1.0, frame
            count += 1
            _cover(covered, row, column, int(SURFEL_M * view[0] / depth))
    return count


# --- Correction of poses that drift or tremble, before a frame is merged. Beyond the paper.
#
# A map of the depth images (`surfels`) gives the error of each pose. Its mean is the drift, the
# rest trembles. Each is corrected as far as the noise of its own estimate does not explain it
# (James and Stein), so that exact poses stay as they are.

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
OUTLIER_STEP = 4.0
# A frame may fit the map at a wrong place, too: along a corridor, or where little of it is known.
# So a larger step counts only if the frame fits so much better there, and in the mean error as one
# of so many standard deviations. A jump of 20 cm is still followed, a few frames later.
LARGE_STEP_M, BETTER, MOST_SIGMAS = 0.03, 0.7, 4.0


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
        fitted = self._fitted(self._T_map_poses @ T_given, grid)
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

    def _fitted(self, expected: Float64, grid: DepthGrid) -> Float64 | None:
        """The pose at which a frame fits the map, or the expected one if it fits about as well."""
        fitted = self._map.register(expected, grid)
        if fitted is None or _squared(difference(expected, fitted)) < LARGE_STEP_M**2:
            return fitted
        return (
            fitted if self._map.misfit(fitted) < BETTER * self._map.misfit(expected) else expected
        )

    def _learn(self, T_given: Float64, fitted: Float64) -> tuple[float, Float64]:
        """Update the mean error; returns the rest of this frame, and the part to correct."""
        self._frames += 1
        expected = self._T_map_poses @ T_given
        step, error = difference(expected, fitted), difference(T_given, fitted)
        # Steady gain of a Kalman filter of a random walk.
        ratio = DRIFT_VARIANCE_M2 / self._trembling_m2
        self._gain = (math.sqrt(ratio**2 + 4.0 * ratio) - ratio) / 2.0
        gain = max(self._gain, 1.0 / self._frames)
        most = MOST_SIGMAS * math.sqrt(self._trembling_m2 + FIT_VARIANCE_M2)
        gain *= min(1.0, most / max(math.sqrt(_squared(step)), 1e-9))
        self._T_map_poses = about_camera(gain * step, expected) @ self._T_map_poses
        # The difference of two successive errors contains no drift, and twice the trembling.
        change_m2 = min(_squared(error - self._error) / 2.0, MAX_RATIO * self._trembling_m2)
        self._error = error
        gain = max(VARIANCE_GAIN, 1.0 / (self._frames + 1))
        self._trembling_m2 += gain * (change_m2 - self._trembling_m2)
        own = _shrunk(max(self._trembling_m2, _squared(step) / OUTLIER_STEP), FIT_VARIANCE_M2)
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
