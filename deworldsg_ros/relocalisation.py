"""Come back tomorrow: a new graph waits apart until it is found in the map of an earlier run.

Candidates come from the constellation of the objects (`client.combine`). Each is fitted to the
surfaces that the views of both show, and verified by them: walls have to lie on walls, and neither
may be seen through. Then the map continues, with its ids and in its frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from deworldsg_ros.client.changes import Changes, changes_by_id
from deworldsg_ros.client.combine import Alignment, alignments
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import SceneObject
from deworldsg_ros.config import Config
from deworldsg_ros.graph.provenance import SeenSpace, TrailChange
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.poses.drift import moved
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import invert_pose, point_to_plane, rigid_motion, rotation_angle_deg
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence, Vocabulary

# --- The surfaces that the views of a run show, and how those of another run lie on them.

# One point of each cell of this size, and at most so many of a new run, evenly.
CELL_M, MOST_POINTS = 0.05, 4000
# Depth is used in this range. A pixel lies on an edge if a neighbour's depth differs by more.
NEAR_M, FAR_M, EDGE_M, EDGE_FRACTION = 0.2, 4.5, 0.03, 0.06
# Gauss-Newton steps onto planes, each with the distance that still counts; normals agree.
REACHES_M = (0.35, 0.3, 0.25, 0.2, 0.15, 0.1, 0.08, 0.06, 0.05, 0.05)
ALIKE = 0.7
# A point is on a surface within this distance. Floors are in every room: only points on sides
# count, whose normals are this far from up.
ON_M, SIDE = 0.1, 0.5
# A step from the objects to the surfaces larger than this leaves the constellation.
FARTHEST_M, FARTHEST_DEG = 0.5, 15.0

# What is certain: objects with so much evidence, and so much of the surfaces. Where less of the
# surfaces agree, as where much was moved, more evidence is needed: nats a share below `WELL`.
# In synthetic rooms of the same furniture (`bench.relocalisation`), of 800 runs in other rooms one
# had more than 8 nats and 0.65: 9.9 and 0.72.
LEAST_NATS, LEAST_AGREEMENT, WELL, NATS_PER_SHARE = 8.0, 0.7, 0.85, 40.0
# Points on sides of the new run that the map's views show as surface or as free, at least, and
# the lead over another transform: a room may look the same from two sides.
LEAST_POINTS, LEAST_KNOWN, LEAST_LEAD = 300, 0.4, 0.1
# The planes have to hold the fit in every direction: the least mean square of their normals along
# any. Along a lone wall, furniture that was moved together may fit at its new place.
LEAST_HELD = 0.08


@dataclass(frozen=True)
class Surfaces:
    """Points (n, 3) and normals (n, 3) of what views show, world frame."""

    points: Float64
    normals: Float64

    @classmethod
    def of(cls, space: SeenSpace) -> Surfaces:
        """Those of all views, one point a cell."""
        points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for depth_mm, _, camera, pose in space.views():
            at, sides = _oriented(0.001 * depth_mm.astype(np.float64), camera)
            points.append(at @ pose[:3, :3].T + pose[:3, 3])
            normals.append(sides @ pose[:3, :3].T)
        every, all_normals = np.concatenate(points), np.concatenate(normals)
        cells = np.floor(every / CELL_M).astype(np.int64)
        rows = np.sort(np.unique(cells, axis=0, return_index=True)[1])
        return cls(every[rows], all_normals[rows])

    def some(self) -> Surfaces:
        """At most `MOST_POINTS` of them, evenly."""
        count = len(self.points)
        rows = np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(int)
        return Surfaces(self.points[rows], self.normals[rows])

    def moved(self, T: Float64) -> Surfaces:
        """Those in another frame."""
        return Surfaces(self.points @ T[:3, :3].T + T[:3, 3], self.normals @ T[:3, :3].T)

    def sides(self, up: Float64) -> Surfaces:
        """Those that are no floor, ceiling or table top."""
        kept = np.abs(self.normals @ up) < SIDE
        return Surfaces(self.points[kept], self.normals[kept])


def _oriented(depth_m: Float64, camera: Float64) -> tuple[Float64, Float64]:
    """Points (n, 3) and unit normals (n, 3) of a depth grid that lie on no edge, camera frame."""
    fx, fy, cx, cy = camera
    rows, columns = np.mgrid[: depth_m.shape[0], : depth_m.shape[1]]
    # The centre of pixel c of the grid is at c + 1/2, as in `SeenSpace.look`.
    rays = np.stack([(columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy, np.ones(rows.shape)], -1)
    points = rays * depth_m[..., None]
    middle, around = depth_m[1:-1, 1:-1], np.s_[1:-1]
    kept = (middle > NEAR_M) & (middle < FAR_M)
    for beside in (
        depth_m[around, 2:], depth_m[around, :-2], depth_m[2:, around], depth_m[:-2, around],
    ):  # fmt: skip
        kept &= (beside > 0) & (np.abs(beside - middle) < EDGE_M + EDGE_FRACTION * middle)
    across = (points[around, 2:] - points[around, :-2])[kept]
    down = (points[2:, around] - points[:-2, around])[kept]
    normals = np.cross(down, across)
    lengths = np.linalg.norm(normals, axis=1)
    some = lengths > 0
    return points[around, around][kept][some], normals[some] / lengths[some, None]


@dataclass(frozen=True)
class Found:
    """How the world of a new run lies in a map.

    Attributes:
        T_map_world: (4, 4) rigid transform.
        matched: number of objects of the new run that lie on an object of the map.
        evidence_nats: of the objects; see `client.combine`.
        agreement: the least share, of both runs, of the points on sides that the other run's views
            show as surface and not as free.
    """

    T_map_world: Float64
    matched: int
    evidence_nats: float
    agreement: float

    @property
    def is_certain(self) -> bool:
        """Whether other rooms do not fit so well."""
        needed = LEAST_NATS + NATS_PER_SHARE * max(0.0, WELL - self.agreement)
        return self.agreement >= LEAST_AGREEMENT and self.evidence_nats >= needed


class Place:
    """A map, to find graphs of other runs in.

    Args:
        objects: of the map.
        space: what its views saw.

    Attributes:
        reason: why the last graph was not found, in words.
    """

    def __init__(self, objects: Sequence[SceneObject], space: SeenSpace) -> None:
        from scipy.spatial import cKDTree  # slow to import, and only for maps

        self._objects, self._space = list(objects), space
        self._up = np.array(objects[0].up) if objects else np.array([0.0, 0.0, 1.0])
        self._surfaces = Surfaces.of(space)
        self._tree = cKDTree(self._surfaces.points) if len(self._surfaces.points) else None
        self.reason = "nothing seen yet"

    def find(self, objects: Sequence[SceneObject], space: SeenSpace) -> Found | None:
        """How the world of other objects and views lies in the map; None unless it is certain."""
        candidates = alignments(self._objects, objects) if self._tree is not None else []
        candidates = [item for item in candidates if item.evidence_nats >= LEAST_NATS]
        if not candidates:
            self.reason = f"none of {len(objects)} objects in a constellation of the map"
            return None
        surfaces = Surfaces.of(space).some()
        found = [self._verified(item, surfaces, space) for item in candidates]
        likely = sorted((item for item in found if item), key=lambda item: -item.agreement)
        if not likely or not likely[0].is_certain:
            share = likely[0].agreement if likely else 0.0
            self.reason = (
                f"{candidates[0].matched} objects and {100 * share:.0f} % of the surfaces fit, "
                "which is not certain"
            )
            return None
        if len(likely) > 1 and likely[1].agreement > likely[0].agreement - LEAST_LEAD:
            self.reason = "two places of the map look like this one"
            return None
        return likely[0]

    def _verified(self, candidate: Alignment, surfaces: Surfaces, space: SeenSpace) -> Found | None:
        """A candidate, fitted to the surfaces; None if they do not hold it, or few are known."""
        T = self._fitted(candidate.T_a_b, surfaces)
        if T is None:
            return None
        sides = surfaces.moved(T).sides(self._up)
        free, occupied = self._space.look(sides.points)
        known = int((free | occupied).sum())
        if known < max(LEAST_POINTS, LEAST_KNOWN * len(sides.points)):
            return None
        own = self._surfaces.sides(self._up).some().moved(invert_pose(T))
        own_free, own_occupied = space.look(own.points)
        here = surfaces.moved(T)
        held = here.normals[self._on_planes(here)]
        if np.linalg.eigvalsh(held.T @ held / max(1, len(held)))[0] < LEAST_HELD:
            return None
        shares = (
            occupied.sum() / known,
            own_occupied.sum() / max(1, (own_free | own_occupied).sum()),
            self._on_planes(sides)[free | occupied].sum() / known,
        )
        return Found(T, candidate.matched, candidate.evidence_nats, float(min(shares)))

    def _on_planes(self, surfaces: Surfaces) -> Float64:
        """Whether (n,) each point lies near one of the map whose normal agrees."""
        assert self._tree is not None
        gaps_m, rows = self._tree.query(surfaces.points, distance_upper_bound=ON_M)
        near = np.isfinite(gaps_m)
        alike = (self._surfaces.normals[rows[near]] * surfaces.normals[near]).sum(axis=1) > ALIKE
        near[near] = alike
        return near

    def _fitted(self, T_start: Float64, surfaces: Surfaces) -> Float64 | None:
        """The transform that puts surfaces onto the map's: also tilts, as up may be an estimate.

        Gauss-Newton on point-to-plane distances; far points count less (Cauchy). None if too few
        are near, or the fit leaves the start.
        """
        assert self._tree is not None
        T = T_start
        for reach_m in REACHES_M:
            here = surfaces.moved(T)
            gaps_m, rows = self._tree.query(here.points, distance_upper_bound=reach_m + CELL_M)
            near = np.flatnonzero(np.isfinite(gaps_m))
            planes = self._surfaces.normals[rows[near]]
            alike = (planes * here.normals[near]).sum(axis=1) > ALIKE
            near, planes = near[alike], planes[alike]
            if len(near) < LEAST_POINTS:
                return None
            points = here.points[near]
            centre = points.mean(axis=0)
            distances = ((self._surfaces.points[rows[near]] - points) * planes).sum(axis=1)
            jacobian, weights = point_to_plane(points - centre, planes, distances, reach_m / 3)
            weights = weights * (np.abs(distances) < reach_m)
            # Directions that the planes leave open stay as they are.
            hessian = jacobian.T @ (weights[:, None] * jacobian) + 1e-3 * len(near) * np.eye(6)
            step = np.linalg.solve(hessian, jacobian.T @ (weights * distances))
            turn = rigid_motion(np.zeros(3), step[:3])
            turn[:3, 3] = centre + step[3:] - turn[:3, :3] @ centre
            T = turn @ T
        middle = surfaces.points.mean(axis=0)
        motion = T @ invert_pose(T_start)
        shift = motion[:3, :3] @ (T_start[:3, :3] @ middle + T_start[:3, 3]) + motion[:3, 3]
        shift -= T_start[:3, :3] @ middle + T_start[:3, 3]
        angle_deg = rotation_angle_deg(motion[:3, :3])
        is_near = np.linalg.norm(shift) <= FARTHEST_M and angle_deg <= FARTHEST_DEG
        return T if is_near else None


# --- A new graph that waits apart. When it is found, its frames are merged into the map's graph.

# Frames that are kept for that, evenly over the whole time: each costs some 10 ms then, and frames
# that come meanwhile wait.
MOST_FRAMES = 64
# The next look is after so many more views that differ (15 degrees or 25 cm), this share of all of
# them, or twice the frames: the cost of all looks is that of a few.
MORE_VIEWS, MORE_SHARE, MORE_FRAMES, FIRST_FRAMES = 3, 0.15, 2.0, 10
# An object is new where the map's views saw this share of its surface points as free.
LEAST_FREE = 0.3
# The frame of a graph that is found again: whatever frame the poses of a day come in, and wherever
# that begins, the graph keeps its own.
MAP_FRAME = "scene_map"


@dataclass
class _Kept:
    """A frame of the graph that waits, and the evidence that came for it."""

    local: LocalGraph
    evidence: list[RelationEvidence] = field(default_factory=list)


class Returning:
    """A map, and the frames of a new run until they are found in it.

    Args:
        config: of the new graph.
        map_builder: the graph of the map; it continues when the new one is found. None = there is
            no map yet, and the new graph begins one.

    Attributes:
        found: None while the new graph waits.
        refused: frames that the map's graph refused when it continued, by reason.
    """

    def __init__(self, config: Config, map_builder: GraphBuilder | None) -> None:
        self._config, self._map = config, map_builder
        self._before: dict[int, SceneObject] = {}
        if map_builder is not None:
            self._before = {item.id: item for item in SceneGraph(map_builder.full())}
            self._space = copy(map_builder.space)  # its arrays are replaced, and never changed
            self._place = Place(list(self._before.values()), self._space)
        self._kept: list[_Kept] = []
        self._every = 1
        self._frames = self._views = self._first_ns = 0
        self._next_views, self._next_frames = MORE_VIEWS, FIRST_FRAMES
        self._found_after_s = 0.0
        self.found: Found | None = None
        self.refused: Counter[str] = Counter()

    @property
    def waits(self) -> bool:
        """Whether the new graph is apart from the map."""
        return self._map is not None and self.found is None

    def begin(self, vocabulary: Vocabulary, frame_id: str) -> GraphBuilder:
        """The new graph. Its ids begin after those of the map: no id means two objects."""
        if self._map is not None:
            builder = GraphBuilder(self._config, vocabulary, frame_id)
            builder.graph.skip_to(self._map.graph.next_id)
            return builder
        builder = GraphBuilder(self._config, vocabulary, _map_frame(frame_id))
        builder.place(np.eye(4), frame_id)
        self.found = Found(np.eye(4), 0, 0.0, 1.0)
        return builder

    @property
    def status(self) -> str:
        """Where the new graph is, in words."""
        if self._map is None:
            return "there was no map: this run begins it"
        if self.found is None:
            return f"not yet: {self._place.reason}"
        x, y, z = self.found.T_map_world[:3, 3]
        turned = rotation_angle_deg(self.found.T_map_world[:3, :3])
        return (
            f"after {self._found_after_s:.1f} s, {self.found.matched} objects in common, "
            f"{100 * self.found.agreement:.0f} % of the surfaces; at {x:.2f} {y:.2f} {z:.2f}, "
            f"turned by {turned:.1f} degrees"
        )

    def note(self, builder: GraphBuilder, local: LocalGraph) -> GraphBuilder | None:
        """Note a frame that the new graph has merged.

        Returns:
            The map's graph with all of it, as soon as it is found: continue with that.
        """
        if not self._frames:
            self._first_ns = local.stamp_ns
        if self._frames % self._every == 0:
            self._kept.append(_Kept(local))
            if len(self._kept) > MOST_FRAMES:
                self._kept, self._every = self._kept[::2], 2 * self._every
        self._frames += 1
        newest_ns = builder.space.stamps_ns[-1:]
        self._views += bool(len(newest_ns)) and int(newest_ns[0]) == local.stamp_ns
        if self._views < self._next_views and self._frames < self._next_frames:
            return None
        self._next_views = self._views + max(MORE_VIEWS, int(MORE_SHARE * self._views))
        self._next_frames = int(MORE_FRAMES * self._frames)
        assert self._map is not None
        if builder.graph.vocabulary.predicates != self._map.graph.vocabulary.predicates:
            self._place.reason = "the map has other predicates"
            return None
        found = self._place.find(list(SceneGraph(builder.full())), builder.space)
        if found is None:
            return None
        # The new graph differs from its poses by their drift.
        T_map_world = found.T_map_world @ builder.T_graph_poses
        self.found = replace(found, T_map_world=T_map_world)
        self._found_after_s = (local.stamp_ns - self._first_ns) / 1e9
        return self._continued(builder, self.found)

    def note_evidence(self, evidence: RelationEvidence) -> None:
        """Note evidence that the new graph was given while it waits."""
        for kept in reversed(self._kept):
            if kept.local.stamp_ns == evidence.stamp_ns:
                kept.evidence.append(evidence)
                return

    def follow(self, change: TrailChange) -> None:
        """Move the kept frames: their poses were corrected."""
        stamps_ns = np.array([kept.local.stamp_ns for kept in self._kept], np.int64)
        for kept, T_new_old in zip(self._kept, change.at(stamps_ns, of_poses=True)):
            kept.local = moved(kept.local, T_new_old)

    def changes(self, graph: SceneGraph) -> Changes:
        """What has changed in the graph since the map was saved, as far as it was seen again.

        An object that the map does not have is new only where the map's views saw free space.
        """
        found = changes_by_id(self._before, {item.id: item for item in graph})
        return replace(found, added=tuple(item for item in found.added if self._was_free(item)))

    def _was_free(self, item: SceneObject) -> bool:
        if self._map is None or not len(item.surface_m):
            return False
        free, occupied = self._space.look(item.surface_m)
        return bool(free.sum() > max(occupied.sum(), LEAST_FREE * len(free)))

    def _continued(self, builder: GraphBuilder, found: Found) -> GraphBuilder:
        """The map's graph, in its frame, with the frames of the new one."""
        assert self._map is not None
        frame_id = builder.graph.frame_id
        self._map.graph.frame_id = _map_frame(frame_id)
        self._map.graph.skip_to(builder.graph.next_id)
        self._map.place(found.T_map_world, frame_id)
        for kept in self._kept:
            try:
                self._map.integrate(kept.local)
                for evidence in kept.evidence:
                    self._map.add_evidence(evidence)
            except RefusedInput as refusal:
                self.refused[refusal.reason] += 1
        self._kept = []
        return self._map


def _map_frame(frame_id: str) -> str:
    """The frame of the map beside a frame of poses, which may be one of several robots."""
    prefix, slash, _ = frame_id.rpartition("/")
    return f"{prefix}{slash}{MAP_FRAME}"
