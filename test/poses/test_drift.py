"""Drift: exact poses stay, drift and jumps are found, trembling is not taken for drift."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.surfaces import CAMERA, CUP, frame, slab

from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.poses.drift import (
    FAR_M,
    MAX_SURFELS,
    NEAR_M,
    SAMPLES,
    Drift,
    SurfelMap,
    difference,
    moved,
)
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.frame_graph import DepthGrid

# Floor, ceiling and walls of a room, and two sides of a box in it: normals n and offsets n · x.
ROOM = [((0, 1, 0), 1.2), ((0, -1, 0), 1.3), ((0, 0, 1), 3.0), ((1, 0, 0), 1.8), ((-1, 0, 0), 1.6)]
OBJECT = slab((0.3, 0.2, 2.0), (0.3, 0.3, 0.01))


def pose(turn_deg=(0.0, 0.0, 0.0), shift_m=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    T[:3, 3] = shift_m
    return T


def depth_of(T, planes=ROOM):
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


def seen(stamp, T_true, T_given, planes=ROOM):
    local = frame(stamp, (OBJECT, CUP), depth_grid=depth_of(T_true, planes))
    return replace(moved(local, T_given @ np.linalg.inv(T_true)), T_world_camera=T_given)


def path(stamp):
    """A camera that looks around."""
    return pose((0, 8 * np.sin(stamp / 15), 0), (0.1 * np.sin(stamp / 20), 0, 0.004 * stamp))


def aligned(noise, frames=60, drift=None):
    """Turn (degrees) and shift (metres) of each corrected pose from the true one."""
    drift, found = drift or Drift(), []
    for stamp in range(frames):
        T = path(stamp)
        corrected = drift.align(seen(stamp, T, noise(stamp) @ T)).T_world_camera
        step = difference(T, corrected)
        found.append((np.degrees(np.linalg.norm(step[:3])), np.linalg.norm(step[3:])))
    return np.array(found).T


def test_exact_poses_stay_as_they_are():
    drift = Drift()
    for stamp in range(40):
        local = seen(stamp, path(stamp), path(stamp))
        assert drift.align(local) is local
    assert np.array_equal(drift.T_graph_poses, np.eye(4))


def test_drift_is_corrected():
    # 6 degrees and 12 cm at the end.
    turns, shifts = aligned(lambda k: pose((0, 0.1 * k, 0), (0.002 * k, 0, 0)))
    assert turns[-10:].max() < 1.0 and shifts[-10:].max() < 0.03
    # A constant offset is found at once.
    turns, shifts = aligned(lambda k: pose((0, 2, 0), (0.05, 0, 0.03)) if k > 20 else np.eye(4))
    assert turns[21:].max() < 0.7 and shifts[21:].max() < 0.03


def test_trembling_is_corrected_and_not_taken_for_drift():
    def trembling(stamp):
        rng, T = np.random.default_rng(stamp), path(stamp)
        return T @ pose(rng.normal(0, 1, 3), rng.normal(0, 0.02, 3)) @ np.linalg.inv(T)

    given = [difference(path(k), trembling(k) @ path(k))[:3] for k in range(60)]
    drift = Drift()
    turns, _ = aligned(trembling, drift=drift)
    assert turns[20:].mean() < 0.5 * np.degrees(np.linalg.norm(given, axis=1)).mean()
    # The first pose is wrong by 1.6 degrees. The graph is not.
    assert np.degrees(np.linalg.norm(difference(np.eye(4), drift.T_graph_poses)[:3])) < 0.3


def map_of(views):
    """The surfels after depth grids, each of a pose and planes."""
    surfels = SurfelMap()
    for T, planes in views:
        surfels.register(T, depth_of(T, planes))
        surfels.add(T)
    return surfels


def test_a_single_plane_is_no_reason_to_slide():
    wall = [((0, 0, 1), 2.0)]
    surfels = map_of([(np.eye(4), wall)] * 3)
    fitted = surfels.register(pose((0, 0, 2), (0.05, 0.03, 0.04)), depth_of(np.eye(4), wall))
    assert fitted[:2, 3] == pytest.approx((0.05, 0.03), abs=0.01)
    assert fitted[2, 3] == pytest.approx(0.0, abs=0.005)
    turn = Rotation.from_matrix(fitted[:3, :3]).as_rotvec(degrees=True)
    assert turn[2] == pytest.approx(2, abs=0.2)


def test_the_far_side_of_a_thin_wall_is_another_surface():
    # The wall is 12 cm thick. In the next room, floor, ceiling and side walls are the same.
    sides = [ROOM[0], ROOM[1], ROOM[3], ROOM[4]]
    surfels = map_of([(np.eye(4), [*sides, ((0, 0, 1), 2.0)])] * 5)
    T = pose((0, 180, 0), (0, 0, 4.0))
    fitted = surfels.register(T, depth_of(T, [*sides, ((0, 0, -1), -2.12)]))
    assert fitted is None or np.linalg.norm(difference(T, fitted)[3:]) < 0.01


def test_noise_does_not_move_a_pose_along_a_corridor():
    corridor = [ROOM[0], ROOM[1], ((1, 0, 0), 0.8), ((-1, 0, 0), 0.8)]
    poses = [pose((0, 0, 0), (0, 0, 0.001 * k)) for k in range(30)]
    surfels = map_of([(T, corridor) for T in poses[:3]])
    for T in poses:  # each with a noise of its own
        fitted = surfels.register(T, depth_of(T, corridor))
        assert fitted[2, 3] == pytest.approx(T[2, 3], abs=0.001)


def test_one_wrong_frame_is_no_drift():
    error = pose(shift_m=(0.25, 0.0, 0.1))
    drift = Drift()
    aligned(lambda stamp: pose(), 30, drift)
    for stamp in range(30, 33):
        T = path(stamp)
        drift.align(seen(stamp, T, (error if stamp == 30 else pose()) @ T))
        assert np.linalg.norm(drift.T_graph_poses[:3, 3]) < 0.02


def moved_by(wrong, register, T, grid):
    """Registers a frame, and takes another pose for the one that fits."""
    register(T, grid)
    return wrong @ T


def test_a_far_step_counts_only_if_the_frame_fits_much_better_there(monkeypatch):
    drift, T = Drift(), path(30)
    aligned(lambda stamp: pose(), 30, drift)
    local, register = seen(30, T, T), drift._map.register
    for wrong_m in (0.05, 0.25):
        wrong = pose(shift_m=(wrong_m, 0.0, 0.0))
        monkeypatch.setattr(drift._map, "register", partial(moved_by, wrong, register))
        assert drift.align(local) is local
    # Now the pose is wrong, and where the frame fits is right.
    local = seen(30, T, invert_pose(wrong) @ T)
    corrected = drift.align(local).T_world_camera
    assert np.linalg.norm(difference(T, corrected)[3:]) < 0.03


def test_the_misfit_is_that_of_each_surfel():
    surfels, grid = SurfelMap(), depth_of(pose())
    surfels.register(pose(), grid)
    surfels.add(pose())
    for shift_m, turn_deg in ((0.0, 0.0), (0.04, 1.0), (0.3, 0.0)):
        T = pose((0.0, turn_deg, 0.0), (shift_m, 0.0, shift_m))
        surfels.register(pose(), grid)
        costs = []
        rows = surfels.rows[surfels.seen]
        for row in rows[:: max(1, len(rows) // SAMPLES)]:
            ahead = invert_pose(T) @ [*row[:3], 1.0]
            u = (CAMERA.fx * ahead[0] / ahead[2] + CAMERA.cx - 4) / 8
            v = (CAMERA.fy * ahead[1] / ahead[2] + CAMERA.cy - 4) / 8
            column, line = int(u + 0.5), int(v + 0.5)
            if min(column, line) < 0 or column >= 80 or line >= 60 or ahead[2] < NEAR_M:
                continue
            z = 0.001 * grid.depth_mm[line, column]
            if not NEAR_M < z <= FAR_M:
                continue
            point = CAMERA.back_project(
                np.array(8 * column + 4), np.array(8 * line + 4), np.array(z)
            )
            away = row[:3] - (T[:3, :3] @ point + T[:3, 3])
            gap = min(abs(away @ row[3:6]), 0.1) if np.linalg.norm(away) <= 0.2 else 0.1
            costs.append(np.log1p((gap / (3.0 * (0.004 + 0.002 * z**2))) ** 2))
        assert surfels.misfit(T) == pytest.approx(np.mean(costs), rel=0.02)


def test_the_map_is_bounded_and_forgets_surfaces_that_are_gone():
    def corridor(step):
        return pose(shift_m=(0, 0, step)), [*ROOM[:2], ((0, 0, 1), 3.0 + step), *ROOM[3:]]

    assert 0 < map_of(map(corridor, range(0, 300, 4)))._count <= MAX_SURFELS
    near, far = [((0, 0, 1), 1.0)], [((0, 0, 1), 3.0)]
    surfels = map_of([(np.eye(4), near)] * 3 + [(np.eye(4), far)] * 12)
    assert surfels._rows[: surfels._count, 2].min() > 2.8


@pytest.mark.parametrize("depth_mm", [0, 9000])
def test_frames_without_usable_depth_change_nothing(depth_mm):
    drift = Drift()
    grid = DepthGrid(np.full((60, 80), depth_mm, np.uint16), 8, CAMERA)
    unusable = [frame(k, depth_grid=grid, T_world_camera=path(k)) for k in range(5)]
    for local in [*unusable, frame(9, (OBJECT, CUP))]:
        assert drift.align(local) is local


def test_a_loop_closure_does_not_correct_again_what_is_corrected():
    builder = None
    for stamp in range(60):
        error = pose(shift_m=(0.0, 0, 0.004 * stamp))
        local = seen(stamp, path(stamp), error @ path(stamp))
        builder = builder or GraphBuilder(Config(), local.vocabulary, local.frame_id)
        builder.integrate(local)
    before = builder.graph.nodes.means.copy()
    true = np.array([path(k) for k in range(60)])
    assert builder.apply_trajectory(10**8 * np.arange(60), true) == 1
    assert np.abs(builder.graph.nodes.means - before).max() < 0.03  # not 24 cm
