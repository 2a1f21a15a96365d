"""Drift: exact poses stay, drift and jumps are found, trembling is not taken for drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.surfaces import CAMERA, CUP, frame, slab

from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.poses.drift import MAX_SURFELS, Drift, SurfelMap, difference, moved
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph

# Floor, ceiling and walls of a room, and two sides of a box in it: normals n and offsets n · x.
ROOM = [((0, 1, 0), 1.2), ((0, -1, 0), 1.3), ((0, 0, 1), 3.0), ((1, 0, 0), 1.8), ((-1, 0, 0), 1.6)]
OBJECT = slab((0.3, 0.2, 2.0), (0.3, 0.3, 0.01))


def pose(turn_deg=(0.0, 0.0, 0.0), shift_m=(0.0, 0.0, 0.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    T[:3, 3] = shift_m
    return T


def depth_of(T: np.ndarray, planes=ROOM) -> DepthGrid:
    """Depth grid of planes seen from inside, with 3 mm of noise."""
    row, column = np.mgrid[4:480:8, 4:640:8]
    rays = CAMERA.back_project(column, row, np.ones(row.shape)) @ T[:3, :3].T
    depth_m = np.full(row.shape, 8.0)
    for normal, offset in planes:
        ahead = rays @ np.array(normal, float)
        reached = (offset - T[:3, 3] @ normal) / np.where(ahead > 1e-6, ahead, np.nan)
        depth_m = np.fmin(depth_m, reached)
    depth_m += np.random.default_rng(int(1e6 * abs(T[:3]).sum())).normal(0, 0.003, row.shape)
    return DepthGrid((1000 * depth_m).astype(np.uint16), 8, CAMERA)


def seen(stamp: int, T_true: np.ndarray, T_given: np.ndarray, planes=ROOM) -> LocalGraph:
    local = frame(stamp, (OBJECT, CUP), depth_grid=depth_of(T_true, planes))
    return replace(moved(local, T_given @ np.linalg.inv(T_true)), T_world_camera=T_given)


def path(stamp: int) -> np.ndarray:
    """A camera that looks around."""
    return pose((0, 8 * np.sin(stamp / 15), 0), (0.1 * np.sin(stamp / 20), 0, 0.004 * stamp))


def errors(noise, frames: int = 60, planes=ROOM) -> np.ndarray:
    """Turn (degrees) and shift (metres) of each corrected pose from the true one."""
    drift, found = Drift(), []
    for stamp in range(frames):
        T_true = path(stamp)
        corrected = drift.align(seen(stamp, T_true, noise(stamp, T_true), planes)).T_world_camera
        step = difference(T_true, corrected)
        found.append((np.degrees(np.linalg.norm(step[:3])), np.linalg.norm(step[3:])))
    return np.array(found)


def test_exact_poses_stay_as_they_are() -> None:
    drift = Drift()
    for stamp in range(40):
        local = seen(stamp, path(stamp), path(stamp))
        assert drift.align(local) is local
    assert np.array_equal(drift.T_graph_poses, np.eye(4))


def test_drift_is_corrected() -> None:
    def drifting(stamp: int, T: np.ndarray) -> np.ndarray:
        return pose((0, 0.1 * stamp, 0), (0.002 * stamp, 0, 0)) @ T

    found = errors(drifting)
    assert found[-10:, 0].max() < 1.0  # of 6 degrees
    assert found[-10:, 1].max() < 0.03  # of 12 cm


def test_a_constant_offset_is_found_at_once() -> None:
    found = errors(lambda stamp, T: pose((0, 2, 0), (0.05, 0, 0.03)) @ T if stamp > 20 else T)
    assert found[21:, 0].max() < 0.7
    assert found[21:, 1].max() < 0.03


def trembling(stamp: int, T: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(stamp)
    return T @ pose(rng.normal(0, 1, 3), rng.normal(0, 0.02, 3))


def test_trembling_is_corrected_and_not_taken_for_drift() -> None:
    given = [difference(path(stamp), trembling(stamp, path(stamp))) for stamp in range(60)]
    before = np.degrees(np.linalg.norm(np.array(given)[:, :3], axis=1))
    found = errors(trembling)
    assert found[20:, 0].mean() < 0.5 * before.mean()
    drift = Drift()
    for stamp in range(60):
        drift.align(seen(stamp, path(stamp), trembling(stamp, path(stamp))))
    # The first pose is wrong by 1.6 degrees. The graph is not.
    step = difference(np.eye(4), drift.T_graph_poses)
    assert np.degrees(np.linalg.norm(step[:3])) < 0.3


def test_a_single_plane_is_no_reason_to_slide() -> None:
    wall = [((0, 0, 1), 2.0)]
    surfels, T = SurfelMap(), np.eye(4)
    for _ in range(3):
        surfels.register(T, depth_of(T, wall))
        surfels.add(T)
    fitted = surfels.register(pose((0, 0, 2), (0.05, 0.03, 0.04)), depth_of(T, wall))
    assert fitted is not None
    assert fitted[:2, 3] == pytest.approx((0.05, 0.03), abs=0.01)
    assert fitted[2, 3] == pytest.approx(0.0, abs=0.005)
    assert Rotation.from_matrix(fitted[:3, :3]).as_rotvec(degrees=True)[2] == pytest.approx(
        2, abs=0.2
    )


@pytest.mark.parametrize("depth_mm", [0, 9000])
def test_frames_without_usable_depth_change_nothing(depth_mm: int) -> None:
    drift = Drift()
    grid = DepthGrid(np.full((60, 80), depth_mm, np.uint16), 8, CAMERA)
    for stamp in range(5):
        local = frame(stamp, depth_grid=grid, T_world_camera=path(stamp))
        assert drift.align(local) is local
    local = frame(9, (OBJECT, CUP))
    assert drift.align(local) is local


def test_the_map_is_bounded_and_forgets_surfaces_that_are_gone() -> None:
    surfels, T = SurfelMap(), np.eye(4)
    for step in range(0, 300, 4):  # a corridor without end
        there = pose(shift_m=(0, 0, step))
        planes = [*ROOM[:2], ((0, 0, 1), 3.0 + step), *ROOM[3:]]
        surfels.register(there, depth_of(there, planes))
        surfels.add(there)
    assert 0 < surfels._count <= MAX_SURFELS
    near, far = [((0, 0, 1), 1.0)], [((0, 0, 1), 3.0)]
    surfels = SurfelMap()
    for planes in [near] * 3 + [far] * 12:
        surfels.register(T, depth_of(T, planes))
        surfels.add(T)
    assert surfels._rows[: surfels._count, 2].min() > 2.8


def test_a_loop_closure_does_not_correct_again_what_is_corrected() -> None:
    builder = None
    for stamp in range(60):
        error = pose((0, 0, 0), (0.0, 0, 0.004 * stamp))
        local = seen(stamp, path(stamp), error @ path(stamp))
        builder = builder or GraphBuilder(Config(), local.vocabulary, local.frame_id)
        builder.integrate(local)
    assert builder is not None
    before = builder.graph.nodes.means.copy()
    assert builder.apply_correction(np.linalg.inv(error), 0) == [1]
    assert np.abs(builder.graph.nodes.means - before).max() < 0.03  # not 24 cm


def test_a_moved_local_graph_equals_one_of_a_moved_camera() -> None:
    local, T = frame(1, (OBJECT, CUP)), pose((10, 20, 30), (1, 2, 3))
    there = moved(local, T)
    (points,), (before,) = there.surface_points_world, local.surface_points_world
    assert np.allclose(points, before @ T[:3, :3].T + T[:3, 3], atol=1e-5)
    assert points.dtype == np.float32
    assert np.array_equal(there.T_world_camera, T)
    assert np.allclose(moved(there, np.linalg.inv(T)).means_world, local.means_world)
    assert np.allclose(difference(np.eye(4), T)[:3], np.radians((10, 20, 30)))
