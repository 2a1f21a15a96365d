"""A node is confirmed by enough detections, from more than one viewpoint, with few misses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.merging import VOCABULARY
from support.surfaces import CUP, HERE, depth_grid, frame

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.merging import SurfaceMerging
from deworldsg_ros.merging.absence import FULL, HALF, QUARTER
from deworldsg_ros.merging.existence import Existence
from deworldsg_ros.merging.limits import LifeCycleLimits
from deworldsg_ros.scene import graph_io
from deworldsg_ros.scene.graph import SceneGraph

STEP_M = 0.05  # 4 degrees, seen from the cup


class Walk:
    """A cup before a wall, and a camera that moves sideways or stands still, at 10 frames/s."""

    def __init__(self, **limits: float) -> None:
        self.graph = SceneGraph(VOCABULARY, "world")
        self.merging = SurfaceMerging(MergingConfig(), LifeCycleLimits(**limits))
        self.stamp = 0
        self.x_m = 0.0

    def see(
        self,
        *,
        detected: bool,
        step_m: float = STEP_M,
        z_m: float = 0.0,
        score: float = 0.9,
        part: np.ndarray = HERE,
    ):
        """One frame of the cup, detected (only this part of it) or not."""
        self.stamp += 1
        self.x_m += step_m
        pose = np.eye(4)
        pose[:3, 3] = self.x_m, 0.0, z_m
        points = HERE - pose[:3, 3].astype(np.float32)
        in_view = points[np.abs(points[:, 0]) < points[:, 2]]
        grid = depth_grid(in_view, background_m=1.0 - z_m)
        changes = {"T_world_camera": pose, "depth_grid": grid}
        if detected:
            changes["scores"] = np.array([score])
        objects = [(part, CUP)] if detected else []
        self.merging.merge(self.graph, frame(self.stamp, *objects, **changes))

    def reload(self, path: Path) -> None:
        """Continue with the saved graph alone, without the memory of the rule."""
        graph_io.save(self.graph, path)
        self.graph = graph_io.load(path)
        self.merging = SurfaceMerging(MergingConfig())
        self.merging.restore(self.graph, {})

    @property
    def published(self) -> list[int]:
        return list(self.graph.node_states(1))


def test_a_slow_camera_confirms_after_half_a_second():
    walk = Walk()
    for _ in range(5):
        walk.see(detected=True, step_m=0.001)
    assert walk.published == []
    walk.see(detected=True, step_m=0.001)
    assert walk.published == [1]


@pytest.mark.parametrize("step_m", [0.0, STEP_M])
def test_three_frames_confirm_if_the_camera_moves_or_stands_still(step_m):
    walk = Walk()
    for expected in ([], [], [1]):
        walk.see(detected=True, step_m=step_m)
        assert walk.published == expected


def test_low_scores_need_four_times_the_observations():
    walk = Walk()
    for _ in range(11):
        walk.see(detected=True, step_m=0.02, score=0.4)
    assert walk.published == []
    walk.see(detected=True, step_m=0.02, score=0.4)
    assert walk.published == [1]
    low_limit = Walk(confirm_score=0.0)
    for _ in range(3):
        low_limit.see(detected=True, score=0.4)
    assert low_limit.published == [1]


def test_a_node_missed_from_most_viewpoints_is_hidden_until_it_is_detected_again():
    walk = Walk()
    for _ in range(3):
        walk.see(detected=True)
    for _ in range(4):
        walk.see(detected=False)
    assert walk.published == [1]  # 3 of 7 viewpoints
    walk.see(detected=False)
    assert walk.published == []
    for _ in range(2):
        walk.see(detected=True)
    assert walk.published == [1]
    row = walk.graph.nodes.row(1)
    assert walk.graph.nodes.observations[row] == 5


def test_a_hidden_node_keeps_its_id():
    walk = Walk(expire_tentative_s=1.0)
    for _ in range(3):
        walk.see(detected=True)
    for _ in range(20):
        walk.see(detected=False, step_m=0.02)
    assert walk.published == [] and walk.graph.nodes.ids.tolist() == [1]
    for _ in range(30):
        walk.see(detected=True, step_m=0.01)
    assert walk.published == [1]


@pytest.mark.parametrize(
    ("frames", "step_m", "z_m"),
    [
        (60, 0.0, 0.0),  # the camera stands still: one viewpoint, which detected it
        (12, 0.0, -0.4),  # further away than any detection
        (3, 1.2, 0.0),  # out of view
    ],
)
def test_misses_that_are_no_evidence_keep_the_node(frames, step_m, z_m):
    walk = Walk()
    for _ in range(11):
        walk.see(detected=True, step_m=0.0)
    for _ in range(frames):
        walk.see(detected=False, step_m=step_m, z_m=z_m)
        if z_m:
            walk.x_m += 0.02
    assert walk.published == [1]


@pytest.mark.parametrize(("frames", "expected"), [(10, []), (11, [1])])
def test_a_node_detected_for_one_second_only_is_hidden_after_five_misses(frames, expected):
    walk = Walk()
    for _ in range(frames):
        walk.see(detected=True, step_m=0.02)
    for _ in range(4):
        walk.see(detected=False, step_m=0.02)
    assert walk.published == [
        1
    ]  # at a detection rate of 1/2, four misses have probability 0.06, five 0.03
    walk.see(detected=False, step_m=0.02)
    assert walk.published == expected
    walk.see(detected=True, step_m=0.02)
    assert walk.published == [1]


def test_a_camera_that_stands_still_hides_a_missed_node_later():
    walk = Walk()
    for _ in range(5):
        walk.see(detected=True, step_m=0.0)
    for _ in range(20):
        walk.see(detected=False, step_m=0.0)
    assert walk.published == [1]
    for _ in range(10):
        walk.see(detected=False, step_m=0.0)
    assert walk.published == [] and walk.graph.nodes.ids.tolist() == [1]


def test_a_second_momentary_error_at_the_same_position_is_hidden_too():
    walk = Walk()
    for _ in range(2):
        for _ in range(5):
            walk.see(detected=True, step_m=0.02)
        for _ in range(5):
            walk.see(detected=False, step_m=0.02)
        assert walk.published == []


def new_existence() -> Existence:
    return Existence(MergingConfig().confirm_observations, LifeCycleLimits())


def new_viewpoint(
    existence: Existence, owner: int, stamp: int, missed: int | None = None
) -> list[int]:
    """A viewpoint that detects an owner, or misses it at a visibility; the doubtful owners."""
    camera_world, means_world = np.array([0.1 * stamp, 0, 0]), np.array([[0.1 * stamp, 0, 1.0]])
    if missed is not None:
        visibilities = np.array([missed])
        return existence.add_misses([owner], visibilities, means_world, camera_world, stamp * 10**8)
    existence.add_detections([owner], means_world, np.ones(1), camera_world, stamp * 10**8)
    existence.update_visibility([owner], np.array([FULL]))
    return []


@pytest.mark.parametrize(("visibility", "viewpoints"), [(FULL, 2), (HALF, 5), (QUARTER, 5)])
def test_at_a_high_detection_rate_fewer_misses_suffice(visibility, viewpoints):
    existence = new_existence()
    for stamp in range(50):
        new_viewpoint(existence, 0, stamp)
    for stamp in range(50, 55):
        new_viewpoint(existence, 1, stamp)
    doubtful = [new_viewpoint(existence, 1, 55 + i, visibility) for i in range(viewpoints)]
    assert doubtful == [[]] * (viewpoints - 1) + [[1]]


def test_a_hidden_node_merged_into_a_tentative_one_does_not_expire():
    walk = Walk(expire_tentative_s=2.0)
    left, right = (HERE[np.abs(HERE[:, 0] - x_m) < 0.01] for x_m in (0.26, 0.34))
    walk.see(detected=True, part=left, score=0.3)
    for _ in range(3):
        walk.see(detected=True, part=right)
    assert walk.published == [2]
    for _ in range(12):
        walk.see(detected=False, step_m=0.02)
    for _ in range(3):
        walk.see(detected=True, step_m=0.0)
    assert walk.published == [] and walk.graph.nodes.ids.tolist() == [1]
    for _ in range(25):
        walk.see(detected=False, step_m=0.0)
    assert walk.graph.nodes.ids.tolist() == [1]


def test_a_loaded_node_is_confirmed(tmp_path):
    walk = Walk()
    for _ in range(3):
        walk.see(detected=True)
    walk.reload(tmp_path / "graph.npz")
    walk.see(detected=False)
    assert walk.published == [1]
    walk.see(detected=True)
    assert walk.published == [1] and walk.graph.nodes.ids.tolist() == [1]


def test_a_loaded_node_has_no_misses(tmp_path):
    walk = Walk()
    for _ in range(3):
        walk.see(detected=True)
    walk.reload(tmp_path / "graph.npz")
    walk.see(detected=True)
    for _ in range(3):
        walk.see(detected=False)
    assert walk.published == [1]  # 2 of 5 viewpoints
    walk.see(detected=False)
    assert walk.published == []


@pytest.mark.parametrize("behind_s", [0, 10**6])
def test_a_restored_node_stays_known_if_the_clock_is_behind(behind_s: int) -> None:
    def camera(index: int) -> np.ndarray:
        return 2.0 * np.array([np.cos(0.3 * index), np.sin(0.3 * index), 0.0])

    def stamp_ns(index: int) -> int:
        return (10**7 + index) * 10**9

    cup = np.zeros((1, 3))
    earlier, later = new_existence(), new_existence()
    for index in range(20):
        earlier.add_detections([0], cup, np.ones(1), camera(index), stamp_ns(index))
        earlier.update_visibility([0], np.array([FULL]))
    later.restore([0], earlier.records([0]), earlier.counts_by_visibility)
    later.add_detections([0], cup, np.ones(1), camera(20), stamp_ns(20 - behind_s))
    for index in range(21, 26):
        doubtful = later.add_misses(
            [0], np.array([FULL]), cup, camera(index), stamp_ns(index - behind_s)
        )
        assert not doubtful
