"""Absent objects are removed, moved objects keep their id, and occluded objects stay."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from support.merging import VOCABULARY, seeds
from support.surfaces import CAMERA, CHAIR, CUP, HERE, TABLE, WALL_M, WHOLE, depth_grid, frame, slab

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.merging import SurfaceMerging
from deworldsg_ros.merging.absence import (
    FULL,
    HALF,
    NOT_VISIBLE,
    QUARTER,
    SAMPLED_POINTS,
    AbsenceEvidence,
)
from deworldsg_ros.merging.limits import LifeCycleLimits
from deworldsg_ros.scene.frame_graph import DepthGrid
from deworldsg_ros.scene.graph import SceneGraph
from deworldsg_ros.scene.nodes import NodeTable

THERE = slab((-0.4, -0.1, 0.7), (0.08, 0.08, 0.06))


class Scene:
    """A graph, its association rule, and a clock."""

    def __init__(self, **limits: float) -> None:
        self.graph = SceneGraph(VOCABULARY, "world")
        self.merging = SurfaceMerging(MergingConfig(), LifeCycleLimits(**limits))
        self.stamp = 0

    def see(self, *objects: tuple[np.ndarray, int], grid: DepthGrid | None = None) -> list[int]:
        """One frame of the objects. The default depth shows them before the wall."""
        self.stamp += 1
        grid = depth_grid(*(p for p, kind in objects if kind != TABLE)) if grid is None else grid
        return self.merging.merge(self.graph, frame(self.stamp, *objects, depth_grid=grid))

    def published(self) -> dict[int, str]:
        return {node_id: node.label for node_id, node in self.graph.node_states(1).items()}


@pytest.fixture
def scene() -> Scene:
    scene = Scene()
    for _ in range(4):
        scene.see((WHOLE, TABLE), (HERE, CUP))
    assert scene.published() == {1: "table", 2: "cup"}
    return scene


def test_a_node_is_removed_after_five_frames_that_see_through_it(scene) -> None:
    for _ in range(4):
        scene.see((WHOLE, TABLE))
    assert scene.published() == {1: "table", 2: "cup"}
    scene.see((WHOLE, TABLE))
    assert scene.published() == {1: "table"}


def test_a_lost_node_is_removed_after_its_time_limit() -> None:
    scene = Scene(lost_s=10e-9)
    for _ in range(4):
        scene.see((HERE, CUP))
    for _ in range(30):
        scene.see()
    assert len(scene.graph) == 0
    for _ in range(3):
        scene.see((HERE, CUP))
    assert scene.published() == {2: "cup"}


def test_a_present_object_that_is_not_detected_stays(scene) -> None:
    for _ in range(8):
        scene.see((WHOLE, TABLE), (HERE, CUP))
    for _ in range(50):
        scene.see((WHOLE, TABLE), grid=depth_grid(HERE))
    assert scene.published() == {1: "table", 2: "cup"}


def test_only_consecutive_frames_that_see_through_count(scene) -> None:
    for index in range(20):
        scene.see((WHOLE, TABLE), grid=depth_grid(*([HERE] if index % 4 == 3 else [])))
    assert scene.published() == {1: "table", 2: "cup"}


def test_an_occluded_or_invisible_object_stays(scene) -> None:
    hidden = depth_grid(background_m=0.4)
    blind = DepthGrid(np.zeros((60, 80), np.uint16), 8, CAMERA)
    for _ in range(10):
        scene.see(grid=hidden)
        scene.see(grid=blind)
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])  # half a turn about y
    for stamp in range(100, 110):
        local = frame(stamp, T_world_camera=turned, depth_grid=depth_grid(background_m=4.0))
        scene.merging.merge(scene.graph, local)
    assert scene.published() == {1: "table", 2: "cup"}


def test_a_moved_object_keeps_its_id(scene) -> None:
    for _ in range(8):
        ids = scene.see((WHOLE, TABLE), (THERE, CUP))
    assert ids == [1, 2]
    assert scene.published() == {1: "table", 2: "cup"}
    row = scene.graph.nodes.row(2)
    assert scene.graph.nodes.means[row] == pytest.approx(THERE.mean(axis=0), abs=1e-3)
    assert scene.graph.nodes.observations[row] == 12
    assert scene.see((THERE, CUP)) == [2]
    assert scene.graph.take_removals() == {3: 2}


def test_an_object_that_was_absent_for_a_while_keeps_its_id(scene) -> None:
    for _ in range(8):
        scene.see((WHOLE, TABLE))
    assert scene.published() == {1: "table"}
    for _ in range(3):
        ids = scene.see((WHOLE, TABLE), (THERE, CUP))
    assert ids == [1, 2]
    assert scene.published() == {1: "table", 2: "cup"}


def test_another_class_or_a_late_object_is_a_new_node() -> None:
    for kind, pause in ((CHAIR, 0), (CUP, 30)):
        scene = Scene(lost_s=2.0)
        for _ in range(4):
            scene.see((WHOLE, TABLE), (HERE, CUP))
        for _ in range(8 + pause):
            scene.see((WHOLE, TABLE))
        for _ in range(3):
            scene.see((WHOLE, TABLE), (THERE, kind))
        assert scene.published() == {1: "table", 3: VOCABULARY.classes[kind]}


def test_a_tentative_node_that_is_seen_through_is_removed() -> None:
    scene = Scene()
    scene.see((WHOLE, TABLE), (HERE, CUP))
    for _ in range(6):
        scene.see((WHOLE, TABLE))
    assert scene.graph.nodes.ids.tolist() == [1]


def evidence_of(points: np.ndarray, absent_frames: int = 1) -> AbsenceEvidence:
    """Evidence for one node, owner 0, with these surface points."""
    nodes = NodeTable(1, SAMPLED_POINTS)
    nodes.set_surface(nodes.append(1), points.astype(np.float32))
    evidence = AbsenceEvidence(absent_frames)
    evidence.update_points([0], nodes, [0])
    return evidence


def observe(evidence: AbsenceEvidence, detected: list[int], background_m: float = WALL_M):
    """The absent owners, and the visibility of owner 0."""
    grid = depth_grid(background_m=background_m)
    absent, visibilities = evidence.observe(np.eye(4), grid, detected)
    return absent, visibilities[0]


@pytest.mark.parametrize(
    ("z_m", "absent", "visibility"),
    [(0.7, [0], NOT_VISIBLE), (1.0, [], FULL), (1.5, [], NOT_VISIBLE)],
)
def test_points_before_on_and_behind_the_measured_depth(z_m, absent, visibility) -> None:
    points = np.stack([np.linspace(-0.2, 0.2, 10), np.zeros(10), np.full(10, z_m)], axis=1)
    assert observe(evidence_of(points), []) == (absent, visibility)
    assert observe(evidence_of(points), [0]) == ([], visibility)
    assert observe(evidence_of(points[:0]), []) == ([], NOT_VISIBLE)


@pytest.mark.parametrize(
    ("left_m", "visibility"), [(-1.0, FULL), (-1.7, HALF), (-2.4, QUARTER), (-2.8, NOT_VISIBLE)]
)
def test_visibility_of_a_node_cut_by_the_image_border(left_m, visibility) -> None:
    # The image ends at 1.07 m to the left.
    x_m = np.linspace(left_m, left_m + 2, 40)
    points = np.stack([x_m, np.zeros(40), np.full(40, WALL_M)], axis=1)
    assert observe(evidence_of(points), []) == ([], visibility)


def test_a_node_cut_by_the_image_border_is_present_or_seen_through() -> None:
    # The image ends at 1.07 m to the left, and nearer to the camera sooner.
    points = np.stack([np.linspace(-1.4, 0.6, 10), np.zeros(10), np.full(10, WALL_M)], axis=1)
    evidence = evidence_of(points, absent_frames=2)
    assert observe(evidence, [], background_m=3.0) == ([], NOT_VISIBLE)
    assert observe(evidence, []) == ([], HALF)
    assert observe(evidence, [], background_m=3.0) == ([], NOT_VISIBLE)
    assert observe(evidence, [], background_m=3.0) == ([0], NOT_VISIBLE)


@given(seeds)
@settings(max_examples=100)
def test_a_node_is_judged_if_half_of_it_is_in_the_image(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centre = rng.uniform((-3.5, -2.6, -0.5), (3.5, 2.6, 3.0))
    # A part of it is elsewhere, so that its centre is not on it.
    apart = rng.random((40, 1)) < 0.45
    points = centre + rng.uniform(-0.2, 0.2, (40, 3)) + apart * rng.uniform(-6, 6, 3)
    points = points.astype(np.float32)
    x, y, z = points.astype(np.float64).T
    inside = z >= 0.1
    z = np.where(inside, z, 1.0)
    inside &= (np.abs(300 * x / z + 319.5 - 320) < 320) & (np.abs(300 * y / z + 239.5 - 240) < 240)
    absent, _ = evidence_of(points).observe(np.eye(4), depth_grid(background_m=60.0), [])
    assert absent == ([0] if inside.sum() >= 20 else [])
