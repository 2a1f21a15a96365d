"""Labels of the live viewer never overlap, and the heavier ones are there."""

from __future__ import annotations

import numpy as np
import pytest

from deworldsg_ros.scene.arrays import shared_areas
from deworldsg_ros.view.live.drawing import Label
from deworldsg_ros.view.live.scene import (
    ANCHORS,
    FRAME_PX,
    HEIGHT_PX,
    LETTER_PX,
    Camera,
    overview,
    place,
)

# Looks along +y, z is up: x right, y down is -z.
AHEAD = Camera(np.zeros(3), np.array([np.sqrt(0.5), -np.sqrt(0.5), 0, 0]), np.pi / 2, 800.0, 600.0)


def boxes_of(placed, camera):
    shifts = {name: np.array((x, y)) for name, x, y in ANCHORS}
    boxes = []
    for item in placed:
        (point,), _ = camera.project(item.label.position[None])
        half = np.array((FRAME_PX + LETTER_PX * len(item.label.text), HEIGHT_PX)) / 2
        centre = point + shifts[item.anchor] * half
        boxes.append(np.concatenate([centre - half, centre + half]))
    return np.array(boxes).reshape(-1, 4)


def test_a_point_ahead_is_in_the_middle_and_up_is_up():
    points, depths = AHEAD.project(np.array([[0.0, 2.0, 0.0], [0.0, 2.0, 1.0], [1.0, 2.0, 0.0]]))
    np.testing.assert_allclose(points, [(400, 300), (400, 150), (550, 300)], atol=1e-9)
    np.testing.assert_allclose(depths, 2.0)


@pytest.mark.parametrize("count", [0, 1, 40, 400])
def test_labels_do_not_overlap(count):
    rng = np.random.default_rng(count)
    positions = rng.uniform((-2, 1, -1), (2, 6, 1), (count, 3))
    labels = [Label(f"{i}", f"object {i}", p, float(i)) for i, p in enumerate(positions)]
    placed = place(labels, AHEAD, 60)
    assert len(placed) <= 60 and bool(placed) == bool(count)
    shared = shared_areas(boxes_of(placed, AHEAD), boxes_of(placed, AHEAD))
    assert np.abs(shared - np.diag(np.diag(shared))).sum() == pytest.approx(0.0, abs=1e-6)


def test_the_heavier_of_two_labels_at_one_place_has_the_first_choice():
    labels = [Label(f"{i}", "a chair", np.array([0.0, 3.0, 0.0]), float(i)) for i in range(6)]
    placed = place(labels, AHEAD, 60)
    assert [item.label.key for item in placed] == ["5", "4"]
    assert [item.anchor for item in placed] == ["bottom-center", "top-center"]


def test_nothing_behind_the_camera_is_labelled():
    behind = [Label("a", "a", np.array([0.0, -3.0, 0.0]), 1.0)]
    assert place(behind, AHEAD, 10) == []


@pytest.mark.parametrize("aspect", [0.46, 1.6])
def test_the_overview_shows_all_corners(aspect):
    low, high = np.array([-3.0, -2.0, 0.0]), np.array([4.0, 1.0, 2.5])
    position, target = overview(low, high, np.eye(3), 0.85, aspect)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    corners = np.array(np.meshgrid(*zip(low, high))).reshape(3, -1).T
    x, y, z = axes @ (corners - position).T
    assert (z > 0).all()
    assert (np.abs(y / z) < np.tan(0.85 / 2)).all()
    assert (np.abs(x / z) < aspect * np.tan(0.85 / 2)).all()
