"""Alignment of frames with the graph before merging, for poses that drift.

Point-to-plane registration of the surface points of a frame with those of the nodes. Beyond the
paper; option `merging.align_poses`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from deworldsg_ros.kernels import kernel
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.gaussian import transform
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.rigid import point_to_plane

# Number of points of a frame, and of each node, that are compared; both are uniform samples.
FRAME_POINTS = 500
NODE_POINTS = 128
# With fewer points near a plane of a node, the pose is not corrected.
MIN_MATCHES = 100
# The planes of a node are computed again when its observations have grown by this factor.
UPDATE_FACTOR = 1.5
# A plane is fitted to this number of nearest points, and used if the smallest variance is at most
# this fraction of the next one.
PLANE_POINTS = 12
FLATNESS = 0.25
# Maximum distance of a point from its plane's point.
REACH_M = 0.10
# Residuals beyond OUTLIER_M have small weights (Cauchy).
OUTLIER_M = 0.02
# Standard deviations of the points, and of the pose error of a frame (prior).
NOISE_M = 0.01
PRIOR_DEG = 1.0
PRIOR_M = 0.02
# The errors of adjacent points are correlated: the prior weighs as much as this fraction of them.
PRIOR_FRACTION = 0.04
# A point without a plane in reach counts with this distance. The pose is corrected only if the mean
# squared distance falls to MAX_LOSS_RATIO of its value.
FAR_M = 0.05
MAX_LOSS_RATIO = 0.75
# This fraction of a frame's correction is kept for the next frame: drift accumulates, jitter
# cancels out.
KEPT_FRACTION = 0.4


class PoseAlignment:
    """Corrects the poses of frames by the graph that they are merged into.

    Attributes:
        T_correction: (4, 4) correction of the next frame's pose, multiplied from the left before
            the frame is compared with the graph.
    """

    def __init__(self) -> None:
        self.T_correction: Float64 = np.eye(4)
        # Points and normals (k, 6) of each node, and its number of observations at that time.
        self._planes: dict[int, tuple[int, Float64]] = {}

    def align(self, graph: SceneGraph, local: LocalGraph) -> LocalGraph:
        """The local graph under the corrected pose."""
        local = moved(local, self.T_correction)
        points = np.concatenate([np.zeros((0, 3)), *local.surface_points_world])
        planes = self._planes_near(graph, points) if len(points) else None
        if planes is None:
            return local
        points = points[np.random.default_rng(0).permutation(len(points))[:FRAME_POINTS]]
        camera_world = local.T_world_camera[:3, 3]
        rotation, translation = register(points, planes, camera_world)
        kept = _motion(KEPT_FRACTION * rotation, KEPT_FRACTION * translation, camera_world)
        self.T_correction = kept @ self.T_correction
        return moved(local, _motion(rotation, translation, camera_world))

    def warm_up(self) -> None:
        """Compile the kernel, or load it from the cache."""
        _planes(np.random.default_rng(0).normal(size=(20, 3)), 1)

    def forget(self, node_id: int) -> None:
        """Drop the planes of a removed node."""
        self._planes.pop(node_id, None)

    def _planes_near(self, graph: SceneGraph, points: Float64) -> Float64 | None:
        """Points and normals (m, 6) of the confirmed nodes around points (n, 3)."""
        nodes = graph.nodes
        lowest, highest = points.min(axis=0), points.max(axis=0)
        spreads = 2.0 * np.sqrt(np.diagonal(nodes.covariances, axis1=1, axis2=2)) + REACH_M
        near = (nodes.means + spreads > lowest) & (nodes.means - spreads < highest)
        near = near.all(axis=1) & nodes.confirmed
        planes = [self._planes_of(graph, node_id) for node_id in nodes.ids[near].tolist()]
        return np.concatenate(planes) if planes else None

    def _planes_of(self, graph: SceneGraph, node_id: int) -> Float64:
        row = graph.nodes.row(node_id)
        observations = int(graph.nodes.observations[row])
        last_observations, planes = self._planes.get(node_id, (0, np.zeros((0, 6))))
        if observations >= UPDATE_FACTOR * last_observations:
            planes = _planes(graph.nodes.surface(row).astype(np.float64), NODE_POINTS)
            self._planes[node_id] = observations, planes
        return planes


def moved(local: LocalGraph, T: Float64) -> LocalGraph:
    """A local graph with the camera pose T · T_world_camera instead of T_world_camera."""
    means_world, covariances_world = transform(local.means_world, local.covariances_world, T)
    return replace(
        local,
        T_world_camera=T @ local.T_world_camera,
        means_world=means_world,
        covariances_world=covariances_world,
        surface_points_world=tuple(
            (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
            for points in local.surface_points_world
        ),
    )


def register(points: Float64, planes: Float64, camera_world: Float64) -> tuple[Float64, Float64]:
    """Small motion that moves points onto planes.

    Gauss-Newton on the distances to the plane of the nearest point, with Cauchy weights and a prior
    of zero motion.

    Args:
        points: (n, 3) metres, world frame.
        planes: (m, 6) points, metres, and unit normals.
        camera_world: (3,) camera position, metres.

    Returns:
        Rotation vector (3,), radians, about the camera, and the translation (3,) after it, metres.
        Zeros if too few points are near a plane, or if the distances do not fall enough.
    """
    no_motion = np.zeros(3), np.zeros(3)
    if len(points) < MIN_MATCHES:
        return no_motion
    tree = cKDTree(planes[:, :3], balanced_tree=False, compact_nodes=False)
    anchors, normals = planes[:, :3] - camera_world, planes[:, 3:]
    points = points - camera_world
    deviations = np.repeat([np.deg2rad(PRIOR_DEG) ** -2.0, PRIOR_M**-2.0], 3)
    prior = PRIOR_FRACTION * len(points) * NOISE_M**2 * deviations
    rotation, translation = np.zeros(3), np.zeros(3)

    def residuals() -> tuple[Float64, Float64, Float64]:
        """Points near a plane, the normals of these planes, and the distances to them."""
        moved_points = Rotation.from_rotvec(rotation).apply(points) + translation
        gaps, nearest = tree.query(moved_points + camera_world, distance_upper_bound=REACH_M)
        found = np.flatnonzero(np.isfinite(gaps))
        nearest = nearest[found]
        offsets = anchors[nearest] - moved_points[found]
        distances = np.einsum("ij,ij->i", offsets, normals[nearest])
        return moved_points[found], normals[nearest], distances

    near, near_normals, distances = residuals()
    loss_before = _loss(distances, len(points))
    for _ in range(5):
        if len(distances) < MIN_MATCHES:
            return no_motion
        jacobian, weights = point_to_plane(near, near_normals, distances, OUTLIER_M)
        weighted = jacobian * weights[:, None]
        gradient = weighted.T @ distances - prior * np.concatenate((rotation, translation))
        step = np.linalg.solve(weighted.T @ jacobian + np.diag(prior), gradient)
        step_rotation = Rotation.from_rotvec(step[:3])
        rotation = (step_rotation * Rotation.from_rotvec(rotation)).as_rotvec()
        translation = step_rotation.apply(translation) + step[3:]
        near, near_normals, distances = residuals()
        if np.abs(step).max() < 1e-4:  # radians and metres
            break
    if _loss(distances, len(points)) > MAX_LOSS_RATIO * loss_before:
        return no_motion
    return rotation, translation


def _motion(rotation: Float64, translation: Float64, centre: Float64) -> Float64:
    """A rotation (rotation vector) about a centre, and then a translation, as (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    T[:3, 3] = translation + centre - T[:3, :3] @ centre
    return T


def _loss(distances: Float64, count: int) -> float:
    """Mean squared distance of all points, including those without a plane in reach."""
    squared = np.minimum(np.abs(distances), FAR_M) ** 2
    return float((squared.sum() + (count - len(squared)) * FAR_M**2) / count)


@kernel
def _planes(points: Float64, most: int) -> Float64:
    """Point and normal (k, 6) of those among the first points where the surface is flat."""
    planes = np.empty((min(most, len(points)), 6))
    count = 0
    near = min(PLANE_POINTS, len(points))
    if near < 4:
        return planes[:0]
    for index in range(len(planes)):
        offsets = points - points[index]
        squared = (offsets**2).sum(axis=1)
        neighbours = points[squared <= np.partition(squared, near - 1)[near - 1]]
        spread = neighbours.copy()
        for axis in range(3):
            spread[:, axis] -= neighbours[:, axis].mean()
        variances, axes = np.linalg.eigh(spread.T @ spread)
        if variances[0] <= FLATNESS * variances[1]:
            planes[count, :3] = points[index]
            planes[count, 3:] = axes[:, 0]
            count += 1
    return planes[:count]
