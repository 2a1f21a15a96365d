"""7-Scenes folders: registered, and as Microsoft distributes them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recordings import (
    INTRINSICS,
    depth_mm,
    encoded,
    frames_of,
    pose,
    rgb_pixels,
    write_seven_scenes,
)

from deworldsg_ros.recordings.folders.seven_scenes import (
    BASELINE_M,
    COLOR_FX_FY_CX_CY,
    DEPTH_FX_FY_CX_CY,
    FIRST_STAMP_NS,
    register_depth,
)
from deworldsg_ros.scene.camera import Intrinsics


@pytest.mark.parametrize(("options", "step_ns"), [({}, 4e9 / 30), ({"rate_hz": 10.0}, 1e8)])
def test_registered_frames_with_their_times_and_poses(tmp_path, options, step_ns):
    frames, _ = frames_of(write_seven_scenes(tmp_path / "kitchen", 5), **options)
    assert len(frames) == 5
    for index, frame in enumerate(frames):  # every fourth frame of 30 Hz
        assert frame.stamp_ns == FIRST_STAMP_NS + round(index * step_ns)
        assert frame.intrinsics == INTRINSICS
        np.testing.assert_allclose(frame.T_world_camera, pose(index), atol=1e-7)
        np.testing.assert_allclose(frame.depth_m, depth_mm(index) * 1e-3, atol=1e-6)
        assert np.abs(frame.rgb.astype(int) - rgb_pixels(index)).mean() < 4  # JPEG


def test_pictures_without_stamps_may_be_far_apart(tmp_path):
    folder = write_seven_scenes(tmp_path / "kitchen", 5)
    for index in range(5):
        T = pose(index)
        T[:3, 3] = [20.0 * index, 0.0, 0.0]
        np.savetxt(folder / f"frame-{4 * index:06d}.pose.txt", T, "%.9g")
    frames, recording = frames_of(folder)
    assert len(frames) == 5 and "4 of 5 steps are too wide" in recording.losses[0]
    # With a rate, it is a camera that jumps.
    frames, recording = frames_of(folder, rate_hz=10.0)
    assert len(frames) == 1 and recording.drops["pose_jump"] == 4


# The original layout: a wall at a known distance, seen by the Kinect's two cameras.

SIZE = (640, 480)
WALL_MM = 2000
EDGE_X_M = 0.3  # right of this the wall stands 1 m further back


def write_original(folder, count=2):
    folder.mkdir()
    depth_camera = Intrinsics(*DEPTH_FX_FY_CX_CY, *SIZE)
    color_camera = Intrinsics(*COLOR_FX_FY_CX_CY, *SIZE)

    def edge_column(camera, offset_m):
        return int(camera.fx * (EDGE_X_M - offset_m) / (WALL_MM * 1e-3) + camera.cx)

    depth = np.full((480, 640), WALL_MM, np.uint16)
    depth[:, edge_column(depth_camera, 0.0) :] = WALL_MM + 1000
    depth[:40] = 65535
    color = np.zeros((480, 640, 3), np.uint8)
    color[:, : edge_column(color_camera, BASELINE_M)] = 255
    for index in range(count):
        stem = folder / f"frame-{index:06d}"
        stem.with_suffix(".color.png").write_bytes(encoded(color))
        stem.with_suffix(".depth.png").write_bytes(encoded(depth))
        np.savetxt(stem.with_suffix(".pose.txt"), np.eye(4), "%.9g")
    return folder


def test_original_layout_is_registered_with_the_known_calibration(tmp_path):
    frames, recording = frames_of(write_original(tmp_path / "seq-01"))
    assert len(frames) == 2
    assert not recording.drops
    frame = frames[0]
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (528.41, 320.32)
    assert frame.depth_m.max() < 3.1, "65535 is no depth of 65 m"
    row = frame.depth_m[240]
    assert set(np.round(row[row > 0], 2)) == {2.0, 3.0}
    # The edge is where colour has it: white is near, black is far.
    white = frame.rgb[240, :, 0] > 128
    assert (row[white & (row > 0)] < 2.5).mean() > 0.99
    assert (row[~white & (row > 0)] > 2.5).mean() > 0.98
    # The depth camera sees less than the colour camera, on the right even less.
    valid = np.flatnonzero(row)
    assert 0 < valid[0] < SIZE[0] - 1 - valid[-1] < 60
    # Its frames are 1/30 s apart, and the pose is moved to the colour camera.
    assert frames[1].stamp_ns - frames[0].stamp_ns == round(1e9 / 30)
    np.testing.assert_allclose(frame.T_world_camera[:3, 3], [BASELINE_M, 0, 0], atol=1e-9)


def test_the_intrinsics_option_implies_registered_depth(tmp_path):
    folder = write_original(tmp_path / "seq-01")
    frames, _ = frames_of(folder, intrinsics=(525.0, 525.0, 319.5, 239.5))
    assert frames[0].intrinsics.fx == 525.0
    np.testing.assert_allclose(frames[0].T_world_camera, np.eye(4), atol=1e-12)
    assert (frames[0].depth_m[240] > 0).all()


CAMERA = Intrinsics(50.0, 50.0, 19.5, 14.5, 40, 30)


def moved(x_m=0.0, z_m=0.0):
    T = np.eye(4)
    T[0, 3], T[2, 3] = x_m, z_m
    return T


@given(st.integers(0, 2**32 - 1))
def test_the_same_camera_sees_the_same_image(seed):
    rng = np.random.default_rng(seed)
    depth = rng.integers(2, 60000, (30, 40)).astype(np.uint16)
    depth[rng.random((30, 40)) < rng.choice([0.3, 1.0])] = 0
    np.testing.assert_array_equal(register_depth(depth, CAMERA, CAMERA, np.eye(4)), depth)


def test_a_wall_is_displaced_by_its_disparity_on_the_grid_of_the_colour_camera():
    wall = np.full((30, 40), 1000, np.uint16)
    # 0.1 m at 1 m with f = 50: five columns to the left in a camera that stands to the right.
    out = register_depth(wall, CAMERA, CAMERA, moved(-0.1))
    assert (out[:, :35] == 1000).all()
    assert not out[:, 35:].any()
    assert not register_depth(wall, CAMERA, CAMERA, moved(z_m=-1.5)).any()
    assert not register_depth(wall, CAMERA, CAMERA, moved(9.0)).any()
    # Half the focal length: half the extent, around the centre.
    out = register_depth(wall, CAMERA, Intrinsics(25.0, 25.0, 39.5, 29.5, 80, 60), np.eye(4))
    assert out.shape == (60, 80)
    rows, columns = np.nonzero(out)
    assert np.ptp(columns) + 1 == 20
    assert np.ptp(rows) + 1 in (15, 16)
