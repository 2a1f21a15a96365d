"""A node is sure when it was found often, surely, from more than one place, and is not missed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.merging import VOCABULARY
from support.surfaces import CUP, HERE, depth_grid, frame

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.merging import SurfaceMerging
from deworldsg_ros.merging.absence import HALF, LITTLE
from deworldsg_ros.merging.absence import WHOLE as ALL
from deworldsg_ros.merging.existence import Existence
from deworldsg_ros.merging.limits import LifeCycleLimits
from deworldsg_ros.scene import graph_io
from deworldsg_ros.scene.graph import SceneGraph

STEP_M = 0.05  # 4 degrees, seen from the cup


class Walk:
    """A cup before a wall, and a camera that goes sideways or stands, at 10 frames a second."""

    def __init__(self, **limits: float) -> None:
        self.graph = SceneGraph(VOCABULARY, "world")
        self.merging = SurfaceMerging(MergingConfig(), LifeCycleLimits(**limits))
        self.stamp = 0
        self.x_m = 0.0

    def see(
        self,
        *,
        found: bool,
        step_m: float = STEP_M,
        z_m: float = 0.0,
        score: float = 0.9,
        part: np.ndarray = HERE,
    ):
        """One frame in which the cup is there, detected (as this part of it) or not."""
        self.stamp += 1
        self.x_m += step_m
        pose = np.eye(4)
        pose[:3, 3] = self.x_m, 0.0, z_m
        points = HERE - pose[:3, 3].astype(np.float32)
        in_view = points[np.abs(points[:, 0]) < points[:, 2]]
        grid = depth_grid(in_view, background_m=1.0 - z_m)
        changes = {"T_world_camera": pose, "depth_grid": grid}
        if found:
            changes["scores"] = np.array([score])
        objects = [(part, CUP)] if found else []
        self.merging.merge(self.graph, frame(self.stamp, *objects, **changes))

    def reload(self, path: Path) -> None:
        """Go on with the graph as it was saved, and nothing else."""
        graph_io.save(self.graph, path)
        self.graph = graph_io.load(path)
        self.merging = SurfaceMerging(MergingConfig())
        self.merging.restore(self.graph, {})

    @property
    def told(self) -> list[int]:
        return list(self.graph.node_states(1))


def test_three_frames_of_one_picture_are_not_yet_an_object():
    walk = Walk()
    for _ in range(5):
        walk.see(found=True, step_m=0.001)
    assert walk.told == []
    walk.see(found=True, step_m=0.001)  # but it is not waited for longer than half a second
    assert walk.told == [1]


@pytest.mark.parametrize("step_m", [0.0, STEP_M])
def test_three_frames_are_enough_where_the_camera_moves_on_or_cannot(step_m):
    walk = Walk()
    for told in ([], [], [1]):
        walk.see(found=True, step_m=step_m)
        assert walk.told == told


def test_without_one_sure_detection_it_takes_four_times_as_many():
    walk = Walk()
    for _ in range(11):
        walk.see(found=True, step_m=0.02, score=0.4)
    assert walk.told == []
    walk.see(found=True, step_m=0.02, score=0.4)
    assert walk.told == [1]
    off = Walk(confirm_score=0.0)
    for _ in range(3):
        off.see(found=True, score=0.4)
    assert off.told == [1]


def test_what_is_missed_from_most_places_is_in_doubt_and_comes_back_when_found():
    walk = Walk()
    for _ in range(3):
        walk.see(found=True)
    for _ in range(4):
        walk.see(found=False)
    assert walk.told == [1]  # 3 of 7 looks
    walk.see(found=False)
    assert walk.told == []
    for _ in range(2):
        walk.see(found=True)
    assert walk.told == [1]
    row = walk.graph.nodes.row(1)
    assert walk.graph.nodes.observations[row] == 5


def test_what_is_in_doubt_keeps_its_id_however_long_it_is_not_seen():
    walk = Walk(expire_tentative_s=1.0)
    for _ in range(3):
        walk.see(found=True)
    for _ in range(20):
        walk.see(found=False, step_m=0.02)
    assert walk.told == [] and walk.graph.nodes.ids.tolist() == [1]
    for _ in range(30):
        walk.see(found=True, step_m=0.01)
    assert walk.told == [1]


@pytest.mark.parametrize(
    ("frames", "step_m", "z_m"),
    [
        (60, 0.0, 0.0),  # the camera stands: one look, which found it before
        (12, 0.0, -0.4),  # further away than it was ever detected from
        (3, 1.2, 0.0),  # out of view
    ],
)
def test_what_need_not_be_detected_stays(frames, step_m, z_m):
    walk = Walk()
    for _ in range(11):
        walk.see(found=True, step_m=0.0)
    for _ in range(frames):
        walk.see(found=False, step_m=step_m, z_m=z_m)
        if z_m:
            walk.x_m += 0.02
    assert walk.told == [1]


@pytest.mark.parametrize(("found", "told"), [(10, []), (11, [1])])
def test_what_was_found_for_a_moment_only_is_no_object_when_missed_since(found, told):
    walk = Walk()
    for _ in range(found):
        walk.see(found=True, step_m=0.02)
    for _ in range(4):
        walk.see(found=False, step_m=0.02)
    assert walk.told == [1]  # one look in two finds an object: 4 may miss it, but not 5
    walk.see(found=False, step_m=0.02)
    assert walk.told == told
    walk.see(found=True, step_m=0.02)
    assert walk.told == [1]


def test_a_camera_that_stands_waits_for_an_error_to_come_again():
    walk = Walk()
    for _ in range(5):
        walk.see(found=True, step_m=0.0)
    for _ in range(20):
        walk.see(found=False, step_m=0.0)
    assert walk.told == [1]
    for _ in range(10):
        walk.see(found=False, step_m=0.0)
    assert walk.told == [] and walk.graph.nodes.ids.tolist() == [1]


def test_a_second_error_at_one_place_is_for_a_moment_too():
    walk = Walk()
    for _ in range(2):
        for _ in range(5):
            walk.see(found=True, step_m=0.02)
        for _ in range(5):
            walk.see(found=False, step_m=0.02)
        assert walk.told == []


def new_existence() -> Existence:
    return Existence(MergingConfig().confirm_observations, LifeCycleLimits())


def looked(existence: Existence, owner: int, stamp: int, view: int | None) -> list[int]:
    """Another look at an owner, which finds it (None) or misses it in a view; who is in doubt."""
    camera_world, means_world = np.array([0.1 * stamp, 0, 0]), np.array([[0.1 * stamp, 0, 1.0]])
    if view is not None:
        views = np.array([view])
        return existence.missed([owner], views, means_world, camera_world, stamp * 10**8)
    existence.detected([owner], means_world, np.ones(1), camera_world, stamp * 10**8)
    existence.viewed([owner], np.array([ALL]))
    return []


@pytest.mark.parametrize(("view", "looks"), [(ALL, 2), (HALF, 5), (LITTLE, 5)])
def test_where_objects_are_found_in_almost_every_look_fewer_misses_tell(view, looks):
    existence = new_existence()
    for stamp in range(50):
        looked(existence, 0, stamp, None)
    for stamp in range(50, 55):
        looked(existence, 1, stamp, None)
    missed = [looked(existence, 1, 55 + index, view) for index in range(looks)]
    assert missed == [[]] * (looks - 1) + [[1]]


def test_what_is_in_doubt_and_merged_into_what_was_never_sure_does_not_expire():
    walk = Walk(expire_tentative_s=2.0)
    left, right = (HERE[np.abs(HERE[:, 0] - x_m) < 0.01] for x_m in (0.26, 0.34))
    walk.see(found=True, part=left, score=0.3)
    for _ in range(3):
        walk.see(found=True, part=right)
    assert walk.told == [2]
    for _ in range(12):
        walk.see(found=False, step_m=0.02)
    for _ in range(3):
        walk.see(found=True, step_m=0.0)
    assert walk.told == [] and walk.graph.nodes.ids.tolist() == [1]
    for _ in range(25):
        walk.see(found=False, step_m=0.0)
    assert walk.graph.nodes.ids.tolist() == [1]


def test_a_loaded_node_is_sure_and_stays_in_what_it_was(tmp_path):
    walk = Walk()
    for _ in range(3):
        walk.see(found=True)
    walk.reload(tmp_path / "graph.npz")
    walk.see(found=False)
    assert walk.told == [1]
    walk.see(found=True)
    assert walk.told == [1] and walk.graph.nodes.ids.tolist() == [1]


def test_a_loaded_node_was_missed_in_no_look_before(tmp_path):
    walk = Walk()
    for _ in range(3):
        walk.see(found=True)
    walk.reload(tmp_path / "graph.npz")
    walk.see(found=True)
    for _ in range(3):
        walk.see(found=False)
    assert walk.told == [1]  # 2 of 5 looks
    walk.see(found=False)
    assert walk.told == []


@pytest.mark.parametrize("behind_s", [0, 10**6])
def test_what_was_known_long_stays_known_under_a_clock_that_is_behind(behind_s: int) -> None:
    def camera(look: int) -> np.ndarray:
        return 2.0 * np.array([np.cos(0.3 * look), np.sin(0.3 * look), 0.0])

    def stamp_ns(look: int) -> int:
        return (10**7 + look) * 10**9

    cup = np.zeros((1, 3))
    earlier, later = new_existence(), new_existence()
    for look in range(20):
        earlier.detected([0], cup, np.ones(1), camera(look), stamp_ns(look))
        earlier.viewed([0], np.array([ALL]))
    later.restore([0], earlier.records([0]), earlier.by_view)
    later.detected([0], cup, np.ones(1), camera(20), stamp_ns(20 - behind_s))
    for look in range(21, 26):
        missed = later.missed([0], np.array([ALL]), cup, camera(look), stamp_ns(look - behind_s))
        assert not missed
