"""Where the graph comes from: the poses and frames of what was seen, and the space."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.array_file import read_arrays, write_arrays
from deworldsg_ros.base.files import parse_json, read_regular, write_atomically
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt8, UInt16
from deworldsg_ros.scene.camera import (
    interpolate_poses,
    invert_pose,
    invert_poses,
    nearest_rotations,
)
from deworldsg_ros.scene.checks import checked, holds, within
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.limits import MAX_INT

# --- Which space the camera has seen as free: some depth images of the run, asked for single
# points.
#
# No map of cells is kept. The depth grids of a bounded number of different views are, and a
# question projects its points into them. So a frame costs nothing, unless it is such a view.

# Views that are kept, the newest: 3 MB of 80 x 60 pixels each.
MAX_VIEWS = 128
# A view differs from another one if the camera has moved so far, or turned so far.
MOVED_M, TURNED_RAD = 0.25, math.radians(15.0)
LEAST_TRACE = 1.0 + 2.0 * math.cos(TURNED_RAD)
# A point is free if the image shows something at least so far behind it, and occupied if it shows
# something as near to it. Noise of depth cameras and poses is below this.
NEAR_M, NEAR_FRACTION = 0.08, 0.03
# Depth cameras measure nothing nearer than this.
MIN_DEPTH_M = 0.1

# Depth image (h, w), colours (h, w, 3), camera (4,) and T_world_camera (4, 4).
View = tuple[UInt16, UInt8, Float64, Float64]
_NAMES = ("view_depths_mm", "view_poses", "view_cameras", "view_stamps_ns")
_COLOURS = "view_colours"  # not in files of older releases
# Of a view without colours.
GREY = 160


class SeenSpace:
    """Depth grids of different views (k views of h x w pixels).

    Attributes:
        depths_mm: (k, h, w) uint16, 0 = invalid.
        poses: (k, 4, 4), T_world_camera.
        cameras: (k, 4), fx, fy, cx, cy in pixels of the grid.
        stamps_ns: (k,).
        colours: (k, h, w, 3) uint8 RGB of the same pixels; `GREY` where the frames had none.
    """

    def __init__(self) -> None:
        self.depths_mm: UInt16 = np.zeros((0, 0, 0), np.uint16)
        self.poses: Float64 = np.zeros((0, 4, 4))
        self.cameras: Float64 = np.zeros((0, 4))
        self.stamps_ns: Int64 = np.zeros(0, np.int64)
        self.colours: UInt8 = np.zeros((0, 0, 0, 3), np.uint8)

    def __len__(self) -> int:
        return len(self.poses)

    def note(self, local: LocalGraph) -> bool:
        """Keep the depth grid of a frame, if no view so far is like it; returns whether it did."""
        grid, pose = local.depth_grid, local.T_world_camera
        if grid is None or self._has(pose):
            return False
        if grid.depth_mm.shape != self.depths_mm.shape[1:]:  # of another camera
            self.__init__()  # type: ignore[misc]
            self.depths_mm = self.depths_mm.reshape(0, *grid.depth_mm.shape)
            self.colours = self.colours.reshape(0, *grid.depth_mm.shape, 3)
        camera, per_px = grid.intrinsics, 1.0 / grid.stride_px
        values = per_px * np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        kept = slice(-MAX_VIEWS + 1, None)
        self.depths_mm = np.concatenate([self.depths_mm[kept], grid.depth_mm[None]])
        self.poses = np.concatenate([self.poses[kept], pose[None]])
        self.cameras = np.concatenate([self.cameras[kept], values[None]])
        self.stamps_ns = np.append(self.stamps_ns[kept], local.stamp_ns)
        grey = np.full((*grid.depth_mm.shape, 3), GREY, np.uint8)
        rgb = grey if grid.rgb is None else grid.rgb
        self.colours = np.concatenate([self.colours[kept], rgb[None]])
        return True

    def look(self, points_world: Float64) -> tuple[Bool, Bool]:
        """Whether each point (n, 3) was seen as free, and as occupied; neither = not seen.

        Of views that disagree, the majority counts.
        """
        free = np.zeros(len(points_world), np.int64)
        occupied = np.zeros(len(points_world), np.int64)
        for depth_mm, _, camera, pose in self.views():
            at, is_free, is_occupied = seen_in(points_world, depth_mm, camera, pose)
            free[at] += is_free
            occupied[at] += is_occupied
        return free > occupied, (occupied > 0) & (occupied >= free)

    def views(self) -> Iterator[View]:
        """The images of each view and where it was, the oldest first."""
        return zip(self.depths_mm, self.colours, self.cameras, self.poses)

    def move(self, change: TrailChange) -> None:
        """Move the views with the poses that they were seen from."""
        # A copy of this object keeps the arrays of its moment.
        self.poses = change.at(self.stamps_ns) @ self.poses

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Copies by name, for `restore`; empty without views."""
        values = (self.depths_mm, self.poses, self.cameras, self.stamps_ns, self.colours)
        named = zip((*_NAMES, _COLOURS), values)
        return {name: np.array(value) for name, value in named} if len(self) else {}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Continue with the `arrays` of an earlier run; ValueError if they are none."""
        if _NAMES[0] not in arrays:
            return
        depths_mm = checked(arrays, _NAMES[0], np.uint16, None, None, None)
        count = len(depths_mm)
        holds(_NAMES[0], count <= MAX_VIEWS, f"at most {MAX_VIEWS} views")
        poses = checked(arrays, _NAMES[1], np.float64, count, 4, 4)
        cameras = checked(arrays, _NAMES[2], np.float64, count, 4)
        stamps_ns = checked(arrays, _NAMES[3], np.int64, count)
        colours = np.full((*depths_mm.shape, 3), GREY, np.uint8)
        if _COLOURS in arrays:
            colours = checked(arrays, _COLOURS, np.uint8, *depths_mm.shape, 3)
        within(_NAMES[1], poses, -1e8, 1e8)
        within(_NAMES[2], cameras, -1e6, 1e6)
        self.depths_mm, self.poses, self.cameras = depths_mm, poses, cameras
        self.stamps_ns, self.colours = stamps_ns, colours

    def _has(self, pose: Float64) -> bool:
        """Whether a pose (4, 4) differs little from that of a view."""
        # The trace of the rotation between both is 1 + 2 cos(angle).
        traces = self.poses[:, :3, :3].reshape(-1, 9) @ pose[:3, :3].ravel()
        steps_m = self.poses[traces >= LEAST_TRACE, :3, 3] - pose[:3, 3]
        return bool(((steps_m**2).sum(axis=1) < MOVED_M**2).any())


def seen_in(
    points_world: Float32 | Float64, depth_mm: UInt16, camera: Float64, T_world_camera: Float64
) -> tuple[Int64, Bool, Bool]:
    """What a view tells about points (n, 3).

    Args:
        points_world: metres.
        depth_mm: (h, w) uint16, 0 = invalid.
        camera: (4,) fx, fy, cx, cy in pixels of this image.
        T_world_camera: (4, 4).

    Returns:
        The rows (m,) of the points inside the image; whether each was seen as free, because the
        image shows something behind it, and as occupied.
    """
    fx, fy, cx, cy = camera
    T = invert_pose(T_world_camera)
    x, y, z = (points_world @ T[:3, :3].T + T[:3, 3]).T
    ahead = np.maximum(z, MIN_DEPTH_M)
    columns, rows = np.floor(fx * x / ahead + cx), np.floor(fy * y / ahead + cy)
    height, width = depth_mm.shape
    inside = (z > MIN_DEPTH_M) & (columns >= 0) & (columns < width)
    inside &= (rows >= 0) & (rows < height)
    at = np.flatnonzero(inside)
    measured = 0.001 * depth_mm[rows[at].astype(int), columns[at].astype(int)]
    behind, near = measured - z[at], NEAR_M + NEAR_FRACTION * z[at]
    return at, (measured > 0) & (behind > near), (measured > 0) & (np.abs(behind) <= near)


def space_path(graph_path: Path) -> Path:
    """The file with the seen space of a saved graph: ``scene_graph.space.npz``."""
    return graph_path.with_name(f"{graph_path.stem}.space.npz")


def write_space(graph_path: Path, space: SeenSpace) -> None:
    """Write the file beside a saved graph; also without views, to replace an older one."""
    write_arrays(space_path(graph_path), space.arrays())


def read_space(graph_path: Path) -> SeenSpace | None:
    """The space beside a saved graph; None if there is no such file."""
    space = SeenSpace()
    try:
        space.restore(read_arrays(space_path(graph_path)))
    except (OSError, ValueError, MemoryError):
        return None
    return space if len(space) else None


# --- The poses that the frames came with, and how they change when SLAM corrects its trajectory.
#
# Frames near one another in place and time share a keyframe. A surface point knows the number of
# its keyframe (`NodeTable`), so that it can move with the pose that it was seen from.

# A keyframe begins when the camera has moved or turned so far (see MOVED_M), or after this time.
KEYFRAME_NS = 10**9
# Points name their keyframe in 16 bits. Of more keyframes, or more frames, every second one stays.
MAX_KEYFRAMES, MAX_TRAIL = (1 << 16) - 1, 1 << 15
# Poses are compared by where they put the camera, and places so far before and beside it.
MARK_M = 2.5
# A trajectory has changed if it puts one of these so far from where it was: noise of SLAM is less.
CHANGED_M = 0.03
# From this size on, poses that jump from the old trajectory to the new one can be told from motion.
JUMP_M = 0.1
# Poses of a trajectory are used that are so near to a frame: others lie in a gap of the frames.
NEAR_FRAME_NS = 5 * 10**8
# What was seen so long before the first pose of a trajectory moves with that pose.
BEFORE_NS = 10**10
# Poses that were on their way when the trajectory changed arrive within this time.
ON_THE_WAY_NS = 2 * 10**9
# Poses of a body agree on where the camera is mounted within this distance, so many of them.
MOUNTED_M, MOUNTING_POSES = 0.05, 8
# A loop closes where the camera has been before: so near, and by a way so many times longer than
# the jump of the pose.
LOOP_NEAR_M, LOOP_WAY = 5.0, 4.0
# Before the names of the arrays of a trail.
_TRAIL = "trail."


class TrailChange(NamedTuple):
    """How what was seen from each keyframe moves.

    Attributes:
        starts_ns: (k,) stamp of the first frame of each keyframe, ascending.
        T_new_old: (k + 1, 4, 4) by the number of the keyframe, from 1; that of 0 is the identity.
        T_poses: (k + 1, 4, 4), the same of the poses as they came, which drift has not moved.
    """

    starts_ns: Int64
    T_new_old: Float64
    T_poses: Float64

    @property
    def moved(self) -> Bool:
        """Whether (k + 1,) what was seen from each keyframe moves."""
        return np.asarray((self.T_new_old != np.eye(4)).any(axis=(1, 2)))

    def at(self, stamps_ns: Int64, of_poses: bool = False) -> Float64:
        """The transforms (n, 4, 4) of what was seen at n stamps, or of the poses as they came."""
        T = self.T_poses if of_poses else self.T_new_old
        return T[self.starts_ns.searchsorted(stamps_ns, "right")]


class Trail:
    """The poses of the frames, and the keyframes among them.

    Attributes:
        keyframe: number of the present keyframe; 0 before the first frame.
        is_changing: whether poses of the trajectory before the last change may still come.
        T_body_camera: (4, 4) how a trajectory's body carries the camera; None = to be learned.
    """

    def __init__(self) -> None:
        # Of the frames: stamps and poses as they came. Of the keyframes: the stamp of the first
        # frame, and what the correction of drift has done to the poses, a mean.
        self._stamps_ns: Int64 = np.zeros(0, np.int64)
        self._poses: Float64 = np.zeros((0, 4, 4))
        self._count = 0
        self.keyframe, self.is_changing = 0, False
        self._starts_ns: list[int] = []
        self._T_graph_poses: list[Float64] = []
        self._starts_anew, self._start, self._frames = True, np.eye(4), 0
        self.T_body_camera: Float64 | None = None
        # Of poses on their way: the change, until when they come, and the last pose before.
        self._coming = np.eye(4), 0, np.eye(4)
        self._T_graph_world, self._placed_ns = np.eye(4), -1

    def place(self, T_graph_world: Float64) -> None:
        """Take frames and corrections from now on in a world that lies so (4, 4) in the graph's."""
        self._T_graph_world = T_graph_world
        self._placed_ns = int(self._stamps_ns[self._count - 1]) if self._count else -1

    @property
    def camera_world(self) -> Float64:
        """Where (3,) the camera was in the newest frame; the origin before the first."""
        return self._poses[self._count - 1, :3, 3] if self._count else np.zeros(3)

    def admit(self, stamp_ns: int, T_world_camera: Float64) -> Float64 | None:
        """How to move a frame whose pose was on its way when the trajectory changed; None = not."""
        T_new_old, until_ns, last = self._coming
        marks = _marks(T_world_camera)
        from_old, from_new = (np.abs(marks - _marks(T)).max() for T in (last, T_new_old @ last))
        if not self.is_changing or stamp_ns > until_ns or from_old >= from_new:
            self.is_changing = False
            return None
        self._coming = T_new_old, until_ns, T_world_camera
        return T_new_old

    def note(self, stamp_ns: int, T_world_camera: Float64, T_graph_camera: Float64) -> bool:
        """Add a frame; returns whether only half of the keyframes stayed.

        Then what had number n has (n + 1) // 2.

        Args:
            stamp_ns: of the frame.
            T_world_camera: (4, 4) pose as it came.
            T_graph_camera: (4, 4) pose under which the graph takes it in: the correction of drift
                changes it. For a keyframe, the mean change of its frames counts.
        """
        last = self._count - 1
        if last >= 0 and stamp_ns <= self._stamps_ns[last]:  # the clock was set back
            self._starts_ns = [min(stamp_ns - 1, start) for start in self._starts_ns]
            self._count, self._starts_anew, self.is_changing = 0, True, False
            self._placed_ns = -1
        if self._count >= MAX_TRAIL:
            self._count //= 2
            for values in (self._stamps_ns, self._poses):
                values[: self._count] = values[1 : 2 * self._count : 2].copy()
        if self._count == len(self._stamps_ns):
            more = max(64, self._count)
            self._stamps_ns = np.append(self._stamps_ns, np.zeros(more, np.int64))
            self._poses = np.concatenate((self._poses, np.zeros((more, 4, 4))))
        self._stamps_ns[self._count], self._poses[self._count] = stamp_ns, T_world_camera
        self._count += 1
        halved = False
        if self._starts_anew or self._is_new(stamp_ns, T_world_camera):
            halved = len(self._starts_ns) == MAX_KEYFRAMES
            if halved:
                self._starts_ns = self._starts_ns[::2]
                self._T_graph_poses = self._T_graph_poses[::2]
            self._starts_ns.append(stamp_ns)
            self._T_graph_poses.append(np.eye(4))
            self._frames = 0
            self._starts_anew, self._start = False, T_world_camera
            self.keyframe = len(self._starts_ns)
        self._frames += 1
        change = np.eye(4)
        change[:3, :3] = T_graph_camera[:3, :3] @ T_world_camera[:3, :3].T
        change[:3, 3] = T_graph_camera[:3, 3] - change[:3, :3] @ T_world_camera[:3, 3]
        mean = self._T_graph_poses[-1]
        self._T_graph_poses[-1] = mean + (change - mean) / self._frames
        return halved

    def _is_new(self, stamp_ns: int, pose: Float64) -> bool:
        """Whether a frame is far from the one that the keyframe began with."""
        apart = _marks(pose)[0] - _marks(self._start)[0]
        turn = np.vdot(pose[:3, :3], self._start[:3, :3])
        is_late = stamp_ns - self._starts_ns[-1] >= KEYFRAME_NS
        return bool(is_late or turn < LEAST_TRACE or apart @ apart >= MOVED_M**2)

    def since(self, T_new_old: Float64, since_ns: int) -> TrailChange:
        """The change by one rigid transform (4, 4) of all poses since a stamp."""
        stamps_ns = self._stamps_ns[: self._count]
        T_new_old = self._T_graph_world @ T_new_old @ invert_pose(self._T_graph_world)
        T = np.where((stamps_ns >= since_ns)[:, None, None], T_new_old, np.eye(4))
        return self._change(T, since_ns)

    def follow(self, stamps_ns: Int64, T_world_body: Float64) -> TrailChange | None:
        """The change to a corrected trajectory; None if it is none, or not of these frames.

        Args:
            stamps_ns: (m,) ascending.
            T_world_body: (m, 4, 4) poses at these, of the camera or of a body that it is fixed to.
                Where it is fixed is learned from trajectories before a change, or from the first
                poses. Of another body than the camera, MOUNTING_POSES are needed.
        """
        frames = self._stamps_ns[: self._count]
        if not len(frames):
            return None
        after = np.minimum(frames.searchsorted(stamps_ns), len(frames) - 1)
        nearest = np.abs(frames[[np.maximum(after - 1, 0), after]] - stamps_ns).min(axis=0)
        near = nearest <= NEAR_FRAME_NS
        if not near.any():
            return None
        stamps_ns, bodies = stamps_ns[near], self._T_graph_world @ T_world_body[near]
        given = interpolate_poses(frames, self._poses[: self._count], stamps_ns)
        if self.T_body_camera is None:
            self.T_body_camera = _mounting(bodies, given)
        if self.T_body_camera is None:
            return None
        new = bodies @ self.T_body_camera
        if np.linalg.norm(_marks(new) - _marks(given), axis=-1).max() < CHANGED_M:
            known = _mounting(bodies, given)  # more poses tell more exactly
            self.T_body_camera = self.T_body_camera if known is None else known
            return None
        knots = self._knots(stamps_ns, new @ invert_poses(given))
        T = interpolate_poses(*knots, frames)
        if (T[-1] != np.eye(4)).any():
            self._expect(T[-1], int(frames[-1]) + ON_THE_WAY_NS)
        return self._change(T, int(stamps_ns[0]) - BEFORE_NS)

    def jump(self, T_new_old: Float64, at_ns: int) -> TrailChange | None:
        """The change if SLAM says only how it moved (4, 4) the pose of a stamp, when a loop closed.

        The error is assumed to have grown evenly on the way since the camera was last so near to
        where it is now, or since the beginning: the rotation by the way, then the rest of the
        translation [O. Dubbelman and B. Browning, "COP-SLAM", IEEE T-RO 31(5), 2015].
        """
        frames = self._stamps_ns[: self._count]
        first, before = frames.searchsorted([self._placed_ns + 1, at_ns]).tolist()
        if before <= first:
            return None
        T_new_old = self._T_graph_world @ T_new_old @ invert_pose(self._T_graph_world)
        places = self._poses[first:before, :3, 3]
        steps = np.diff(places, axis=0)
        way = np.append(0.0, np.cumsum(np.linalg.norm(steps, axis=1)))
        target = T_new_old[:3, :3] @ places[-1] + T_new_old[:3, 3]
        if self._size_m(T_new_old) < JUMP_M:
            return None
        apart = np.linalg.norm(places - target, axis=1)
        apart[way[-1] - way < LOOP_WAY * np.linalg.norm(target - places[-1])] = np.inf
        start = int(apart.argmin()) if apart.min() < LOOP_NEAR_M else 0
        part = np.clip((way - way[start]) / max(way[-1] - way[start], 1e-9), 0.0, 1.0)
        part[-1] = 1.0
        T = np.broadcast_to(np.eye(4), (self._count, 4, 4)).copy()
        turns = nearest_rotations(np.eye(3) + part[:, None, None] * (T_new_old[:3, :3] - np.eye(3)))
        turned = (turns[:-1] @ steps[:, :, None])[:, :, 0]
        moved = places[0] + np.concatenate((np.zeros((1, 3)), np.cumsum(turned, axis=0)))
        moved += part[:, None] * (target - moved[-1])
        T[first:before, :3, :3] = turns
        T[first:before, :3, 3] = moved - (turns @ places[:, :, None])[:, :, 0]
        self._expect(T_new_old, at_ns - 1)
        return self._change(T, int(frames[first + start]))

    def _expect(self, T_new_old: Float64, until_ns: int) -> None:
        """Expect poses of the old trajectory, if they can be told from those of the new one."""
        last = self._poses[self._count - 1].copy()
        self._coming = T_new_old, until_ns, last
        self.is_changing = self._size_m(T_new_old) > JUMP_M

    def _size_m(self, T_new_old: Float64) -> float:
        """How far a transform (4, 4) moves what the newest frame sees."""
        last = self._poses[self._count - 1]
        return float(np.abs(_marks(T_new_old @ last) - _marks(last)).max())

    def _knots(self, stamps_ns: Int64, T: Float64) -> tuple[Int64, Float64]:
        """Stamps and transforms (m, 4, 4) between which the change is even.

        Where the frames themselves jump from the old trajectory to the new, a knot on either side.
        """
        frames, poses = self._stamps_ns[: self._count], self._poses[: self._count]
        nexts = np.append(T[1:], np.eye(4)[None], axis=0)
        marks = _marks(interpolate_poses(frames, poses, stamps_ns))
        sizes = np.abs(_moved(nexts, marks) - _moved(T, marks)).max(axis=(1, 2))
        first = np.maximum(frames.searchsorted(stamps_ns, "right") - 1, 0)
        last = np.append(first[1:] + 1, len(frames) - 1)
        more_ns, more = [stamps_ns], [T]
        for row in np.flatnonzero(sizes > JUMP_M).tolist():
            # A step across the jump is shorter under the change, those beside it are not. If the
            # change grows evenly, all are alike.
            start, end = max(first[row] - 1, 0), last[row] + 2
            near = _marks(poses[start:end])
            plain = np.abs(np.diff(near, axis=0)).max(axis=(1, 2))
            across = np.abs(_moved(nexts[row], near[1:]) - _moved(T[row], near[:-1]))
            gain = np.pad(plain - across.max(axis=(1, 2)), 1, constant_values=-np.inf)
            above = gain[1:-1] - np.maximum(gain[:-2], gain[2:])
            inside = above[first[row] - start : last[row] - start]
            if len(above) < 2 or not len(inside) or inside.max() < 0.5 * sizes[row]:
                continue
            at = first[row] + int(inside.argmax())
            more_ns.append(frames[at : at + 2])
            more.append(np.stack([T[row], nexts[row]]))
        every_ns, every = np.concatenate(more_ns), np.concatenate(more)
        order = np.argsort(every_ns, kind="stable")
        return every_ns[order], every[order]

    def _change(self, T_new_old: Float64, since_ns: int) -> TrailChange:
        """Move the poses of the frames by T (n, 4, 4), where they are later than a stamp."""
        frames, starts = self._stamps_ns[: self._count], np.array(self._starts_ns, np.int64)
        T_new_old = np.where((frames >= since_ns)[:, None, None], T_new_old, np.eye(4))
        self._poses[: self._count] = T_new_old @ self._poses[: self._count]
        of = np.clip(frames.searchsorted(starts, "right") - 1, 0, None)
        by_number, of_poses = np.tile(np.eye(4), (2, len(starts) + 1, 1, 1))
        own = np.flatnonzero((starts >= since_ns) & (starts >= frames[:1]))
        if len(own):
            counts = np.maximum(np.diff(of, append=len(frames)), 1)[:, None, None]
            means = (np.add.reduceat(T_new_old, of, axis=0) / counts)[own]
            drifts = np.array([self._T_graph_poses[number] for number in own.tolist()])
            for T in (means, drifts):  # of the keyframe's frames; drifts have moved them already
                T[:, :3, :3] = nearest_rotations(T[:, :3, :3])
            of_poses[own + 1], by_number[own + 1] = means, means @ invert_poses(drifts)
            self._T_graph_poses[own[0] :] = [np.eye(4)] * len(own)  # all from the first on
        self._starts_anew = True
        return TrailChange(starts, by_number, of_poses)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Copies by name, for `restore`: the keyframes, and the frames that they began with."""
        starts = np.array(self._starts_ns, np.int64)
        frames = self._stamps_ns[: self._count]
        if not len(starts):
            return {}
        poses = np.broadcast_to(np.eye(4), (len(starts), 4, 4))
        if len(frames):
            poses = self._poses[np.clip(frames.searchsorted(starts, "right") - 1, 0, None)]
        drifts = np.array(self._T_graph_poses).reshape(-1, 4, 4)
        values = {"starts_ns": starts, "poses": poses, "T_graph_poses": drifts}
        return {_TRAIL + name: np.array(value) for name, value in values.items()}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Continue with the `arrays` of an earlier run; ValueError if they are none."""
        if not len(arrays.get(_TRAIL + "starts_ns", ())):  # older releases have none
            return
        starts = checked(arrays, _TRAIL + "starts_ns", np.int64, None)
        count = len(starts)
        holds(_TRAIL + "starts_ns", count <= MAX_KEYFRAMES, f"at most {MAX_KEYFRAMES}")
        holds(_TRAIL + "starts_ns", (np.diff(starts) >= 0).all(), "ascending stamps")
        poses, drifts = (
            checked(arrays, _TRAIL + name, np.float64, count, 4, 4)
            for name in ("poses", "T_graph_poses")
        )
        for name, values in (("poses", poses), ("T_graph_poses", drifts)):
            within(_TRAIL + name, values, -1e8, 1e8)
        self._starts_ns, self._T_graph_poses = starts.tolist(), list(drifts)
        self._stamps_ns, self._poses, self._count = starts.copy(), poses.copy(), count
        self.keyframe, self._starts_anew = count, False
        self._start = poses[-1]


