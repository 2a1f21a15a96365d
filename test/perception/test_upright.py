"""A camera on its side: frames are turned upright, results are turned back exactly."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.failing_backend import Backend
from support.perception import INTRINSICS, SHAPE, box_of

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception import Perception
from deworldsg_ros.perception.stage import turned_back
from deworldsg_ros.scene.camera import RgbdFrame, Uprighter, turned
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary

# A level camera that looks along +y of a world whose z points up.
LEVEL = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


def frame(T=LEVEL):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (*SHAPE, 3), np.uint8)
    depth_m = rng.uniform(0.5, 3, SHAPE).astype(np.float32)
    return RgbdFrame(0, rgb, depth_m, INTRINSICS, np.array(T, float))


def turn(axis, angle_deg):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(axis, angle_deg, degrees=True).as_matrix()
    return T


def pitched(angle_deg):
    return LEVEL @ turn("x", -angle_deg)


@pytest.mark.parametrize("turns", range(-3, 8))
def test_turns_compose_and_each_pixel_keeps_its_point_in_the_world(turns):
    original = frame()
    other = turned(original, turns)
    back = turned(other, -turns)
    for name in ("rgb", "depth_m", "T_world_camera"):
        np.testing.assert_array_equal(getattr(back, name), getattr(original, name))
    assert back.intrinsics == original.intrinsics
    points = []
    for seen in (original, other):
        rows, columns = np.mgrid[: seen.depth_m.shape[0], : seen.depth_m.shape[1]]
        camera = seen.intrinsics.back_project(columns, rows, seen.depth_m.astype(float))
        points.append(camera @ seen.T_world_camera[:3, :3].T + seen.T_world_camera[:3, 3])
    np.testing.assert_allclose(points[1], np.rot90(points[0], turns), atol=1e-9)


@settings(max_examples=40)
@given(turns=st.integers(0, 3), seed=st.integers(0, 1000))
def test_boxes_and_instances_are_turned_back_exactly(turns, seed):
    """A box around each instance of the turned image is the box around it in the original."""
    rng = np.random.default_rng(seed)
    height, width = 12, 20
    instances = np.zeros((height, width), np.uint16)
    for value in (1, 2, 3):
        row, column = rng.integers(0, height - 3), rng.integers(0, width - 4)
        instances[row : row + rng.integers(1, 4), column : column + rng.integers(1, 5)] = value
    seen = np.ascontiguousarray(np.rot90(instances, turns))
    values = [value for value in (1, 2, 3) if (instances == value).any()]
    boxes, expected = (
        np.array([box_of(image == value) for value in values]) for image in (seen, instances)
    )
    count, vocabulary = len(values), Vocabulary(("cup",), ("on",))
    of_objects = vocabulary, boxes, np.ones((count, 1)), np.ones(count), Relations.none(1)
    graph = FrameGraph(0, "camera", seen.shape[1], seen.shape[0], *of_objects)
    again, instances_again = turned_back(graph, seen, turns)
    np.testing.assert_array_equal(instances_again, instances)
    np.testing.assert_array_equal(again.boxes_xyxy, expected)
    assert (again.width, again.height) == (width, height)


@pytest.mark.parametrize("mounted", range(4))
@pytest.mark.parametrize("pitch_deg", [-20, 0, 40])
def test_a_camera_on_its_side_is_turned_upright(mounted, pitch_deg):
    upright = frame(pitched(pitch_deg))
    uprighter = Uprighter("z")
    seen = uprighter.turn(turned(upright, mounted))
    assert seen.turns == (4 - mounted) % 4
    np.testing.assert_array_equal(seen.upright.rgb, upright.rgb)
    np.testing.assert_allclose(seen.upright.T_world_camera, upright.T_world_camera, atol=1e-12)
    # Looking straight down, up has no direction in the image: the turn stays.
    assert uprighter.turn(turned(frame(pitched(88)), mounted)).turns == seen.turns


@pytest.mark.parametrize("mounted", [1, 3])
def test_up_needs_no_name_if_the_camera_began_on_its_side(mounted):
    uprighter = Uprighter("auto")
    for yaw_deg in np.linspace(0, 290, 30):
        item = turned(frame(turn("z", yaw_deg) @ pitched(25)), mounted)
        assert uprighter.turn(item).turns == 4 - mounted


def test_upright_frames_stay_the_same_object():
    for T in (LEVEL, pitched(30), np.eye(4)):  # np.eye: the world of an odometry
        original = frame(T)
        assert Uprighter("auto").turn(original).upright is original
    # The world of an odometry has z forward; after a turn to the side, z is along the image's rows.
    uprighter = Uprighter("auto")
    for yaw_deg in [*np.linspace(0, 90, 10), *[90] * 50]:
        assert uprighter.turn(frame(turn("y", yaw_deg))).turns == 0


@pytest.mark.parametrize("refined", [True, False])
def test_perception_sees_the_upright_image_unless_it_is_the_papers(refined):
    backend = Backend()
    config = PerceptionConfig(refine_detections=refined, max_relations=0)
    perception = Perception(backend, backend, backend, config)
    camera = turned(frame(), 1)  # 90 degrees counter-clockwise
    perceived = perception.perceive(camera)
    height, width = camera.depth_m.shape
    graph = perceived.frame_graph
    assert (graph.height, graph.width) == perceived.instances.shape == (height, width)
    assert backend.shapes == [(width, height) if refined else (height, width)]
    assert perceived.turns == (3 if refined else 0)
    if refined:
        # The top left of the upright image is the bottom left of the camera's.
        np.testing.assert_array_equal(graph.boxes_xyxy[0], [10, height - 41, 35, height - 11])
        assert box_of(perceived.instances == 1).tolist() == [0, height - 6, 2, height - 3]
        again = perception.perceive(replace(camera, stamp_ns=1))
        np.testing.assert_array_equal(again.instances, perceived.instances)
