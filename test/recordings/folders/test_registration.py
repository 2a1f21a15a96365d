"""Depth projected into the colour camera."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from deworldsg_ros.recordings.folders.seven_scenes import register_depth
from deworldsg_ros.scene.camera import Intrinsics

CAMERA = Intrinsics(50.0, 50.0, 19.5, 14.5, 40, 30)


def shift(x_m):
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def test_no_depth_gives_no_depth():
    out = register_depth(np.zeros((30, 40), np.uint16), CAMERA, CAMERA, np.eye(4))
    assert out.shape == (30, 40)
    assert out.dtype == np.uint16
    assert not out.any()


@given(st.integers(0, 2**32 - 1))
def test_the_same_camera_sees_the_same_image(seed):
    rng = np.random.default_rng(seed)
    depth_mm = rng.integers(2, 60000, (30, 40)).astype(np.uint16)
    depth_mm[rng.random((30, 40)) < 0.3] = 0
    np.testing.assert_array_equal(register_depth(depth_mm, CAMERA, CAMERA, np.eye(4)), depth_mm)


def test_a_wall_is_displaced_by_its_disparity():
    depth_mm = np.full((30, 40), 1000, np.uint16)
    # 0.1 m at 1 m with f = 50: five columns to the left in a camera that stands to the right.
    out = register_depth(depth_mm, CAMERA, CAMERA, shift(-0.1))
    assert (out[:, :35] == 1000).all()
    assert not out[:, 35:].any()


def test_the_nearest_surface_in_a_pixel_wins():
    depth_mm = np.zeros((30, 40), np.uint16)
    depth_mm[10, 20] = 1000  # moves by 5 columns
    depth_mm[10, 17] = 2500  # moves by 2, to the same place
    out = register_depth(depth_mm, CAMERA, CAMERA, shift(-0.1))
    assert out[10, 15] == 1000
    assert np.count_nonzero(out) == 1


def test_points_behind_or_beside_the_camera_are_left_out():
    depth_mm = np.full((30, 40), 500, np.uint16)
    behind = np.eye(4)
    behind[2, 3] = -1.0
    assert not register_depth(depth_mm, CAMERA, CAMERA, behind).any()
    assert not register_depth(depth_mm, CAMERA, CAMERA, shift(9.0)).any()


def test_the_output_is_on_the_grid_of_the_colour_camera():
    wide = Intrinsics(25.0, 25.0, 39.5, 29.5, 80, 60)
    out = register_depth(np.full((30, 40), 1000, np.uint16), CAMERA, wide, np.eye(4))
    assert out.shape == (60, 80)
    rows, columns = np.nonzero(out)
    # Half the focal length: half the extent, around the centre.
    assert columns.max() - columns.min() + 1 == 20
    assert rows.max() - rows.min() + 1 in (15, 16)
