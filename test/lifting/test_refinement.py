"""Eq. 1-2: the inliers equal those of the reference for every kind of depth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.reference_lifting import kept_layer, reference_lift

from deworldsg_ros.config import LiftingConfig
from deworldsg_ros.lifting.refine import (
    dominant_layer,
    masks_of,
    spatial_inliers,
    valid_depth,
)
from deworldsg_ros.lifting.stage import LiftingConstants, mask_pixels
from deworldsg_ros.scene.camera import Intrinsics

PAPER, PRINTED = LiftingConfig(), LiftingConstants()


def kept_by_kernels(instances, depth_m, count):
    """Inlier mask of each object by the compiled kernels, without dropping any object."""
    depth_m = valid_depth(depth_m)
    objects = masks_of(instances, count)
    masks = []
    for k in range(count):
        pixels = spatial_inliers(depth_m, objects.runs_of(k), PAPER.tau, PRINTED.epsilon_m)
        mask = np.zeros(depth_m.shape, bool)
        if len(pixels):
            low, high = dominant_layer(
                pixels.depths_m, PAPER.gamma_base_m, PRINTED.alpha, PRINTED.beta
            )
            kept = (pixels.depths_m >= low) & (pixels.depths_m <= high)
            mask[pixels.rows[kept], pixels.columns[kept]] = True
        masks.append(mask)
    return masks


def check_inliers(instances, depth_m, count):
    height, width = depth_m.shape
    intrinsics = Intrinsics(50.0, 50.0, width / 2, height / 2, width, height)
    few_drops = LiftingConstants(min_pixels=2)
    references = reference_lift(
        instances, depth_m, intrinsics, np.eye(4), PAPER, count, constants=few_drops
    )
    masks = kept_by_kernels(instances, depth_m, count)
    compared = 0
    for reference, mask in zip(references, masks):
        if not isinstance(reference, str):
            np.testing.assert_array_equal(mask, reference.inliers)
            compared += 1
    return compared


def layered_depth(rng, shape, kind):
    height, width = shape
    depth = np.full(shape, 2.0) + 0.3 * np.linspace(0, 1, width)
    if kind == "two layers":
        depth[:, width // 2 :] += 1.5
    elif kind == "noise":
        depth += rng.normal(0, 0.2, shape)
    elif kind == "constant":
        depth[:] = 1.25
    elif kind == "many scales":
        depth = 10.0 ** rng.uniform(-3, 1.5, shape)
    elif kind == "shelves":
        depth += rng.integers(0, 6, (height, 1)) * 0.0625
    return depth


KINDS = ["smooth", "two layers", "noise", "constant", "many scales", "shelves"]


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    quantised=st.booleans(),
    holes=st.sampled_from([0.0, 0.1, 0.6]),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
)
def test_inliers_equal_the_reference(seed, kind, quantised, holes, height, width):
    rng = np.random.default_rng(seed)
    depth = layered_depth(rng, (height, width), kind)
    if quantised:
        depth = np.round(depth, 3)
    depth = depth.astype(np.float32)
    bad = rng.random((height, width)) < holes
    depth[bad] = rng.choice(np.array([0, np.nan, np.inf, -np.inf, -1.0], np.float32), bad.sum())
    # Objects in blocks of 7 pixels, some of them spread over the frame.
    blocks = rng.integers(0, 5, (height // 7 + 1, width // 7 + 1)).astype(np.uint16)
    instances = np.kron(blocks, np.ones((7, 7), np.uint16))[:height, :width]
    check_inliers(instances, depth, 5)


@settings(max_examples=150, deadline=None)
@given(
    data=st.one_of(
        st.lists(st.floats(2**-10, 128, width=32), min_size=1, max_size=60),
        st.lists(st.integers(1, 60).map(lambda k: k / 32), min_size=1, max_size=60),
        st.lists(st.integers(1, 4000).map(lambda mm: mm * 0.001), min_size=1, max_size=60),
    ),
    gamma=st.sampled_from([0.03, 1e-6, 0.5, 0.0625]),
    alpha=st.sampled_from([0.0, 1.0, 10.0, 300.0]),
    beta=st.sampled_from([0.0, 0.02, 0.3]),
)
def test_kept_layer_equals_the_reference(data, gamma, alpha, beta):
    depths = np.array(data, np.float32)
    assert dominant_layer(depths, gamma, alpha, beta) == kept_layer(depths, gamma, alpha, beta)


@pytest.mark.parametrize("number", [10, 11, 997, 40_000])
@pytest.mark.parametrize("spread", [1e-5, 0.2, 4.0, 60.0])
def test_kept_layer_of_large_sets(number, spread):
    rng = np.random.default_rng(number)
    depths = (0.5 + spread * rng.beta(0.6, 3.0, number)).astype(np.float32)
    assert dominant_layer(depths, 0.03, 10.0, 0.02) == kept_layer(depths)


def test_median_hidden_in_one_crowded_bucket():
    # One far outlier makes the buckets coarse; nearly all depths fall into the first.
    rng = np.random.default_rng(1)
    depths = np.append(1.0 + 1e-5 * rng.random(30_001), 9.0).astype(np.float32)
    assert dominant_layer(depths, 0.03, 10.0, 0.02) == kept_layer(depths)


def test_the_nearer_of_two_clusters_with_tied_means_is_kept():
    depths = np.array([1.0] * 8 + [2.0] * 8, np.float32)
    assert dominant_layer(depths, 0.03, 10.0, 0.02) == (1.0, 1.0)
    assert kept_layer(depths) == (1.0, 1.0)


def test_the_cluster_is_chosen_by_its_mean():
    # d_ref 1.5 lies at the far end of the first cluster (mean 0.78); the second is nearer.
    depths = np.array([0.5, 0.52, 0.54, 1.5, 1.62, 1.62], np.float32)
    depths_one_cluster = np.concatenate([np.linspace(0.1, 1.5, 29), np.full(28, 1.7)])
    for sample in (depths, depths_one_cluster.astype(np.float32)):
        assert dominant_layer(sample, 0.1, 0.0, 0.0) == kept_layer(sample, 0.1, 0.0, 0.0)
    assert dominant_layer(depths_one_cluster.astype(np.float32), 0.1, 0.0, 0.0)[0] > 1.6


def test_a_step_of_exactly_the_threshold_does_not_cut():
    depths = np.array([1.0, 1.25, 1.5], np.float32)
    assert dominant_layer(depths, 0.25, 0.0, 0.0) == (1.0, 1.5)
    assert dominant_layer(depths, np.nextafter(0.25, 0), 0.0, 0.0) == (1.25, 1.25)


def test_order_of_the_pixels_does_not_matter():
    rng = np.random.default_rng(3)
    depths = (1 + rng.integers(0, 40, 3000) * 0.05 + rng.random(3000) * 0.01).astype(np.float32)
    layer = dominant_layer(depths, 0.03, 10.0, 0.02)
    for _ in range(5):
        rng.shuffle(depths)
        assert dominant_layer(depths, 0.03, 10.0, 0.02) == layer


def test_spatial_test_is_strict_and_counts_holes_as_zero():
    # 3x3 frame, all valid: the centre is τ D~ + ε off its median, within rounding.
    depth = np.full((3, 3), 1.0, np.float32)
    depth[1, 1] = 1.0625
    runs = masks_of(np.ones((3, 3), np.uint16), 1).runs_of(0)
    assert len(spatial_inliers(depth, runs, 0.0625, 0.0)) == 8
    assert len(spatial_inliers(depth, runs, 0.0625, 1e-12)) == 9
    # Five holes around the centre: its median is 0, and 1.0 is far from it.
    depth = np.ones((3, 3), np.float32)
    depth[0, :] = 0
    depth[1, ::2] = 0
    kept = spatial_inliers(depth, runs, 0.05, 1e-3)
    assert (1, 1) not in set(zip(kept.rows.tolist(), kept.columns.tolist()))


def test_flying_pixels_at_an_edge_are_removed():
    depth = np.full((40, 40), 1.0, np.float32)
    depth[:, 20:] = 3.0
    depth[:, 20] = 2.0
    instances = np.ones((40, 40), np.uint16)
    (mask,) = kept_by_kernels(instances, depth, 1)
    assert not mask[:, 20].any()
    assert check_inliers(instances, depth, 1) == 1


def test_valid_depth_does_not_change_its_argument():
    depth = np.array([[np.nan, np.inf, -np.inf], [-1.0, 0.0, 1.5]], np.float32)
    before = depth.copy()
    np.testing.assert_array_equal(
        valid_depth(depth), np.array([[0, 0, 0], [0, 0, 1.5]], np.float32)
    )
    np.testing.assert_array_equal(depth, before)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    height=st.integers(1, 12),
    width=st.integers(1, 40),
    ids=st.integers(1, 6),
)
def test_runs_of_the_masks(seed, height, width, ids):
    rng = np.random.default_rng(seed)
    instances = np.repeat(rng.integers(0, ids + 1, (height, width)), 3, axis=1).astype(np.uint16)
    depth = rng.integers(0, 2, instances.shape).astype(np.float32)
    count = 4
    masks = masks_of(instances, count)
    painted = np.zeros_like(instances)
    for row, start, stop, index in masks.runs.tolist():
        assert not painted[row, start:stop].any()
        painted[row, start:stop] = index + 1
    np.testing.assert_array_equal(painted, np.where(instances > count, 0, instances))
    assert masks.unknown == (instances > count).sum()
    for k in range(count):
        mask, runs = instances == k + 1, masks.runs_of(k)
        assert set(runs[:, 3].tolist()) <= {k} and (np.diff(runs[:, 0]) >= 0).all()
        assert masks.sizes[k] == mask.sum()
        assert len(mask_pixels(depth, runs)) == (mask & (depth > 0)).sum()