def _marks(poses: Float64) -> Float64:
    """Places (..., 3, 3), one a row, by which poses (..., 4, 4) of a camera are compared."""
    camera = poses[..., None, :3, 3]
    ahead = camera + MARK_M * poses[..., None, :3, 2]
    beside = camera + MARK_M * poses[..., None, :3, 0]
    return np.concatenate((camera, ahead, beside), axis=-2)


def _moved(T: Float64, marks: Float64) -> Float64:
    """Places (..., 3, 3) after transforms (..., 4, 4)."""
    return np.asarray(marks @ T[..., :3, :3].swapaxes(-1, -2) + T[..., None, :3, 3])


def _mounting(bodies: Float64, cameras: Float64) -> Float64 | None:
    """Where a camera is fixed to a body (4, 4), of poses (m, 4, 4) of both.

    The mean of the first poses, as long as they agree. The identity, if that is what they say; None
    if they are too few for another one.
    """
    T = invert_poses(bodies) @ cameras
    apart = np.linalg.norm(_marks(T) - _marks(T[0]), axis=-1).max(axis=-1)
    count = int(np.append(apart > MOUNTED_M, True).argmax())
    mean = T[:count].mean(axis=0)
    mean[:3, :3] = nearest_rotations(mean[None, :3, :3])[0]
    if np.abs(_marks(mean) - _marks(np.eye(4))).max() < MOUNTED_M:
        return np.eye(4)
    return mean if count >= MOUNTING_POSES else None


