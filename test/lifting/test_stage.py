"""Eq. 3-4 and the stage: Gaussians, drops, relations, frames; masks and boxes without Eq. 1-2."""

import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.merging import random_pose
from support.reference_lifting import reference_lift

from deworldsg_ros.config import LiftingConfig
from deworldsg_ros.evaluation.baselines import Fross
from deworldsg_ros.lifting import Lifting, refine, stage
from deworldsg_ros.lifting.stage import LiftingConstants, box_pixels
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, LocalGraph, Relations, Vocabulary

VOCABULARY = Vocabulary(("chair", "table"), ("on", "near", "under"))
SEEDS = st.integers(0, 2**32 - 1)


def frame_graph(count, shape, pairs=(), boxes=None):
    height, width = shape
    rng = np.random.default_rng(0)
    probabilities, scores = rng.dirichlet((1.0, 1.0), count), rng.random(count)
    logits = rng.normal(size=(len(pairs), 3))
    pairs = np.array(pairs, np.int64).reshape(-1, 2)
    relations = Relations(pairs, logits, rng.random(len(pairs)))
    boxes = np.tile([0.0, 0.0, width, height], (count, 1)) if boxes is None else boxes
    boxes = np.array(boxes, float).reshape(-1, 4)
    return FrameGraph(
        5, "camera", width, height, VOCABULARY, boxes, probabilities, scores, relations
    )


