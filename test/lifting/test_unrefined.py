"""Lifting without depth refinement: masks or boxes."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from deworldsg_ros.config import LiftingConfig
from deworldsg_ros.lifting.refine import masks_of
from deworldsg_ros.lifting.stage import Lifting, box_pixels, mask_pixels
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import FrameGraph, LocalGraph, Relations, Vocabulary

CAMERA = Intrinsics(50.0, 50.0, 20.0, 15.0, 40, 30)


def lift(depth_m: np.ndarray, instances: np.ndarray, boxes: list, **settings: object) -> LocalGraph:
    count = len(boxes)
    graph = FrameGraph(
        0,
        "camera",
        40,
        30,
        Vocabulary(("object",), ()),
        np.array(boxes, np.float64).reshape(-1, 4),
        np.ones((count, 1)),
        np.ones(count),
        Relations.none(0),
    )
    config = msgspec.structs.replace(LiftingConfig(), **settings)
    return Lifting(config).lift(graph, instances, depth_m, CAMERA, np.eye(4), "world")


@pytest.fixture
def scene() -> tuple[np.ndarray, np.ndarray, list]:
    """An object at 1 m, seen on a part of its box, before a wall at 3 m; one flying pixel."""
    depth_m = np.full((30, 40), 3.0, np.float32)
    depth_m[10:20, 10:20] = 1.0
    instances = np.zeros((30, 40), np.uint16)
    instances[10:20, 10:20] = 1
    depth_m[15, 15] = 2.0
    return depth_m, instances, [[8, 8, 21, 21]]


def test_masks_are_refined_by_default(scene: tuple) -> None:
    lifted = lift(*scene)
    assert lifted.pixel_counts.tolist() == [99 - 4]  # the flying pixel, and the mask's corners
    assert lifted.depths_m[0] == pytest.approx(1.0)


def test_masks_without_refinement(scene: tuple) -> None:
    lifted = lift(*scene, pixels="mask")
    assert lifted.pixel_counts.tolist() == [100]
    assert lifted.depths_m[0] == pytest.approx(1.01)


def test_boxes_without_refinement_contain_the_wall(scene: tuple) -> None:
    lifted = lift(*scene, pixels="box")
    assert lifted.pixel_counts.tolist() == [14 * 14]
    assert lifted.depths_m[0] == pytest.approx((99 + 2 + 96 * 3) / 196)


def test_boxes_may_overlap_and_leave_the_image() -> None:
    depth_m = np.full((30, 40), 2.0, np.float32)
    depth_m[:, 0] = 0.0
    boxes = np.array([[-5, -5, 4.5, 4.5], [2, 2, 4.5, 4.5], [50, 50, 60, 60], [3.2, 3.2, 3.8, 9]])
    found = [box_pixels(depth_m, box) for box in boxes]
    assert [len(pixels) for pixels in found] == [4 * 5, 3 * 3, 0, 0]
    assert (found[1].columns.min(), found[1].rows.max()) == (2, 4)


def test_a_box_without_depth_is_dropped_with_a_reason() -> None:
    no_depth = np.zeros((30, 40), np.float32)
    instances = np.zeros((30, 40), np.uint16)
    lifted = lift(no_depth, instances, [[0, 0, 20, 20]], pixels="box")
    assert (len(lifted), lifted.drops) == (0, {"few_mask_pixels": 1})
    lifted = lift(no_depth, instances, [], pixels="box")
    assert len(lifted) == 0


def test_a_rectangular_mask_has_the_pixels_of_its_box() -> None:
    generator = np.random.default_rng(3)
    depth_m = generator.uniform(1.0, 1.1, (30, 40)).astype(np.float32)
    depth_m[generator.random((30, 40)) < 0.2] = 0.0
    instances = np.zeros((30, 40), np.uint16)
    instances[5:25, 7:33] = 1
    mask = mask_pixels(depth_m, masks_of(instances, 1).runs_of(0))
    box = box_pixels(depth_m, np.array([7, 5, 32, 24], float))
    assert len(mask) > 0
    np.testing.assert_array_equal(mask.columns, box.columns)
    np.testing.assert_array_equal(mask.rows, box.rows)
    np.testing.assert_array_equal(mask.depths_m, box.depths_m)