# --- Which frames an object or a relation comes from: the first, the last, and the clearest few.
#
# They are not in the messages. A saved graph has them in a second file beside it.

# Clearest frames that are kept of a node, and of a directed pair of nodes.
CLEAREST = 3
# Entries of removed nodes are dropped after so many frames.
PRUNE_FRAMES = 256
# A fainter vote for a relation is not noted.
MIN_VOTE = 0.05
# Decimals of how clear a frame is. What exceeds a number by less is rounded to it, or below it.
DECIMALS, _ROUNDED_OFF = 3, 0.0004
# 10^5 nodes and their pairs have 100 MB.
MAX_BYTES = 1 << 30

Stamp = Annotated[int, msgspec.Meta(ge=-MAX_INT, le=MAX_INT)]
Key = tuple[int, int]


class SeenFrame(msgspec.Struct, frozen=True, array_like=True, order=True):
    """Evidence of one frame: how clear (0 to 1), when, and which class or predicate."""

    strength: Annotated[float, msgspec.Meta(ge=0.0, le=1.0 + 1e-9)]
    stamp_ns: Stamp
    name: str


class SeenFrames(msgspec.Struct, array_like=True):
    """The frames of a node, or of a directed pair (subject, object).

    Attributes:
        node, other: ids; other is 0 for a node.
        first_ns, last_ns: stamps of the first and the last frame.
        clearest: the clearest frames, the clearest first.
    """

    node: Annotated[int, msgspec.Meta(ge=1, le=MAX_INT)]
    other: Annotated[int, msgspec.Meta(ge=0, le=MAX_INT)]
    first_ns: Stamp
    last_ns: Stamp
    clearest: Annotated[list[SeenFrame], msgspec.Meta(max_length=CLEAREST)]


