"""Alignment of frames with the graph: motions are found, and drift is corrected."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.merging import VOCABULARY
from support.surfaces import CUP, TABLE, frame, slab

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.merging.alignment import PoseAlignment, moved, register
from deworldsg_ros.merging.surface_rule import SurfaceMerging
from deworldsg_ros.scene.graph import SceneGraph

CAMERA = np.array([0.0, 0.0, 0.0])


def box(x: float, y: float, z: float) -> np.ndarray:
    """Three sides of a cube of 40 cm, whose corner lies at (x, y, z)."""
    return np.concatenate(
        [
            slab((x + 0.2, y + 0.2, z), (0.4, 0.4, 0.001)),
            slab((x + 0.2, y, z + 0.2), (0.4, 0.001, 0.4)),
            slab((x, y + 0.2, z + 0.2), (0.001, 0.4, 0.4)),
        ]
    )


BOXES = [(box(x, 0.1 * x, 2.0), kind) for x, kind in ((-0.9, CUP), (0.0, TABLE), (0.9, CUP))]


def planes_of(points: np.ndarray) -> np.ndarray:
    """Points of a corner at the origin, each with the normal of the side that it is on."""
    side = np.abs(points).argmin(axis=1)
    return np.concatenate((points, np.eye(3)[side]), axis=1)


def transform(rotation_deg: tuple[float, float, float], translation_m: tuple[float, float, float]):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix()
    T[:3, 3] = translation_m
    return T


def test_a_small_motion_is_found() -> None:
    planes = planes_of(box(0, 0, 0).astype(np.float64))
    camera = np.array([-1.0, -1.0, -1.0])
    rotation, translation = np.deg2rad([0.8, -0.5, 0.6]), np.array([0.02, -0.015, 0.01])
    points = np.random.default_rng(1).permutation(planes[:, :3])[:500]
    away = Rotation.from_rotvec(rotation).inv().apply(points - camera - translation) + camera
    found_rotation, found_translation = register(away, planes, camera)
    placed = Rotation.from_rotvec(found_rotation).apply(away - camera) + found_translation + camera
    assert np.abs(placed - points).max() < 0.01
    assert np.abs(away - points).max() > 0.03


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((500, 3), 9.0)])
def test_points_without_planes_are_not_moved(points: np.ndarray) -> None:
    rotation, translation = register(points, planes_of(box(0, 0, 0).astype(np.float64)), CAMERA)
    assert not rotation.any()
    assert not translation.any()


def test_a_single_plane_leaves_tangential_motion_at_zero() -> None:
    floor = slab((0.0, 0.0, 0.0), (1.0, 1.0, 0.001)).astype(np.float64)
    planes = np.concatenate((floor, np.tile([0.0, 0, 1], (len(floor), 1))), axis=1)
    camera = np.array([0.0, 0.0, 1.0])
    rotation, translation = register(floor[:500] + (0.03, 0.03, 0.03), planes, camera)
    assert translation[2] == pytest.approx(-0.03, abs=0.005)
    assert np.abs(translation[:2]).max() < 1e-3
    assert abs(rotation[2]) < 1e-3


def test_a_moved_local_graph_equals_one_of_a_moved_camera() -> None:
    local = frame(1, *BOXES)
    T = transform((10, 20, 30), (1, 2, 3))
    there = moved(local, T)
    for points, before in zip(there.surface_points_world, local.surface_points_world):
        assert np.allclose(points, before @ T[:3, :3].T + T[:3, 3], atol=1e-5)
        assert np.allclose(np.cov(points.T), T[:3, :3] @ np.cov(before.T) @ T[:3, :3].T, atol=1e-5)
    assert np.array_equal(there.T_world_camera, T)
    back = moved(there, np.linalg.inv(T))
    assert np.allclose(back.means_world, local.means_world)
    assert np.allclose(back.covariances_world, local.covariances_world)


def drift(config: MergingConfig, frames: int = 60) -> SceneGraph:
    """The boxes under poses that drift by 0.1 degree and 2 mm in each frame."""
    graph = SceneGraph(VOCABULARY, "world")
    merging = SurfaceMerging(config)
    for stamp in range(1, frames + 1):
        drifted = transform((0, 0.1 * stamp, 0), (0.002 * stamp, 0, 0.001 * stamp))
        merging.merge(graph, moved(frame(stamp, *BOXES), drifted))
    return graph


def test_alignment_corrects_drift() -> None:
    config = MergingConfig()
    truth = np.array([points.mean(axis=0) for points, _ in BOXES])

    def errors_m(graph: SceneGraph) -> np.ndarray:
        means = graph.nodes.means[graph.nodes.confirmed]
        return np.linalg.norm(means[:, None] - truth, axis=2).min(axis=1)

    uncorrected = drift(config)
    aligned = drift(msgspec.structs.replace(config, align_poses=True))
    assert len(errors_m(aligned)) == len(BOXES)
    assert errors_m(aligned).max() < 0.03
    assert errors_m(uncorrected).max() > 0.06


def test_correct_poses_are_not_changed() -> None:
    graph = SceneGraph(VOCABULARY, "world")
    alignment = PoseAlignment()
    merging = SurfaceMerging(MergingConfig())
    for stamp in range(1, 8):
        merging.merge(graph, frame(stamp, *BOXES))
    local = frame(9, *BOXES)
    assert np.allclose(alignment.align(graph, local).T_world_camera, np.eye(4), atol=2e-3)
    empty = frame(10)
    assert len(alignment.align(graph, empty)) == 0
