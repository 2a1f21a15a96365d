"""3RScan, ReplicaSSG and rendered rooms: frames that are read, turned and resampled."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.sequences import (
    BACKGROUND_M,
    CAMERA,
    DEPTH_M,
    HEIGHT,
    WIDTH,
    depth_mm,
    write_room,
    write_sequence,
)

from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.folders.sequence import resample, rotated_intrinsics, rotated_pose
from deworldsg_ros.recordings.recording import open_recording, open_source
from deworldsg_ros.scene.camera import Intrinsics, pose_from_quaternion
from deworldsg_ros.scene.errors import RecordingError


def test_frames_of_a_room(tmp_path):
    recording = open_recording(write_room(tmp_path) / "data" / "room_0")
    for number, frame in enumerate(recording.frames()):
        assert frame.intrinsics == CAMERA
        assert (np.rint(frame.depth_m * 1000) == depth_mm()).all()
        assert frame.T_world_camera[0, 3] == 0.01 * number
        assert frame.stamp_ns == 10**9 + number * 10**8
        assert recording.source.frame_numbers[frame.stamp_ns] == number


def test_images_poses_and_intrinsics_of_3rscan_are_rotated(tmp_path):
    frame = next(open_recording(write_sequence(tmp_path / "data" / "a")).frames())
    assert frame.rgb.shape == (WIDTH, HEIGHT, 3)
    assert frame.intrinsics == Intrinsics(
        CAMERA.fy, CAMERA.fx, HEIGHT - CAMERA.cy, CAMERA.cx, HEIGHT, WIDTH
    )
    # The blue corner was at the upper left: clockwise, it comes to the upper right.
    assert frame.rgb[2, -3, 2] > 200
    assert frame.rgb[2, 3, 2] < 150
    assert (np.rint(frame.depth_m * 1000) == np.rot90(depth_mm(), -1)).all()


@given(
    u=st.floats(0, WIDTH - 1),
    v=st.floats(0, HEIGHT - 1),
    quat=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.3),
)
def test_a_rotated_camera_sees_the_same_points(u, v, quat):
    T = pose_from_quaternion(np.array([1.0, 2.0, 3.0]), np.array(quat) / np.linalg.norm(quat))
    turned = rotated_intrinsics(CAMERA)
    ray = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
    # Turned clockwise, a corner-based pixel (u, v) is at (H - v, u).
    turned_ray = np.array([(HEIGHT - v - turned.cx) / turned.fx, (u - turned.cy) / turned.fy, 1.0])
    np.testing.assert_allclose(T[:3, :3] @ ray, rotated_pose(T)[:3, :3] @ turned_ray, atol=1e-12)


def test_depth_of_a_smaller_image_is_resampled_to_the_colour_image(tmp_path):
    small = Intrinsics(40.0, 40.0, 23.5, 15.5, WIDTH // 2, HEIGHT // 2)
    (tmp_path / "ReplicaSSG").mkdir()
    folder = tmp_path / "data" / "a"
    write_sequence(folder, 1, depth=small, depth_image=depth_mm()[::2, ::2])
    frame = next(open_recording(folder).frames())
    assert frame.depth_m[30, 20] == pytest.approx(DEPTH_M, abs=1e-6)
    assert frame.depth_m[5, 20] == pytest.approx(BACKGROUND_M, abs=1e-6)
    assert (np.rint(frame.depth_m * 1000) != depth_mm()).mean() < 0.05
    # To the same camera it is the identity, and outside there is none.
    image = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH)
    assert (resample(image, CAMERA, CAMERA) == image).all()
    narrow = Intrinsics(160.0, 160.0, CAMERA.cx, CAMERA.cy, WIDTH, HEIGHT)
    assert resample(image + 1, narrow, CAMERA)[0, 0] == 0


def test_depth_source_of_3rscan(tmp_path):
    folder = write_sequence(tmp_path / "data" / "a", 1)
    assert open_source(folder).topics["depth"].name == "frame-*.depth.pgm"
    with pytest.raises(RecordingError, match="--depth-source"):
        open_source(folder, options=DatasetOptions(depth_source="rendered"))
    rendered = np.full((HEIGHT, WIDTH), 1500, np.uint16)
    cv2.imwrite(str(folder / "sequence" / "frame-000000.rendered.depth.png"), rendered)
    for source, expected in (("auto", 1.5), ("rendered", 1.5), ("sensor", BACKGROUND_M)):
        recording = open_recording(folder, options=DatasetOptions(depth_source=source))
        assert next(recording.frames()).depth_m[0, 0] == pytest.approx(expected, abs=1e-6)
