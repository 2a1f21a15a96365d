"""Where the graph comes from: the frames of each node and edge, and the space that was seen."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.base.array_file import read_arrays, write_arrays
from deworldsg_ros.base.files import parse_json, read_regular, write_atomically
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt8, UInt16
from deworldsg_ros.scene.camera import invert_pose
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

    def move(self, T_correction: Float64, since_ns: int) -> None:
        """Apply a pose-graph correction (4, 4) to the views since a stamp."""
        since = self.stamps_ns >= since_ns
        self.poses = self.poses.copy()  # a copy of this object keeps the arrays of its moment
        self.poses[since] = T_correction @ self.poses[since]

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
