"""A camera on its side: frames are turned upright, results are turned back exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.perception import INTRINSICS, SHAPE

from deworldsg_ros.config import PerceptionConfig
from deworldsg_ros.perception import Detections, Perception
from deworldsg_ros.perception.protocols import MaskPatch
from deworldsg_ros.perception.stage import Uprighter, turned, turned_back
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary

# A level camera that looks along +y of a world whose z points up.
LEVEL = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


def frame(T=LEVEL, seed=0, stamp_ns=0):
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 255, (*SHAPE, 3), np.uint8)
    depth_m = rng.uniform(0.5, 3, SHAPE).astype(np.float32)
    return RgbdFrame(stamp_ns, rgb, depth_m, INTRINSICS, np.array(T, float))


def pitched(angle_deg):
    """LEVEL, looking down by an angle."""
    angle = np.radians(angle_deg)
    turn = np.eye(4)
    turn[1:3, 1:3] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    return LEVEL @ turn


@pytest.mark.parametrize("turns", range(-3, 8))
def test_turns_compose_to_the_same_frame(turns):
    original = frame()
    back = turned(turned(original, turns), -turns)
    np.testing.assert_array_equal(back.rgb, original.rgb)
    np.testing.assert_array_equal(back.depth_m, original.depth_m)
    np.testing.assert_array_equal(back.T_world_camera, original.T_world_camera)
    assert back.intrinsics == original.intrinsics


@pytest.mark.parametrize("turns", range(4))
def test_each_pixel_keeps_its_point_in_the_world(turns):
    original = frame()
    other = turned(original, turns)
    points = []
    for seen in (original, other):
        rows, columns = np.mgrid[: seen.depth_m.shape[0], : seen.depth_m.shape[1]]
        camera = seen.intrinsics.back_project(columns, rows, seen.depth_m.astype(float))
        T = seen.T_world_camera
        points.append(np.rot90(camera @ T[:3, :3].T + T[:3, 3], 0))
    np.testing.assert_allclose(points[1], np.rot90(points[0], turns), atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(turns=st.integers(0, 3), seed=st.integers(0, 1000))
def test_boxes_and_instances_are_turned_back_exactly(turns, seed):
    """A box around each instance of the turned image is the box around it in the original."""
    rng = np.random.default_rng(seed)
    height, width = 12, 20
    instances = np.zeros((height, width), np.uint16)
    for value in (1, 2, 3):
        row, column = rng.integers(0, height - 3), rng.integers(0, width - 4)
        instances[row : row + rng.integers(1, 4), column : column + rng.integers(1, 5)] = value
    seen = np.rot90(instances, turns)
    values = [value for value in (1, 2, 3) if (instances == value).any()]
    graph = graph_of([box_around(seen == value) for value in values], seen.shape)
    again, instances_again = turned_back(graph, np.ascontiguousarray(seen), turns)
    np.testing.assert_array_equal(instances_again, instances)
    expected = [box_around(instances == value) for value in values]
    np.testing.assert_array_equal(again.boxes_xyxy, np.reshape(expected, (-1, 4)))
    assert (again.width, again.height) == (width, height)


def box_around(mask):
    rows, columns = np.nonzero(mask)
    return [columns.min(), rows.min(), columns.max(), rows.max()]


def graph_of(boxes, shape):
    count = len(boxes)
    return FrameGraph(
        0,
        "camera",
        shape[1],
        shape[0],
        Vocabulary(("cup",), ("on",)),
        np.array(boxes, float).reshape(-1, 4),
        np.ones((count, 1)),
        np.ones(count),
        Relations.none(1),
    )


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
    turns = set()
    for yaw in np.linspace(0, 5, 30):
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        turns.add(uprighter.turn(turned(frame(turn @ pitched(25)), mounted)).turns)
    assert turns == {4 - mounted}


def test_an_upright_frame_stays_the_same_object():
    for T in (LEVEL, pitched(30), np.eye(4)):  # np.eye: the world of an odometry
        original = frame(T)
        assert Uprighter("auto").turn(original).upright is original


def test_an_odometry_that_begins_at_the_identity_is_never_turned():
    """Its world has z forward; after a turn to the side, z is along the rows of the image."""
    uprighter = Uprighter("auto")
    for yaw in [*np.linspace(0, np.pi / 2, 10), *[np.pi / 2] * 50]:
        T = np.eye(4)
        T[np.ix_([0, 2], [0, 2])] = [[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]
        assert uprighter.turn(frame(T)).turns == 0


class Corner:
    """Detects one object at the top left of the image that it gets."""

    classes = ("cup",)
    predicates = ("on",)
    default_score_threshold = 0.5

    def __init__(self):
        self.shapes = []

    def detect(self, rgb, score_threshold):
        self.shapes.append(rgb.shape[:2])
        return Detections(np.array([[2.0, 3.0, 10.0, 12.0]]), np.ones((1, 1)), np.ones(1))

    def segment(self, rgb, depth_m, intrinsics, boxes_xyxy):
        return [MaskPatch(3, 2, np.ones((9, 8), bool)) for _ in boxes_xyxy]


@pytest.mark.parametrize("refined", [True, False])
def test_perception_sees_the_upright_image_unless_it_is_the_papers(refined):
    backend = Corner()
    config = PerceptionConfig(refine_detections=refined, max_relations=0)
    perception = Perception(backend, backend, backend, config)
    camera = turned(frame(), 1)  # 90 degrees counter-clockwise
    perceived = perception.perceive(camera)
    height, width = camera.depth_m.shape
    graph = perceived.frame_graph
    assert (graph.height, graph.width) == perceived.instances.shape == (height, width)
    if not refined:
        assert backend.shapes == [(height, width)]
        assert perceived.turns == 0
        return
    assert backend.shapes == [(width, height)]
    assert perceived.turns == 3
    # The top left of the upright image is the bottom left of the camera's.
    np.testing.assert_array_equal(graph.boxes_xyxy, [[3.0, height - 11.0, 12.0, height - 3.0]])
    rows, columns = np.nonzero(perceived.instances)
    assert (columns.min(), columns.max()) == (3, 11)
    assert (rows.min(), rows.max()) == (height - 10, height - 3)
    again = perception.perceive(replace(camera, stamp_ns=1))
    np.testing.assert_array_equal(again.instances, perceived.instances)
