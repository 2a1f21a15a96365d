"""Poses that drift: each frame is laid on what the graph remembers before it is merged.

Point-to-plane registration of the frame's surface points with those of the nodes. Beyond the
paper; `merging.align_poses`.
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

# Points of a frame that are compared, and of each node; both are uniform draws.
FRAME_POINTS = 500
NODE_POINTS = 128
# With fewer that lie on a plane of a node, nothing is known of the pose.
MIN_MATCHES = 100
# The planes of a node are taken again when it was seen so many times as often.
RENEW_FACTOR = 1.5
# A plane: the points nearest to a point, and how much thinner than wide they lie.
PLANE_POINTS = 12
FLATNESS = 0.25
REACH_M = 0.10
STEPS = 5
# Residuals beyond this weigh little (Cauchy); noise of the points; what a step of the pose may be.
OUTLIER_M = 0.02
NOISE_M = 0.01
STEP_DEG = 1.0
STEP_M = 0.02
# A point that meets no plane within reach counts as so far off; a correction is made only where
# the mean squared distance falls to this share.
FAR_M = 0.05
MIN_GAIN = 0.75
# This share of a frame's correction is carried to the next: what drifts adds up, what trembles
# cancels out.
CARRIED = 0.4


class PoseAlignment:
    """Corrects the poses of frames by the graph that they are merged into.

    Attributes:
        T_correction: (4, 4) what the next frame's pose is multiplied by, from the left, before it
            is compared with the graph.
    """

    def __init__(self) -> None:
        self.T_correction: Float64 = np.eye(4)
        # Points and normals (k, 6) of each node, and its observations when they were taken.
        self._planes: dict[int, tuple[int, Float64]] = {}

    def align(self, graph: SceneGraph, local: LocalGraph) -> LocalGraph:
        """The local graph as it is under the corrected pose."""
        local = moved(local, self.T_correction)
        points = np.concatenate([np.zeros((0, 3)), *local.surface_points_world])
        planes = self._near(graph, points) if len(points) else None
        if planes is None:
            return local
        points = points[np.random.default_rng(0).permutation(len(points))[:FRAME_POINTS]]
        camera_world = local.T_world_camera[:3, 3]
        turn, shift = register(points, planes, camera_world)
        carried = _motion(CARRIED * turn, CARRIED * shift, camera_world)
        self.T_correction = carried @ self.T_correction
        return moved(local, _motion(turn, shift, camera_world))

    def warm_up(self) -> None:
        """Compile the search for planes, or load it from the cache."""
        _planes(np.random.default_rng(0).normal(size=(20, 3)), 1)

    def forget(self, node_id: int) -> None:
        """Drop what is known of a node that is gone."""
        self._planes.pop(node_id, None)

    def _near(self, graph: SceneGraph, points: Float64) -> Float64 | None:
        """Points and normals (m, 6) of the confirmed nodes around points (n, 3)."""
        nodes = graph.nodes
        least, most = points.min(axis=0), points.max(axis=0)
        spreads = 2.0 * np.sqrt(np.diagonal(nodes.covariances, axis1=1, axis2=2)) + REACH_M
        near = (nodes.means + spreads > least) & (nodes.means - spreads < most)
        near = near.all(axis=1) & nodes.confirmed
        known = [self._planes_of(graph, node_id) for node_id in nodes.ids[near].tolist()]
        return np.concatenate(known) if known else None

    def _planes_of(self, graph: SceneGraph, node_id: int) -> Float64:
        row = graph.nodes.row(node_id)
        observations = int(graph.nodes.observations[row])
        then, planes = self._planes.get(node_id, (0, np.zeros((0, 6))))
        if observations >= RENEW_FACTOR * then:
            planes = _planes(graph.nodes.surface(row).astype(np.float64), NODE_POINTS)
            self._planes[node_id] = observations, planes
        return planes


def moved(local: LocalGraph, T: Float64) -> LocalGraph:
    """A local graph as it would be if the camera's pose were T · T_world_camera."""
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
    """The small motion that lays points (n, 3) on planes (m, 6): points and normals, metres.

    Gauss-Newton on the distances to the plane of the nearest point, with Cauchy weights and a prior
    of no motion.

    Returns:
        Rotation vector (3,), radians, about the camera (3,), and the shift (3,) after it, metres;
        zeros where too little was met, or where it does not bring enough.
    """
    nothing = np.zeros(3), np.zeros(3)
    if len(points) < MIN_MATCHES:
        return nothing
    tree = cKDTree(planes[:, :3], balanced_tree=False, compact_nodes=False)
    at, normals = planes[:, :3] - camera_world, planes[:, 3:]
    points = points - camera_world
    # Neighbouring points err together: the prior weighs as much as 4 % of them.
    prior = (
        0.04 * len(points) * NOISE_M**2 * np.repeat([np.deg2rad(STEP_DEG) ** -2.0, STEP_M**-2.0], 3)
    )
    turn, shift = np.zeros(3), np.zeros(3)

    def residuals() -> tuple[Float64, Float64, Float64]:
        placed = Rotation.from_rotvec(turn).apply(points) + shift
        distances, nearest = tree.query(placed + camera_world, distance_upper_bound=REACH_M)
        found = np.flatnonzero(np.isfinite(distances))
        nearest = nearest[found]
        distances = np.einsum("ij,ij->i", at[nearest] - placed[found], normals[nearest])
        return placed[found], normals[nearest], distances

    placed, directions, distances = residuals()
    loss_before = _loss(distances, len(points))
    for _ in range(STEPS):
        if len(distances) < MIN_MATCHES:
            return nothing
        weights = 1.0 / (1.0 + (distances / OUTLIER_M) ** 2)
        jacobian = np.concatenate((np.cross(placed, directions), directions), axis=1)
        weighted = jacobian * weights[:, None]
        gradient = weighted.T @ distances - prior * np.concatenate((turn, shift))
        step = np.linalg.solve(weighted.T @ jacobian + np.diag(prior), gradient)
        turned = Rotation.from_rotvec(step[:3])
        turn = (turned * Rotation.from_rotvec(turn)).as_rotvec()
        shift = turned.apply(shift) + step[3:]
        placed, directions, distances = residuals()
        if np.abs(step).max() < 1e-4:
            break
    if _loss(distances, len(points)) > MIN_GAIN * loss_before:
        return nothing
    return turn, shift


def _motion(turn: Float64, shift: Float64, centre: Float64) -> Float64:
    """A turn (rotation vector) about a centre, and then a shift, as (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    T[:3, 3] = shift + centre - T[:3, :3] @ centre
    return T


def _loss(distances: Float64, count: int) -> float:
    """Mean squared distance of the points that met a plane and of those that did not."""
    met = np.minimum(np.abs(distances), FAR_M) ** 2
    return float((met.sum() + (count - len(met)) * FAR_M**2) / count)


@kernel
def _planes(points: Float64, most: int) -> Float64:
    """Point and normal (k, 6) of the first points around which the surface is flat."""
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
