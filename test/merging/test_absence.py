"""Absent objects are removed, moved objects keep their id, and occluded objects stay."""

from __future__ import annotations

import numpy as np
import pytest
from support.merging import VOCABULARY
from support.node_states import node_states
from support.surfaces import CAMERA, CHAIR, CUP, HERE, TABLE, WHOLE, depth_grid, frame, slab

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.merging import SurfaceMerging
from deworldsg_ros.scene.frame_graph import DepthGrid

THERE = slab((-0.4, -0.1, 0.7), (0.08, 0.08, 0.06))


class Scene:
    """A graph, its association rule, and a clock."""

    def __init__(self) -> None:
        self.graph = SceneGraph(VOCABULARY, "world")
        self.merging = SurfaceMerging(MergingConfig())
        self.stamp = 0

    def see(self, *objects: tuple[np.ndarray, int], grid: DepthGrid | None = None) -> list[int]:
        """One frame of the objects. The default depth shows them before the wall."""
        self.stamp += 1
        grid = depth_grid(*(p for p, kind in objects if kind != TABLE)) if grid is None else grid
        return self.merging.merge(self.graph, frame(self.stamp, *objects, depth_grid=grid))

    def published(self) -> dict[int, str]:
        return {node_id: node.label for node_id, node in node_states(self.graph, 1).items()}


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
    scene = Scene()
    for _ in range(4):
        scene.see((HERE, CUP))
    for _ in range(5):
        scene.see()
    assert len(scene.graph) == 1 and scene.published() == {}
    scene.stamp += 310
    scene.see()
    assert len(scene.graph) == 0
    for _ in range(12):
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
    row = scene.graph.nodes.slot(2)
    assert scene.graph.nodes.means[row] == pytest.approx(THERE.mean(axis=0), abs=1e-3)
    assert scene.graph.nodes.observations[row] == 12
    assert scene.see((THERE, CUP)) == [2]
    assert scene.graph.take_removals() == {3: 2}


def test_an_object_that_was_absent_for_a_while_keeps_its_id(scene) -> None:
    for _ in range(8):
        scene.see((WHOLE, TABLE))
    assert scene.published() == {1: "table"}
    for _ in range(12):
        ids = scene.see((WHOLE, TABLE), (THERE, CUP))
    assert ids == [1, 2]
    assert scene.published() == {1: "table", 2: "cup"}


def test_another_class_or_a_late_object_is_a_new_node() -> None:
    for kind, pause in ((CHAIR, 0), (CUP, 310)):
        scene = Scene()
        for _ in range(4):
            scene.see((WHOLE, TABLE), (HERE, CUP))
        for _ in range(8):
            scene.see((WHOLE, TABLE))
        scene.stamp += pause
        for _ in range(12):
            scene.see((WHOLE, TABLE), (THERE, kind))
        assert scene.published() == {1: "table", 3: VOCABULARY.classes[kind]}


def test_a_tentative_node_that_is_seen_through_is_removed() -> None:
    scene = Scene()
    scene.see((WHOLE, TABLE))
    scene.see((WHOLE, TABLE), (HERE, CUP))
    for _ in range(6):
        scene.see((WHOLE, TABLE))
    assert list(scene.graph.nodes.slot_of) == [1]
