"""Which nodes a frame may show."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from support.merging import seeds
from support.surfaces import depth_grid

from deworldsg_ros.merging.views import BALL_DEVIATIONS, FrameArrays, NodeGrid, frame_arrays
from deworldsg_ros.scene.camera import invert_pose, pose_from_quaternion

# Margin of the comparison with sampled points of a ball, metres.
SMALL_M = 0.02


def any_frame(rng: np.random.Generator) -> FrameArrays:
    quat = rng.normal(size=4)
    T = pose_from_quaternion(rng.uniform(-8, 8, 3), quat / np.linalg.norm(quat))
    return frame_arrays(invert_pose(T), depth_grid(background_m=rng.uniform(0.5, 9.0)))


def shows(frame: FrameArrays, mean: np.ndarray, radius: float, rng: np.random.Generator) -> bool:
    """Whether any of many points of a ball is in the image, before its farthest depth."""
    T, depth_mm, _, (fx, fy, cx, cy) = frame
    steps = rng.normal(size=(500, 3))
    steps *= max(radius - SMALL_M, 0.0) / np.linalg.norm(steps, axis=1, keepdims=True)
    points = (mean + np.concatenate((steps, np.zeros((1, 3))))) @ T[:3, :3].T + T[:3, 3]
    x, y, z = points[points[:, 2] > 0.1].T
    u, v = fx * x / z + cx, fy * y / z + cy
    height, width = depth_mm.shape
    inside = (u > 0) & (v > 0) & (u < width) & (v < height) & (z < 0.001 * depth_mm.max())
    return bool(inside.any())


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_every_node_in_view_is_found_after_any_changes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid, known = NodeGrid(), {}
    for _ in range(12):
        count = int(rng.integers(0, 30))
        slots = rng.choice(150, count, replace=False)
        means, bounds = rng.uniform(-12, 12, (150, 3)), rng.uniform(0.01, 0.6, 150) ** 2
        grid.put(slots, means, bounds)
        known.update({slot: (means[slot], BALL_DEVIATIONS * bounds[slot] ** 0.5) for slot in slots})
        for slot in rng.choice(200, 10).tolist():
            grid.remove(slot)
            known.pop(slot, None)
    frame = any_frame(rng)
    found = grid.in_view(frame).tolist()
    assert len(found) == len(set(found)) and set(found) <= known.keys()
    for slot, (mean, radius) in known.items():
        if slot not in found:
            assert not shows(frame, mean, radius, rng)


def test_nodes_elsewhere_are_not_compared() -> None:
    grid = NodeGrid()
    frame = frame_arrays(np.eye(4), depth_grid(background_m=3.0))
    assert grid.in_view(frame).tolist() == []
    before, beside, behind_the_wall, behind = [0, 0, 2], [50, 0, 2], [0, 0, 30], [0, 0, -30]
    slots, bounds = np.array([3, 5, 7, 9]), np.full(10, 0.01)
    means = np.zeros((10, 3))
    means[slots] = before, beside, behind_the_wall, behind
    grid.put(slots, means, bounds)
    assert grid.in_view(frame).tolist() == [3]
    means[5] = before
    grid.put(np.array([5]), means, bounds)
    assert sorted(grid.in_view(frame).tolist()) == [3, 5]
    grid.remove(3)
    grid.remove(3)
    assert grid.in_view(frame).tolist() == [5]
