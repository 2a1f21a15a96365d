"""Eq. 3-4 and the stage: Gaussians, drops, relations, frames."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.reference_lifting import reference_lift

from deworldsg_ros.config import LiftingConfig
from deworldsg_ros.lifting import Lifting, refine, stage
from deworldsg_ros.lifting.stage import LiftingConstants
from deworldsg_ros.scene.camera import Intrinsics, pose_from_quaternion
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, LocalGraph, Relations, Vocabulary

VOCABULARY = Vocabulary(("chair", "table"), ("on", "near", "under"))


def make_frame_graph(count, shape, pairs=()):
    height, width = shape
    rng = np.random.default_rng(0)
    probabilities = rng.dirichlet((1.0, 1.0), count)
    relations = Relations(
        np.array(pairs, np.int64).reshape(-1, 2),
        rng.normal(size=(len(pairs), 3)),
        rng.random(len(pairs)),
    )
    boxes = np.tile([0.0, 0.0, width, height], (count, 1))
    return FrameGraph(
        5, "camera", width, height, VOCABULARY, boxes, probabilities, rng.random(count), relations
    )


def make_scene(seed, shape=(60, 80), count=6):
    rng = np.random.default_rng(seed)
    height, width = shape
    blocks = rng.integers(0, count + 1, (height // 20, width // 20)).astype(np.uint16)
    instances = np.kron(blocks, np.ones((20, 20), np.uint16))
    depth = 1.5 + 0.002 * np.arange(width) + 0.25 * instances + rng.normal(0, 0.004, shape)
    depth[rng.random(shape) < 0.05] = np.nan
    intrinsics = Intrinsics(70.0, 71.0, 39.3, 30.1, width, height)
    quat = rng.normal(size=4)
    T = pose_from_quaternion(rng.normal(size=3) * 3, quat / np.linalg.norm(quat))
    return instances, depth.astype(np.float32), intrinsics, T


def lift(scene, count=6, pairs=(), **constants):
    instances, depth_m, intrinsics, T = scene
    graph = make_frame_graph(count, instances.shape, pairs)
    lifting = Lifting(LiftingConfig(), LiftingConstants(**constants))
    return lifting.lift(graph, instances, depth_m, intrinsics, T, "world")


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_gaussians_equal_the_reference(seed):
    scene = make_scene(seed)
    local = lift(scene)
    references = reference_lift(*scene, LiftingConfig(), 6)
    kept = [r for r in references if not isinstance(r, str)]
    assert local.instance_ids.tolist() == [
        k + 1 for k, r in enumerate(references) if not isinstance(r, str)
    ]
    reasons = [r for r in references if isinstance(r, str)]
    assert local.drops == {reason: reasons.count(reason) for reason in set(reasons)}
    for row, reference in enumerate(kept):
        assert local.pixel_counts[row] == reference.inliers.sum()
        scale = np.linalg.norm(reference.mean)
        assert np.abs(local.means_world[row] - reference.mean).max() <= 1e-9 * scale
        error = np.abs(local.covariances_world[row] - reference.covariance).max()
        assert error <= 1e-9 * np.linalg.norm(reference.covariance)
        assert local.depths_m[row] == pytest.approx(reference.depth_m, rel=1e-12)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_covariances_are_symmetric_and_positive_definite(seed):
    covariances = lift(make_scene(seed)).covariances_world
    np.testing.assert_array_equal(covariances, np.swapaxes(covariances, 1, 2))
    assert (np.linalg.eigvalsh(covariances) > 0.5e-6).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_change_of_world_frame_moves_the_graph_rigidly(seed):
    instances, depth_m, intrinsics, T = make_scene(seed)
    rng = np.random.default_rng(seed + 1)
    quat = rng.normal(size=4)
    move = pose_from_quaternion(rng.normal(size=3), quat / np.linalg.norm(quat))
    here = lift((instances, depth_m, intrinsics, T))
    there = lift((instances, depth_m, intrinsics, move @ T))
    R, t = move[:3, :3], move[:3, 3]
    np.testing.assert_allclose(there.means_world, here.means_world @ R.T + t, atol=1e-11)
    np.testing.assert_allclose(
        there.covariances_world, R @ here.covariances_world @ R.T, atol=1e-12
    )
    np.testing.assert_array_equal(there.depths_m, here.depths_m)
    for mine, other in zip(here.surface_points_world, there.surface_points_world):
        np.testing.assert_allclose(other, mine @ R.T + t, atol=1e-5)


def test_a_thin_object_far_from_the_origin_keeps_its_precision():
    # A flat object at 8 m, 1 mm thick, seen from a camera 1 km from the origin.
    rng = np.random.default_rng(0)
    depth = (8 + rng.normal(0, 0.001, (100, 100))).astype(np.float32)
    instances = np.ones((100, 100), np.uint16)
    T = np.eye(4)
    T[:3, 3] = 1000.0
    scene = (instances, depth, Intrinsics(500.0, 500.0, 50.0, 50.0, 100, 100), T)
    local = lift(scene, count=1)
    T_origin = np.eye(4)
    (reference,) = reference_lift(*scene[:3], T_origin, LiftingConfig(), 1)
    np.testing.assert_allclose(
        local.covariances_world[0], reference.covariance, rtol=1e-9, atol=1e-15
    )
    np.testing.assert_allclose(local.means_world[0] - 1000.0, reference.mean, atol=1e-12)


@pytest.mark.parametrize("count", [0, 3])
def test_empty_frames(count):
    intrinsics = Intrinsics(70.0, 70.0, 40.0, 30.0, 80, 60)
    empty = np.zeros((60, 80), np.uint16)
    local = lift((empty, np.ones((60, 80), np.float32), intrinsics, np.eye(4)), count=count)
    assert len(local) == 0
    assert local.drops == ({"few_mask_pixels": count} if count else {})
    assert local.means_world.shape == (0, 3)
    assert local.covariances_world.shape == (0, 3, 3)


@pytest.mark.parametrize(("number", "lifted"), [(9, 0), (10, 1)])
def test_ten_valid_pixels_are_needed(number, lifted):
    depth = np.full((20, 20), 2.0, np.float32)
    instances = np.zeros((20, 20), np.uint16)
    instances.ravel()[45 : 45 + number] = 1
    instances[10, 10] = 1
    depth[10, 10] = np.nan
    local = lift((instances, depth, Intrinsics(20.0, 20.0, 10.0, 10.0, 20, 20), np.eye(4)), count=1)
    assert len(local) == lifted
    assert local.drops == ({} if lifted else {"few_mask_pixels": 1})


def test_each_step_names_its_drop():
    shape = (40, 120)
    depth = np.full(shape, 2.0, np.float32)
    instances = np.zeros(shape, np.uint16)
    instances[2:8, 2:8] = 1
    depth[2:8, 2:8] = 0
    instances[2:14, 20:32] = 2
    depth[2:14:2, 20:32:2] = 1.0  # isolated points that differ from their neighbours
    instances[2:14, 20:32][depth[2:14, 20:32] == 2.0] = 0
    # Three layers of eight pixels each.
    for index in range(3):
        columns = slice(50 + 20 * index, 58 + 20 * index)
        instances[20, columns] = 3
        depth[15:25, columns.start - 3 : columns.stop + 3] = 1.0 + index
    scene = (instances, depth, Intrinsics(70.0, 70.0, 60.0, 20.0, 120, 40), np.eye(4))
    local = lift(scene, count=3)
    assert local.drops == {
        "few_mask_pixels": 1,
        "few_spatial_inliers": 1,
        "few_depth_inliers": 1,
    }


def test_relations_of_dropped_objects_are_removed_and_rows_renumbered():
    depth = np.full((20, 40), 2.0, np.float32)
    instances = np.zeros((20, 40), np.uint16)
    instances[2:12, 2:10] = 1
    instances[2:12, 22:30] = 3  # the second object has no pixels
    scene = (instances, depth, Intrinsics(30.0, 30.0, 20.0, 10.0, 40, 20), np.eye(4))
    pairs = [(0, 1), (2, 0), (1, 2), (0, 2)]
    graph = make_frame_graph(3, (20, 40), pairs)
    local = lift(scene, count=3, pairs=pairs)
    assert local.instance_ids.tolist() == [1, 3]
    assert local.relations.pairs.tolist() == [[1, 0], [0, 1]]
    np.testing.assert_array_equal(local.relations.logits, graph.relations.logits[[1, 3]])
    np.testing.assert_array_equal(local.relations.scores, graph.relations.scores[[1, 3]])
    np.testing.assert_array_equal(local.class_probabilities, graph.class_probabilities[[0, 2]])
    assert (local.stamp_ns, local.frame_id) == (5, "world")
    # It has all attributes, and passes the checks of a graph that comes from outside.
    LocalGraph(**vars(local))
    assert vars(local).keys() == {item.name for item in fields(LocalGraph)}


def test_surface_points_are_an_even_sample_of_the_inliers():
    scene = make_scene(4)
    local = lift(scene, surface_points=32)
    references = [r for r in reference_lift(*scene, LiftingConfig(), 6) if not isinstance(r, str)]
    _, depth_m, intrinsics, T = scene
    assert len(references) > 2
    for points, reference in zip(local.surface_points_world, references):
        assert len(points) >= 32
        assert points.dtype == np.float32
        camera = (points.astype(np.float64) - T[:3, 3]) @ T[:3, :3]
        u = np.rint(camera[:, 0] / camera[:, 2] * intrinsics.fx + intrinsics.cx).astype(int)
        v = np.rint(camera[:, 1] / camera[:, 2] * intrinsics.fy + intrinsics.cy).astype(int)
        assert reference.inliers[v, u].all()
        np.testing.assert_allclose(camera[:, 2], depth_m[v, u], atol=1e-5)
        positions = np.searchsorted(np.flatnonzero(reference.inliers), v * intrinsics.width + u)
        assert (np.diff(positions) > 0).all()
        assert np.ptp(np.diff(positions)) <= 1
    none = lift(scene, surface_points=0)
    assert all(points.shape == (0, 3) for points in none.surface_points_world)


def test_a_large_surface_gives_more_points():
    intrinsics = Intrinsics(500.0, 500.0, 320.0, 240.0, 640, 480)
    instances = np.ones((480, 640), np.uint16)
    for depth_m, expected in ((0.5, 200), (1.2, 589), (4.0, 800)):
        scene = (instances, np.full((480, 640), depth_m, np.float32), intrinsics, np.eye(4))
        (points,) = lift(scene, count=1).surface_points_world
        assert abs(len(points) - expected) <= 1


def test_the_memory_layout_does_not_change_the_graph():
    instances, depth_m, intrinsics, T = make_scene(7)
    plain = lift((instances, depth_m, intrinsics, T))
    frozen = np.frombuffer(depth_m.tobytes(), np.float32).reshape(depth_m.shape)
    for other in (
        frozen,
        np.asfortranarray(depth_m),
        depth_m.astype(">f4"),
        np.frombuffer(b"x" + depth_m.tobytes(), np.uint8)[1:].view(np.float32).reshape(60, 80),
    ):
        local = lift((instances, other, intrinsics, T))
        np.testing.assert_array_equal(local.means_world, plain.means_world)
        np.testing.assert_array_equal(local.covariances_world, plain.covariances_world)


def test_the_depth_grid_samples_depth_and_instances():
    instances, depth_m, intrinsics, T = make_scene(1)
    grid = lift((instances, depth_m, intrinsics, T)).depth_grid
    valid = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0)
    np.testing.assert_array_equal(grid.depth_mm, np.rint(1000 * valid[4::8, 4::8]))
    np.testing.assert_array_equal(grid.instances, instances[4::8, 4::8])
    assert grid.instances.any()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"depth": (60, 79)}, "grid_mismatch"),
        ({"instances": (59, 80)}, "grid_mismatch"),
        ({"intrinsics": (60, 81)}, "grid_mismatch"),
        ({"value": 7}, "unknown_instance"),
        ({"pose": np.nan}, "invalid_pose"),
    ],
)
def test_inputs_of_another_size_or_range_are_refused(change, reason):
    instances, depth_m, intrinsics, T = make_scene(1)
    graph = make_frame_graph(6, (60, 80))
    if "depth" in change:
        depth_m = np.ones(change["depth"], np.float32)
    if "instances" in change:
        instances = np.zeros(change["instances"], np.uint16)
    if "intrinsics" in change:
        height, width = change["intrinsics"]
        intrinsics = Intrinsics(70.0, 70.0, 40.0, 30.0, width, height)
    if "value" in change:
        instances = instances.copy()
        instances[0, 0] = change["value"]
    if "pose" in change:
        T = np.full((4, 4), change["pose"])
    with pytest.raises(RefusedInput) as refusal:
        Lifting(LiftingConfig()).lift(graph, instances, depth_m, intrinsics, T, "world")
    assert refusal.value.reason == reason


def test_warm_up_compiles_everything_that_a_frame_needs():
    Lifting(LiftingConfig()).warm_up()
    entry_points = (
        refine._masks_of,
        refine._spatial_inliers,
        refine._dominant_layer,
        stage._estimate,
    )
    # Other tests of this process may have compiled more.
    known = {kernel: len(kernel.signatures) for kernel in entry_points}
    assert min(known.values()) >= 1
    instances, depth_m, intrinsics, T = make_scene(11)
    for array in (depth_m, instances):
        array.flags.writeable = False
    lift((instances, depth_m, intrinsics, T))
    for kernel in entry_points:
        assert len(kernel.signatures) == known[kernel], kernel


@pytest.mark.slow
def test_processes_that_compile_at_once_into_one_cache_agree(tmp_path):
    script = (
        "from deworldsg_ros.config import LiftingConfig\n"
        "from deworldsg_ros.lifting import Lifting\n"
        "Lifting(LiftingConfig()).warm_up()\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    root = Path(__file__).resolve().parents[2]
    processes = [
        subprocess.Popen([sys.executable, "-c", script], cwd=root, env=environment)
        for _ in range(2)
    ]
    assert [process.wait(timeout=100) for process in processes] == [0, 0]
    assert list(tmp_path.rglob("*.nbi"))