class SeenFramesFile(msgspec.Struct):
    """All frames of a graph; the stamp is that of the graph that they belong to."""

    stamp_ns: Stamp
    seen: list[SeenFrames]


class FrameMemory:
    """Notes the frames of all nodes and pairs of a graph.

    Args:
        seen: of an earlier run.
    """

    def __init__(self, seen: Sequence[SeenFrames] = ()) -> None:
        self._seen: dict[Key, SeenFrames] = {(item.node, item.other): item for item in seen}
        self._frames = 0

    def note(
        self, graph: GlobalGraph, local: LocalGraph, node_ids: Sequence[int], votes: Float64
    ) -> None:
        """Note a merged frame, the node of each of its rows, and its `frame_votes`."""
        names, stamp_ns = graph.vocabulary, local.stamp_ns
        classes = local.class_probabilities
        strengths = (local.scores * classes.max(axis=1, initial=0.0)).tolist()
        for node_id, label, strength in zip(node_ids, _best(classes), strengths):
            if node_id:  # 0 = this frame removed it
                self._add((node_id, 0), strength, stamp_ns, names.classes[label])
        pairs, values = local.relations.pairs.tolist(), votes.max(axis=1, initial=0.0).tolist()
        for (subject, object_), label, vote in zip(pairs, _best(votes), values):
            pair = node_ids[subject], node_ids[object_]
            if vote >= MIN_VOTE and 0 not in pair and pair[0] != pair[1]:
                self._add(pair, vote, stamp_ns, names.predicates[label])
        self._frames += 1
        if self._frames % PRUNE_FRAMES == 0:
            self._follow(graph)

    def all(self, graph: GlobalGraph) -> list[SeenFrames]:
        """The frames of the live nodes and their pairs, by ids."""
        self._follow(graph)
        return [self._seen[key] for key in sorted(self._seen)]

    def copy(self, node_id: int, new_id: int) -> None:
        """Give a node the frames of another one that was edited."""
        seen = self._seen.get((node_id, 0))
        for frame in () if seen is None else seen.clearest:
            self._add((new_id, 0), frame.strength, frame.stamp_ns, frame.name)

    def _add(self, key: Key, strength: float, stamp_ns: int, name: str) -> None:
        seen = self._seen.get(key)
        if seen is None:
            seen = self._seen[key] = SeenFrames(*key, stamp_ns, stamp_ns, [])
        if stamp_ns < seen.first_ns:
            seen.first_ns = stamp_ns
        if stamp_ns > seen.last_ns:
            seen.last_ns = stamp_ns
        clearest = seen.clearest
        # Most frames are not among the clearest; to round takes longer than this.
        if len(clearest) == CLEAREST and strength <= clearest[-1].strength + _ROUNDED_OFF:
            return
        strength = round(strength, DECIMALS)
        if len(clearest) < CLEAREST or strength > clearest[-1].strength:
            _insert(seen, SeenFrame(strength, stamp_ns, name))

    def _follow(self, graph: GlobalGraph) -> None:
        """Follow merges, and forget removed nodes."""
        known, self._seen = self._seen, {}
        for (node_id, other_id), seen in known.items():
            key = graph.resolve(node_id), graph.resolve(other_id) if other_id else 0
            if not key[0] or (other_id and not key[1]) or key[0] == key[1]:
                continue
            present = self._seen.get(key)
            if present is None:
                seen.node, seen.other = key
                self._seen[key] = seen
                continue
            present.first_ns = min(present.first_ns, seen.first_ns)
            present.last_ns = max(present.last_ns, seen.last_ns)
            for frame in seen.clearest:
                _insert(present, frame)


