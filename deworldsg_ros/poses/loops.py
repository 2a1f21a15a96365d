"""Odometry with a map of surfels: a place that is seen again closes a loop."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import chain
from typing import Literal, NamedTuple

import numpy as np

from deworldsg_ros.base.words import counted
from deworldsg_ros.poses.drift import FAR_M, NEAR_M, SurfelMap
from deworldsg_ros.poses.odometry import Features, RgbdOdometry, motion_of, rigid
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt8
from deworldsg_ros.scene.camera import (
    Intrinsics,
    RgbdFrame,
    Trajectory,
    invert_pose,
    invert_poses,
    point_to_plane,
    rigid_motion,
    rotation_angle_deg,
)
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import DepthGrid

# --- A graph of poses: the motions between keyframes, and the loops.

# Standard deviations of a motion between keyframes: constant, and a part of the motion.
STEP_M, STEP_RAD, STEP_PART = 0.003, 0.002, 0.02
# Of a pose that a closed loop says.
LOOP_M, LOOP_RAD = 0.02, 0.008
# Loops that are off by more standard deviations than this have small weights.
OUTLIER = 15.0
# The solver ends when no pose moves by more (metres, radians), or after so many steps.
MIN_STEP, MAX_STEPS = 1e-5, 30
Kernel = Literal["cauchy", "huber", "none"]


class Edges(NamedTuple):
    """Relative poses of pairs of keyframes.

    Attributes:
        a, b: (m,) rows of the keyframes.
        T_a_b: (m, 4, 4) measured.
        sigmas: (m, 2) standard deviations, radians and metres.
        is_loop: (m,) whether it may be wrong: loops are robust, motions are not.
    """

    a: Int64
    b: Int64
    T_a_b: Float64
    sigmas: Float64
    is_loop: Bool


def _residuals(T: Float64, edges: Edges) -> tuple[Float64, Float64, Float64]:
    """Residuals (m, 6) in standard deviations, and their derivatives (m, 6, 6) by both poses.

    A residual is the rotation vector and the translation of T_a_b⁻¹ T_a⁻¹ T_b. A pose moves by a
    rotation vector and a translation (6,) in its own axes.
    """
    from scipy.spatial.transform import Rotation

    R_a, R_b, R_z = T[edges.a, :3, :3], T[edges.b, :3, :3], edges.T_a_b[:, :3, :3]
    apart = np.einsum("mji,mj->mi", R_a, T[edges.b, :3, 3] - T[edges.a, :3, 3])
    R_ab, back = R_a.swapaxes(1, 2) @ R_b, R_z.swapaxes(1, 2)
    error = back @ R_ab
    turns = Rotation.from_matrix(error).as_rotvec()
    shifts = np.einsum("mij,mj->mi", back, apart - edges.T_a_b[:, :3, 3])
    angles = np.linalg.norm(turns, axis=1)[:, None, None]
    small = np.maximum(angles, 1e-4)
    curve = 1.0 / small**2 - (1.0 + np.cos(small)) / (2.0 * small * np.sin(small))
    cross = _cross(turns)
    inverse = np.eye(3) + 0.5 * cross + curve * cross @ cross  # of the right Jacobian of SO(3)
    by_a, by_b = np.zeros((2, len(T[edges.a]), 6, 6))
    by_b[:, :3, :3], by_b[:, 3:, 3:] = inverse, error
    by_a[:, :3, :3], by_a[:, 3:, 3:] = -inverse @ R_ab.swapaxes(1, 2), -back
    by_a[:, 3:, :3] = back @ _cross(apart)
    scale = 1.0 / np.repeat(edges.sigmas, 3, axis=1)
    residuals = scale * np.concatenate((turns, shifts), axis=1)
    return residuals, scale[:, :, None] * by_a, scale[:, :, None] * by_b


def _cross(v: Float64) -> Float64:
    matrices = np.zeros((len(v), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrices[:, j, k], matrices[:, k, j] = -v[:, i], v[:, i]
    return matrices


def robust_weights(squared: Float64, limit: float, kernel: Kernel) -> Float64:
    """Weights (m,) of squared residuals, of one above `limit` less than 1 (Huber, Cauchy)."""
    if kernel == "cauchy":
        return 1.0 / (1.0 + squared / limit**2)
    if kernel == "huber":
        return limit / np.sqrt(np.maximum(squared, limit**2))
    return np.ones_like(squared)


def solve(T_world: Float64, edges: Edges, kernel: Kernel = "cauchy") -> Float64:
    """The poses (k, 4, 4) that fit the edges best; the first one stays.

    Gauss-Newton with sparse normal equations [Grisetti et al., "A tutorial on graph-based SLAM",
    IEEE ITS Magazine 2(4), 2010]. Loops get robust weights, whose limit begins at the largest
    residual and is halved in each step: so what most edges agree on counts, wherever it starts
    [Yang et al., "Graduated non-convexity", IEEE RA-L 5(2), 2020].

    Args:
        T_world: (k, 4, 4) poses to begin with.
        edges: connect all poses.
        kernel: of the loops.
    """
    # scipy takes a second to import, and is needed when a loop closes.
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve
    from scipy.spatial.transform import Rotation

    T, count = T_world.copy(), len(T_world)
    limit = np.inf
    columns = 6 * np.stack((edges.a, edges.b))[:, :, None] + np.arange(6)
    both = np.concatenate(tuple(columns), axis=1)
    places = np.repeat(both, 12, axis=1).ravel(), np.tile(both, 12).ravel()
    for _ in range(MAX_STEPS):
        residuals, by_a, by_b = _residuals(T, edges)
        squared = (residuals**2).sum(axis=1)
        limit = max(OUTLIER, min(limit, np.sqrt(squared.max())) / 2.0)
        weights = np.where(edges.is_loop, robust_weights(squared, limit, kernel), 1.0)
        jacobian = np.concatenate((by_a, by_b), axis=2)
        weighted = weights[:, None, None] * jacobian
        hessian = coo_matrix(
            (np.einsum("mki,mkj->mij", weighted, jacobian).ravel(), places),
            shape=(6 * count, 6 * count),
        ).tocsc()
        gradient = np.zeros(6 * count)
        np.add.at(gradient, both.ravel(), np.einsum("mki,mk->mi", weighted, residuals).ravel())
        step = np.zeros((count, 6))
        step[1:] = -spsolve(hessian[6:, 6:], gradient[6:]).reshape(-1, 6)
        T[:, :3, 3] += np.einsum("kij,kj->ki", T[:, :3, :3], step[:, 3:])
        T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(step[:, :3]).as_matrix()
        if np.abs(step).max() < MIN_STEP and limit == OUTLIER:
            break
    return T


# --- How surfels fit a frame.

# What a loop needs: old surfels in view, the part of them that the depth shows where they are, the
# part of the image that they cover, the median distance from their planes, and how well the
# planes hold the pose in each direction (see `Fit.held`).
MIN_OLD, MIN_ON, MIN_COVER, MAX_RESIDUAL_M, MIN_HELD = 250, 0.9, 0.3, 0.012, 0.03
# A surfel is where the depth shows it within this distance, and a part of the depth.
ON_M, ON_PART = 0.03, 0.01
# The motion from frame to frame counts as so many surfels.
PRIOR = 15.0
# So many surfels are looked at. With fewer on the depth than the least, nothing is known.
MAX_LOOKED, MIN_LOOKED = 800, 60


class Fit(NamedTuple):
    """How surfels fit a frame.

    Attributes:
        in_view: number of surfels in view.
        on: part of them that the depth shows where they are.
        cover: part of the image that these cover.
        residual_m: their median distance from the depth, along their normals.
        held: (6,) eigenvalues of the normal equations as parts of their trace, ascending: how well
            the planes hold each direction of a motion (rotation times `size_m`, translation).
        directions: (6, 6) these directions, a column each; world axes, about `centre`.
        centre: (3,) of the surfels.
        size_m: their distance from it.
    """

    in_view: int
    on: float
    cover: float
    residual_m: float
    held: Float64
    directions: Float64
    centre: Float64
    size_m: float

    @property
    def is_loop(self) -> bool:
        """Whether surfels that were not in view for a while are these for sure."""
        return (
            self.in_view >= MIN_OLD
            and self.on >= MIN_ON
            and self.cover >= MIN_COVER
            and self.residual_m <= MAX_RESIDUAL_M
            and self.held[0] >= MIN_HELD
        )

    def limited(self, T: Float64, T_fitted: Float64) -> Float64:
        """The pose T (4, 4), corrected to `T_fitted` as far as the planes hold each direction.

        Directions of degenerate geometry stay [J. Zhang, M. Kaess and S. Singh, "On degeneracy of
        optimization-based state estimation problems", ICRA 2016]. The others are the mean of both
        poses, where T counts as `PRIOR` surfels.
        """
        from scipy.spatial.transform import Rotation

        move = T_fitted @ invert_pose(T)
        turn = self.size_m * Rotation.from_matrix(move[:3, :3]).as_rotvec()
        shift = move[:3, :3] @ self.centre + move[:3, 3] - self.centre
        surfels = 2.0 * self.on * self.in_view * self.held
        share = surfels / (surfels + PRIOR)
        step = self.directions @ (share * (self.directions.T @ np.append(turn, shift)))
        about = rigid_motion(step[3:], step[:3] / self.size_m)
        about[:3, 3] += self.centre - about[:3, :3] @ self.centre
        return about @ T


def fit_of(rows: Float64, T_world_camera: Float64, grid: DepthGrid) -> Fit | None:
    """How surfels (n, 8) of a `SurfelMap` fit a frame at a pose (4, 4); None = too few."""
    count = len(rows)
    rows = rows[:: max(1, count // MAX_LOOKED)]
    T = invert_pose(T_world_camera)
    points = rows[:, :3] @ T[:3, :3].T + T[:3, 3]
    rows, points = rows[points[:, 2] > NEAR_M], points[points[:, 2] > NEAR_M]
    stride, (height, width) = grid.stride_px, grid.depth_mm.shape
    pixels = np.rint((grid.intrinsics.project(points) - stride // 2) / stride).astype(int)
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
    rows, points, pixels = rows[inside], points[inside], pixels[inside]
    measured = 0.001 * grid.depth_mm[pixels[:, 1], pixels[:, 0]]
    gap, near = measured - points[:, 2], ON_M + ON_PART * points[:, 2]
    # What something hides, or is not measured, tells nothing.
    told = (measured > NEAR_M) & (measured < FAR_M) & (gap > -3 * near)
    rays = points / points[:, 2:] @ T[:3, :3]
    distances = gap * np.einsum("ni,ni->n", rays, rows[:, 3:6])
    on = told & (np.abs(distances) < near)
    if np.count_nonzero(on) < MIN_LOOKED:
        return None
    cells = np.zeros((8, 8), bool)
    cells[pixels[on, 1] * 8 // height, pixels[on, 0] * 8 // width] = True
    centre = rows[on, :3].mean(axis=0)
    apart = rows[on, :3] - centre
    size_m = float(np.sqrt((apart**2).sum(axis=1).mean()))
    jacobian, _ = point_to_plane(apart / size_m, rows[on, 3:6], distances[on], ON_M)
    values, directions = np.linalg.eigh(jacobian.T @ jacobian)
    residual_m = float(np.median(np.abs(distances[on])))
    part = float(np.count_nonzero(on) / np.count_nonzero(told))
    held = values / values.sum()
    return Fit(count, part, float(cells.mean()), residual_m, held, directions, centre, size_m)


# --- Odometry with keyframes, and the surfels that were seen from them.

# Points of a depth image across that are aligned.
GRID_COLUMNS = 160
# A map of this size is some six rooms: 6 MB.
MAX_SURFELS = 100_000
# A keyframe begins after this motion. Of more keyframes, every second one of the older half stays.
KEYFRAME_M, KEYFRAME_DEG, MAX_KEYFRAMES = 0.25, 15.0, 512
# Frames are aligned with what was seen from the newest keyframes. What was last seen before is old:
# if it comes into view, a loop may close.
ACTIVE = 10
# A frame that is off by more has not been aligned.
FIT_M, FIT_DEG = 0.1, 5.0
# A closed loop that moves the pose by less has nothing to correct.
CLOSED_M, CLOSED_DEG = 0.01, 0.3
# Old surfels that are not where the pose says are looked for from these keyframes: so many of the
# nearest, and the newest frame shares so many features with one.
CANDIDATES, MIN_SHARED = 3, 40
# Keyframes are near if places so far before the camera are.
AHEAD_M = 2.0
# Odometry drifts by less: constant, and a part of the path since.
DRIFT_M, DRIFT_PART, MAX_DRIFT_DEG = 0.5, 0.05, 30.0
# After a restart the pose is wrong by more than any motion.
RESTARTED = 1e3


class _Keyframe:
    """A keyframe.

    Attributes:
        stamp_ns: of its frame.
        T: (4, 4) world frame, corrected.
        first: its frame in the map of surfels.
        features: of its image.
        T_last: (4, 4) measured, from the keyframe before.
        loose: factor of the standard deviations of `T_last`.
    """

    def __init__(
        self, stamp_ns: int, T: Float64, first: int, features: Features, before: _Keyframe | None
    ) -> None:
        self.stamp_ns, self.T, self.first, self.features = stamp_ns, T, first, features
        self.T_last = np.eye(4) if before is None else invert_pose(before.T) @ T
        self.loose = 1.0


class LoopOdometry:
    """RGB-D odometry that is aligned with a map of surfels, and closes loops.

    What is measured against the map does not drift while the camera stays in a place. When it
    comes back to one, what it saw there before tells by how much it has drifted since.

    Args:
        T_world_start: (4, 4) pose of the first frame; None = level, at the origin, looking along x.

    Attributes:
        odometry: from frame to frame.
        closed: number of closed loops.
        correction_m: how far the last one moved the camera.
        direct: (4, 4) pose of the newest frame from frame to frame, without map and loops.
    """

    def __init__(self, T_world_start: Float64 | None = None) -> None:
        self.odometry = RgbdOdometry(T_world_start)
        self.closed, self.correction_m = 0, 0.0
        self._map = SurfelMap(MAX_SURFELS)
        self._keyframes: list[_Keyframe] = []
        self._loops: list[tuple[_Keyframe, _Keyframe, Float64]] = []
        # Of the last frame: the pose from frame to frame, that in the map, and the restarts so far.
        self.direct, self._T, self._restarts = np.eye(4), np.eye(4), 0
        self._since = 0  # the first frame after the last restart
        self._turn = 0

    def track(
        self, stamp_ns: int, rgb: UInt8, depth_m: Float32, intrinsics: Intrinsics
    ) -> tuple[Float64, Trajectory | None]:
        """T_world_camera (4, 4) of the next frame, and all keyframes if it closed a loop.

        Args:
            stamp_ns: of the frame.
            rgb: (H, W, 3) uint8, RGB order.
            depth_m: (H, W) float32, metres; 0 = invalid.
            intrinsics: of both images.

        Raises:
            RefusedInput: as `RgbdOdometry.track`.
        """
        grid, found = _grid(depth_m, intrinsics), None
        try:
            T_odometry = self.odometry.track(rgb, depth_m, intrinsics)
        except RefusedInput:
            found = self._found_again(grid)
            if found is None:
                raise
            T_odometry = self.direct
        T = T_odometry
        restarted = self.odometry.restarts > self._restarts
        if restarted:  # where this is seen from, nobody knows
            self._since = self._map.frame + 1
        last = self._keyframes[-1] if self._keyframes else None
        if last is not None:
            T = self._fitted(rigid(self._T @ invert_pose(self.direct) @ T_odometry), grid)
        begins = last is None or _is_far(last.T, T, KEYFRAME_M, KEYFRAME_DEG)
        begins |= restarted or found is not None
        closing = None
        if begins and (last is None or stamp_ns > last.stamp_ns):
            newest = _Keyframe(stamp_ns, T, self._map.frame + 1, self.odometry.features, last)
            newest.loose = RESTARTED if restarted or found is not None else 1.0
            self._keyframes.append(newest)
            if found is not None:
                self._loops.append((found, newest, invert_pose(found.T) @ T))
            if len(self._keyframes) > MAX_KEYFRAMES:
                self._thin()
            closing = self._look_back(newest, grid)
            T = self._fitted(newest.T, grid)  # what `add` fuses is the active part
        self._map.add(T)
        self.direct, self._T, self._restarts = T_odometry, T, self.odometry.restarts
        return T, closing

    @property
    def keyframes_ns(self) -> list[int]:
        """The stamps of the keyframes."""
        return [keyframe.stamp_ns for keyframe in self._keyframes]

    @property
    def loops_ns(self) -> list[tuple[int, int]]:
        """The stamps of both keyframes of each loop, the older one first."""
        return [(a.stamp_ns, b.stamp_ns) for a, b, _ in self._loops]

    def _found_again(self, grid: DepthGrid) -> _Keyframe | None:
        """Go on from a lost frame that shows what was seen before, and from when; None if not."""
        for T in self._recognised(self._T, self._keyframes, True):
            T_seen = self._map.register(T, grid)
            fit = None if T_seen is None else fit_of(self._map.rows[self._map.seen], T_seen, grid)
            if T_seen is not None and fit is not None and fit.is_loop:
                self._T = self.direct = rigid(T_seen)
                self.odometry.resume(self._T)
                row = self._row_of(self._map.seen)
                self._map.rows[self._map.seen, 7] = self._map.frame
                return self._keyframes[row]
        return None

    def _active(self) -> int:
        """The first frame of the active part of the map."""
        newest = self._keyframes[-ACTIVE:]
        return max(newest[0].first if newest else 0, self._since)

    def _fitted(self, T: Float64, grid: DepthGrid) -> Float64:
        """The pose at which a frame fits the active part of the map; the given one if none."""
        fitted = self._map.register(T, grid, since=self._active())
        if fitted is None or _is_far(T, fitted, FIT_M, FIT_DEG):
            return T
        fit = fit_of(self._map.rows[self._map.seen], fitted, grid)
        return T if fit is None else rigid(fit.limited(T, fitted))

    def _look_back(self, newest: _Keyframe, grid: DepthGrid) -> Trajectory | None:
        """Close a loop if the newest keyframe shows old surfels; the trajectory then."""
        old = [keyframe for keyframe in self._keyframes if keyframe.first < self._active()]
        for T in chain([newest.T], self._recognised(newest.T, old, self._since > 0)):
            T_seen = self._map.register(T, grid, until=self._active() - 1)
            if T_seen is None:
                continue
            seen, row = self._map.rows[self._map.seen], self._row_of(self._map.seen)
            fit = fit_of(seen, T_seen, grid) if self._may_be(row, newest.T, T_seen) else None
            if fit is not None and fit.is_loop:
                return self._close(row, newest, rigid(T_seen))
        return None

    def _row_of(self, seen: Int64) -> int:
        """The row of the keyframe that most surfels were last seen from, a median."""
        frame = float(np.median(self._map.rows[seen, 7]))
        return max(bisect_right(self._firsts, frame) - 1, 0)

    @property
    def _firsts(self) -> list[int]:
        return [keyframe.first for keyframe in self._keyframes]

    def _recognised(self, T: Float64, old: list[_Keyframe], is_lost: bool) -> Iterator[Float64]:
        """Poses at which the newest frame, near T, shows the features of old keyframes.

        The nearest are looked at. If the camera is lost, also others, different ones each time.
        """
        ahead = T[:3, 3] + AHEAD_M * T[:3, 2]
        apart = [np.linalg.norm(k.T[:3, 3] + AHEAD_M * k.T[:3, 2] - ahead) for k in old]
        rows = np.argsort(apart, kind="stable").tolist()
        near, rest = rows[:CANDIDATES], rows[CANDIDATES:]
        if is_lost and rest:
            self._turn += CANDIDATES
            near += np.roll(rest, -self._turn)[:CANDIDATES].tolist()
        for row in near:
            T_newest_old, shared = motion_of(old[row].features, self.odometry.features)
            if shared >= MIN_SHARED:
                yield rigid(old[row].T @ invert_pose(T_newest_old))

    def _may_be(self, row: int, T: Float64, T_seen: Float64) -> bool:
        """Whether odometry can have drifted so far since a keyframe."""
        since = self._keyframes[row + 1 :]
        path_m = sum(float(np.linalg.norm(keyframe.T_last[:3, 3])) for keyframe in since)
        most_m = DRIFT_M + DRIFT_PART * path_m
        restarted = any(keyframe.loose > 1.0 for keyframe in since)
        return restarted or not _is_far(T, T_seen, most_m, MAX_DRIFT_DEG)

    def _close(self, row: int, newest: _Keyframe, T_seen: Float64) -> Trajectory:
        """Take what old surfels say of the newest pose; correct all poses if it differs."""
        keyframes, seen, T_old = self._keyframes, self._map.seen, newest.T
        measured = invert_pose(keyframes[row].T) @ T_seen
        self._loops.append((keyframes[row], newest, measured))
        before = after = np.array([keyframe.T for keyframe in keyframes])
        if _is_far(T_old, T_seen, CLOSED_M, CLOSED_DEG):
            after = solve(before, self._edges())
            for keyframe, T in zip(keyframes, after):
                keyframe.T = rigid(T)
        T_new_old = after @ invert_poses(before)
        self._map.move(T_new_old, np.array(self._firsts))
        self._map.rows[seen, 7] = self._map.frame
        self.closed, self._since = self.closed + 1, 0
        self.correction_m = float(np.linalg.norm((newest.T - T_old)[:3, 3]))
        return Trajectory(np.array(self.keyframes_ns), after, T_new_old)

    def _edges(self) -> Edges:
        from scipy.spatial.transform import Rotation

        row = {id(keyframe): at for at, keyframe in enumerate(self._keyframes)}
        steps = self._keyframes[1:]
        T = np.array([k.T_last for k in steps] + [T for _, _, T in self._loops])
        sigmas = np.full((len(T), 2), (LOOP_RAD, LOOP_M))
        moved = T[: len(steps)]
        turns = Rotation.from_matrix(moved[:, :3, :3]).magnitude()
        lengths = np.linalg.norm(moved[:, :3, 3], axis=1)
        loose = np.array([k.loose for k in steps])
        sigmas[: len(steps), 0] = loose * (STEP_RAD + STEP_PART * turns)
        sigmas[: len(steps), 1] = loose * (STEP_M + STEP_PART * lengths)
        a = [*range(len(steps)), *(row[id(a)] for a, _, _ in self._loops)]
        b = [*range(1, len(steps) + 1), *(row[id(b)] for _, b, _ in self._loops)]
        return Edges(np.array(a), np.array(b), T, sigmas, np.arange(len(T)) >= len(steps))

    def _thin(self) -> None:
        """Leave out every second keyframe of the older half; its loops go to the one before.

        Of two loops between the same keyframes, the newer one stays.
        """
        kept: list[_Keyframe] = []
        to: dict[int, _Keyframe] = {}
        for row, keyframe in enumerate(self._keyframes):
            if row % 2 and row < len(self._keyframes) // 2:
                after = self._keyframes[row + 1]
                after.T_last = keyframe.T_last @ after.T_last
                after.loose = max(after.loose, keyframe.loose)
                to[id(keyframe)] = kept[-1]
            else:
                kept.append(keyframe)
        loops: dict[tuple[int, int], tuple[_Keyframe, _Keyframe, Float64]] = {}
        for a, b, T in self._loops:
            new_a, new_b = to.get(id(a), a), to.get(id(b), b)
            T = invert_pose(new_a.T) @ a.T @ T @ invert_pose(b.T) @ new_b.T
            if new_a is not new_b:
                loops[id(new_a), id(new_b)] = new_a, new_b, T
        self._keyframes, self._loops = kept, list(loops.values())


def _grid(depth_m: Float32, intrinsics: Intrinsics) -> DepthGrid:
    stride = max(1, intrinsics.width // GRID_COLUMNS)
    first = stride // 2
    depth_mm = np.clip(1000.0 * depth_m[first::stride, first::stride], 0, 65535)
    return DepthGrid(np.nan_to_num(depth_mm).astype(np.uint16), stride, intrinsics)


def _is_far(T_a: Float64, T_b: Float64, most_m: float, most_deg: float) -> bool:
    T = invert_pose(T_a) @ T_b
    return bool(np.linalg.norm(T[:3, 3]) > most_m) or rotation_angle_deg(T[:3, :3]) > most_deg


def closings_in_words(closed: int, correction_m: float) -> str:
    """What to tell of the closed loops, and of how far the last one moved the camera."""
    if not closed:
        return "the trajectory is open: no place was seen again for sure"
    times = counted(closed, "time")
    return f"loop closed {times}, last correction {100 * correction_m:.1f} cm"


# --- Streams of frames whose poses come from odometry.

OnRefusal = Callable[[RefusedInput], None]


def track_poses(
    frames: Iterable[RgbdFrame],
    T_world_start: Float64 | None = None,
    on_lost: OnRefusal | None = None,
) -> Iterator[RgbdFrame]:
    """Replace the poses of frames by those of RGB-D odometry; lost frames are left out.

    Args:
        frames: their own poses are ignored. A frame that closes a loop brings the trajectory.
        T_world_start: (4, 4) pose of the first frame; None = level, at the origin.
        on_lost: called with the refusal of each lost frame.
    """
    odometry = LoopOdometry(T_world_start)
    for frame in frames:
        try:
            T, changed = odometry.track(frame.stamp_ns, frame.rgb, frame.depth_m, frame.intrinsics)
        except RefusedInput as refusal:
            if on_lost is not None:
                on_lost(refusal)
            continue
        yield replace(frame, T_world_camera=T, trajectory=changed)