def make_scene(seed, shape=(60, 80), count=6):
    rng = np.random.default_rng(seed)
    height, width = shape
    blocks = rng.integers(0, count + 1, (height // 20, width // 20)).astype(np.uint16)
    instances = np.kron(blocks, np.ones((20, 20), np.uint16))
    depth = 1.5 + 0.002 * np.arange(width) + 0.25 * instances + rng.normal(0, 0.004, shape)
    depth[rng.random(shape) < 0.05] = np.nan
    camera = Intrinsics(70.0, 71.0, 39.3, 30.1, width, height)
    return instances, depth.astype(np.float32), camera, random_pose(rng)


def scene_of(instances, depth_m, T=np.eye(4), focal=50.0):
    height, width = instances.shape
    camera = Intrinsics(focal, focal, width / 2, height / 2, width, height)
    return instances.astype(np.uint16), np.asarray(depth_m, np.float32), camera, T


def lift(scene, count=6, pairs=(), boxes=None, pixels="refined", **constants):
    instances, depth_m, camera, T = scene
    graph = frame_graph(count, instances.shape, pairs, boxes)
    lifting = Lifting(LiftingConfig(pixels=pixels), LiftingConstants(**constants))
    return lifting.lift(graph, instances, depth_m, camera, T, "world")


@given(seed=SEEDS)
def test_gaussians_equal_the_reference(seed):
    scene = make_scene(seed)
    local = lift(scene)
    references = reference_lift(*scene, LiftingConfig(), 6)
    kept = [k for k, reference in enumerate(references) if not isinstance(reference, str)]
    assert local.instance_ids.tolist() == [k + 1 for k in kept]
    reasons = [reference for reference in references if isinstance(reference, str)]
    assert local.drops == {reason: reasons.count(reason) for reason in set(reasons)}
    for row, k in enumerate(kept):
        reference = references[k]
        assert local.pixel_counts[row] == reference.inliers.sum()
        scale = np.linalg.norm(reference.mean)
        assert np.abs(local.means_world[row] - reference.mean).max() <= 1e-9 * scale
        error = np.abs(local.covariances_world[row] - reference.covariance).max()
        assert error <= 1e-9 * np.linalg.norm(reference.covariance)
        assert local.depths_m[row] == pytest.approx(reference.depth_m, rel=1e-12)
    covariances = local.covariances_world
    np.testing.assert_array_equal(covariances, np.swapaxes(covariances, 1, 2))
    assert (np.linalg.eigvalsh(covariances) > 0.5e-6).all()


def test_a_thin_object_far_from_the_origin_keeps_its_precision():
    # A flat object at 8 m, 1 mm thick, seen from a camera 1 km from the origin.
    depth_m = 8 + np.random.default_rng(0).normal(0, 0.001, (100, 100))
    T = np.eye(4)
    T[:3, 3] = 1000.0
    scene = scene_of(np.ones((100, 100)), depth_m, T, 500.0)
    local = lift(scene, count=1)
    (reference,) = reference_lift(*scene[:3], np.eye(4), LiftingConfig(), 1)
    found = local.covariances_world[0]
    np.testing.assert_allclose(found, reference.covariance, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(local.means_world[0] - 1000.0, reference.mean, atol=1e-12)


def test_each_step_names_its_drop():
    depth_m, instances = np.full((40, 120), 2.0), np.zeros((40, 120))
    instances[2:8, 2:8] = 1
    depth_m[2:8, 2:8] = 0
    instances[2:14:2, 20:32:2] = 2
    depth_m[2:14:2, 20:32:2] = 1.0  # isolated points that differ from their neighbours
    # Three layers of eight pixels each.
    for index in range(3):
        left = 50 + 20 * index
        instances[20, left : left + 8] = 3
        depth_m[15:25, left - 3 : left + 11] = 1.0 + index
    reasons = ("few_mask_pixels", "few_spatial_inliers", "few_depth_inliers")
    assert lift(scene_of(instances, depth_m), 3).drops == dict.fromkeys(reasons, 1)


def test_relations_of_dropped_objects_are_removed_and_rows_renumbered():
    instances = np.zeros((20, 40))
    instances[2:12, 2:10] = 1
    instances[2:12, 22:30] = 3  # the second object has no pixels
    pairs = [(0, 1), (2, 0), (1, 2), (0, 2)]
    graph = frame_graph(3, (20, 40), pairs)
    local = lift(scene_of(instances, np.full((20, 40), 2.0)), 3, pairs)
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
    _, depth_m, camera, T = scene
    assert len(references) > 2
    for points, reference in zip(local.surface_points_world, references):
        assert len(points) >= 32 and points.dtype == np.float32
        seen = (points.astype(np.float64) - T[:3, 3]) @ T[:3, :3]
        u = np.rint(seen[:, 0] / seen[:, 2] * camera.fx + camera.cx).astype(int)
        v = np.rint(seen[:, 1] / seen[:, 2] * camera.fy + camera.cy).astype(int)
        assert reference.inliers[v, u].all()
        np.testing.assert_allclose(seen[:, 2], depth_m[v, u], atol=1e-5)
        positions = np.searchsorted(np.flatnonzero(reference.inliers), v * camera.width + u)
        assert (np.diff(positions) > 0).all() and np.ptp(np.diff(positions)) <= 1
    none = lift(scene, surface_points=0)
    assert all(points.shape == (0, 3) for points in none.surface_points_world)
    # A large surface gives more points.
    for depth_m, expected in ((0.5, 200), (1.2, 589), (4.0, 800)):
        wall = scene_of(np.ones((480, 640)), np.full((480, 640), depth_m), focal=500.0)
        (points,) = lift(wall, 1).surface_points_world
        assert abs(len(points) - expected) <= 1


def test_the_memory_layout_does_not_change_the_graph():
    instances, depth_m, camera, T = make_scene(7)
    plain = lift((instances, depth_m, camera, T))
    for other in (
        np.frombuffer(depth_m.tobytes(), np.float32).reshape(depth_m.shape),
        np.asfortranarray(depth_m),
        depth_m.astype(">f4"),
        np.frombuffer(b"x" + depth_m.tobytes(), np.uint8)[1:].view(np.float32).reshape(60, 80),
    ):
        local = lift((instances, other, camera, T))
        np.testing.assert_array_equal(local.means_world, plain.means_world)
        np.testing.assert_array_equal(local.covariances_world, plain.covariances_world)


def test_the_depth_grid_samples_depth_and_instances():
    scene = make_scene(1)
    instances, depth_m, _, _ = scene
    grid = lift(scene).depth_grid
    valid = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0)
    np.testing.assert_array_equal(grid.depth_mm, np.rint(1000 * valid[4::8, 4::8]))
    np.testing.assert_array_equal(grid.instances, instances[4::8, 4::8])
    assert grid.instances.any()


GOOD = make_scene(1)


@pytest.mark.parametrize(
    ("position", "wrong", "reason"),
    [
        (0, np.zeros((59, 80), np.uint16), "grid_mismatch"),
        (1, np.ones((60, 79), np.float32), "grid_mismatch"),
        (2, Intrinsics(70.0, 70.0, 40.0, 30.0, 81, 60), "grid_mismatch"),
        (0, np.full((60, 80), 7, np.uint16), "unknown_instance"),
        (3, np.full((4, 4), np.nan), "invalid_pose"),
    ],
)
def test_inputs_of_another_size_or_range_are_refused(position, wrong, reason):
    scene = (*GOOD[:position], wrong, *GOOD[position + 1 :])
    with pytest.raises(RefusedInput) as refusal:
        Lifting(LiftingConfig()).lift(frame_graph(6, (60, 80)), *scene, "world")
    assert refusal.value.reason == reason


@pytest.mark.parametrize(
    ("pixels", "count", "depth_m"),
    [
        ("refined", 99 - 4, 1.0),  # without the flying pixel and the mask's corners
        ("mask", 100, 1.01),
        ("box", 7 * 7, 2.0),  # of the central half, and the depth of the pixel at the centre
    ],
)
def test_masks_and_boxes_without_refinement(pixels, count, depth_m):
    """An object at 1 m, seen on a part of its box, before a wall at 3 m; one flying pixel."""
    instances = np.zeros((30, 40))
    instances[10:20, 10:20] = 1
    depths_m = np.where(instances, 1.0, 3.0)
    depths_m[15, 15] = 2.0
    boxes = [[8, 8, 22, 22]]
    lifted = lift(scene_of(instances, depths_m), 1, boxes=boxes, pixels=pixels)
    assert lifted.pixel_counts.tolist() == [count]
    assert lifted.depths_m[0] == pytest.approx(depth_m)


def test_a_box_is_lifted_by_one_depth_as_fross_does():
    _, depth_m, camera, T = make_scene(2)
    none = np.zeros(depth_m.shape, np.uint16)
    corners = [[3, 2, 70, 50], [22, 11, 41, 59], [0, 0, 9, 9], [5, 5, 5.5, 50], [40, 30, 60, 50]]
    boxes = np.array(corners)
    depth_m[40, 50] = np.nan
    lifted = lift((none, depth_m, camera, T), 5, boxes=boxes, pixels="box")
    graph = frame_graph(5, depth_m.shape, boxes=boxes)
    fross = Fross().lift(graph, None, depth_m, camera, T)
    assert (lifted.instance_ids - 1).tolist() == fross.rows == [0, 1, 2]
    assert lifted.drops == {"no_centre_depth": 2}
    for row, node in enumerate(fross.nodes):
        np.testing.assert_allclose(lifted.means_world[row], node.mean_world)
        ridge = LiftingConfig().covariance_ridge_m2 * np.eye(3)
        np.testing.assert_allclose(lifted.covariances_world[row], node.covariance_world + ridge)
    # What does not lie at the centre of a box has no influence on its Gaussian.
    u, v = 36, 26
    others = np.full_like(depth_m, 9.0)
    others[v, u] = depth_m[v, u]
    again = lift((none, others, camera, T), 1, boxes=boxes[:1], pixels="box")
    np.testing.assert_array_equal(again.covariances_world, lifted.covariances_world[:1])
    assert again.surface_points_world[0].shape == (200, 3)


def test_boxes_may_overlap_leave_the_image_and_have_no_depth():
    depth_m = np.full((30, 40), 2.0, np.float32)
    depth_m[:, 0] = 0.0
    boxes = np.array([[-5, -5, 4.5, 4.5], [2, 2, 4.5, 4.5], [50, 50, 60, 60], [3.2, 3.2, 3.8, 9]])
    found = [box_pixels(depth_m, box) for box in boxes]
    assert [len(pixels) for pixels in found] == [4 * 5, 3 * 3, 0, 0]
    assert (found[1].columns.min(), found[1].rows.max()) == (2, 4)
    blind = scene_of(np.zeros((30, 40)), np.zeros((30, 40)))
    for boxes, pixels in (([], "box"), ([[0, 0, 20, 20]], "box"), ([[0, 0, 20, 20]], "refined")):
        lifted = lift(blind, len(boxes), boxes=boxes, pixels=pixels)
        assert (lifted.means_world.shape, lifted.covariances_world.shape) == ((0, 3), (0, 3, 3))
        reason = "no_centre_depth" if pixels == "box" else "few_mask_pixels"
        assert lifted.drops == ({reason: 1} if boxes else {})


def test_warm_up_compiles_everything_that_a_frame_needs():
    Lifting(LiftingConfig()).warm_up()
    names = ("masks_of", "spatial_inliers", "dominant_layer")
    kernels = [*(getattr(refine, f"_{name}") for name in names), stage._estimate]
    # Other tests of this process may have compiled more.
    known = [len(kernel.signatures) for kernel in kernels]
    assert min(known) >= 1
    scene = make_scene(11)
    for array in scene[:2]:
        array.flags.writeable = False
    lift(scene)
    assert [len(kernel.signatures) for kernel in kernels] == known


@pytest.mark.slow
def test_processes_that_compile_at_once_into_one_cache_agree(tmp_path):
    script = (
        "from deworldsg_ros.config import LiftingConfig\n"
        "from deworldsg_ros.lifting import Lifting\n"
        "Lifting(LiftingConfig()).warm_up()\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", script]
    processes = [subprocess.Popen(command, cwd=root, env=environment) for _ in range(2)]
    assert [process.wait(timeout=100) for process in processes] == [0, 0]
    assert list(tmp_path.rglob("*.nbi"))