def _insert(seen: SeenFrames, frame: SeenFrame) -> None:
    """Keep a frame if it is one of the clearest; of equally clear ones, the earlier."""
    frames = sorted([*seen.clearest, frame], key=lambda item: (-item.strength, item.stamp_ns))
    seen.clearest = frames[:CLEAREST]


def _best(rows: Float64) -> list[int]:
    """Index of the largest value of each row."""
    return rows.argmax(axis=1).tolist() if rows.size else []


def path_beside(graph_path: Path) -> Path:
    """The file with the frames of a saved graph: ``scene_graph.frames.json``."""
    return graph_path.with_name(f"{graph_path.stem}.frames.json")


def write_seen(graph_path: Path, stamp_ns: int, seen: Sequence[SeenFrames]) -> None:
    """Write the file beside a saved graph. Raises OSError."""
    content = msgspec.json.encode(SeenFramesFile(stamp_ns, list(seen)))
    write_atomically(path_beside(graph_path), content)


def read_seen(graph_path: Path, stamp_ns: int) -> list[SeenFrames]:
    """The frames beside a saved graph; none if there is no such file of this graph."""
    try:
        content = read_regular(path_beside(graph_path), MAX_BYTES)
        found = parse_json(content, SeenFramesFile)
    except (OSError, ValueError):
        return []
    return found.seen if found.stamp_ns == stamp_ns else []
