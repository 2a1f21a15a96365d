"""Eq. 1-2: the inliers equal those of the reference for every kind of depth."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.reference_lifting import kept_layer, reference_lift

from deworldsg_ros.config import LiftingConfig
from deworldsg_ros.lifting.refine import dominant_layer, masks_of, spatial_inliers, valid_depth
from deworldsg_ros.lifting.stage import LiftingConstants
from deworldsg_ros.scene.camera import Intrinsics

PAPER, PRINTED = LiftingConfig(), LiftingConstants()
# gamma, alpha and beta of the paper.
LAYERS = PAPER.gamma_base_m, PRINTED.alpha, PRINTED.beta
SEEDS = st.integers(0, 2**32 - 1)


def layered_depth(rng, shape, kind):
    height, width = shape
    ramp = np.full(shape, 2.0) + 0.3 * np.linspace(0, 1, width)
    return {
        "smooth": ramp,
        "two layers": ramp + 1.5 * (np.arange(width) >= width // 2),
        "noise": ramp + rng.normal(0, 0.2, shape),
        "constant": np.full(shape, 1.25),
        "many scales": 10.0 ** rng.uniform(-3, 1.5, shape),
        "shelves": ramp + rng.integers(0, 6, (height, 1)) * 0.0625,
    }[kind]


@settings(max_examples=60)
@given(
    seed=SEEDS,
    kind=st.sampled_from(["smooth", "two layers", "noise", "constant", "many scales", "shelves"]),
    quantised=st.booleans(),
    holes=st.sampled_from([0.0, 0.1, 0.6]),
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
)
def test_inliers_equal_the_reference(seed, kind, quantised, holes, shape):
    rng = np.random.default_rng(seed)
    depth = layered_depth(rng, shape, kind)
    depth = (np.round(depth, 3) if quantised else depth).astype(np.float32)
    bad = rng.random(shape) < holes
    depth[bad] = rng.choice(np.array([0, np.nan, np.inf, -np.inf, -1.0], np.float32), bad.sum())
    # Objects in blocks of 7 pixels, some of them spread over the frame.
    blocks = rng.integers(0, 5, (shape[0] // 7 + 1, shape[1] // 7 + 1)).astype(np.uint16)
    instances = np.kron(blocks, np.ones((7, 7), np.uint16))[: shape[0], : shape[1]]
    camera = Intrinsics(50.0, 50.0, shape[1] / 2, shape[0] / 2, shape[1], shape[0])
    scene, constants = (instances, depth, camera, np.eye(4)), LiftingConstants(min_pixels=2)
    objects = masks_of(instances, 5)
    for k, reference in enumerate(reference_lift(*scene, PAPER, 5, constants=constants)):
        if not isinstance(reference, str):
            runs = objects.runs_of(k)
            pixels = spatial_inliers(valid_depth(depth), runs, PAPER.tau, PRINTED.epsilon_m)
            low, high = dominant_layer(pixels.depths_m, *LAYERS)
            kept = (pixels.depths_m >= low) & (pixels.depths_m <= high)
            mask = np.zeros(shape, bool)
            mask[pixels.rows[kept], pixels.columns[kept]] = True
            np.testing.assert_array_equal(mask, reference.inliers)


@settings(max_examples=150)
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
@example([1.0] * 8 + [2.0] * 8, 0.03, 10.0, 0.02)  # the nearer one of two with tied means
@example([1.0, 1.25, 1.5], 0.25, 0.0, 0.0)  # a step of exactly the threshold does not cut
def test_kept_layer_equals_the_reference(data, gamma, alpha, beta):
    depths = np.array(data, np.float32)
    assert dominant_layer(depths, gamma, alpha, beta) == kept_layer(depths, gamma, alpha, beta)


@pytest.mark.parametrize("number", [10, 11, 997, 40_000])
@pytest.mark.parametrize("spread", [1e-5, 0.2, 4.0, 60.0])
def test_kept_layer_of_large_sets(number, spread):
    rng = np.random.default_rng(number)
    depths = (0.5 + spread * rng.beta(0.6, 3.0, number)).astype(np.float32)
    # One far outlier makes the buckets coarse; nearly all depths fall into the first.
    for sample in (depths, np.append(depths, np.float32(9.0))):
        layer = dominant_layer(sample, *LAYERS)
        assert layer == kept_layer(sample)
        rng.shuffle(sample)
        assert dominant_layer(sample, *LAYERS) == layer
