"""What a frame shows of nodes: which are in view, what is visible, seen through, and covered."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from support.merging import moments, random_pose, seeds
from support.surfaces import CUP, WALL_M, depth_grid, frame, slab

from deworldsg_ros.graph.nodes import NodeTable
from deworldsg_ros.merging import views
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph

BOARD = slab((0, 0, 1), (0.8, 0.8, 0.004))
LEFT = slab((-0.2, 0, 1), (0.3, 0.3, 0.004))


def table_of(*surfaces: np.ndarray, capacity: int = 512) -> NodeTable:
    nodes = NodeTable(1, capacity)
    for index, points in enumerate(surfaces):
        row = nodes.add(index + 1)
        mean, covariance = moments(points, 1e-6) if len(points) else (np.zeros(3), np.eye(3))
        nodes.put(row, mean, covariance, np.ones(1), 1.0, 1)
        nodes.set_surface(row, points.astype(np.float32))
    return nodes


def see_all(nodes: NodeTable, local: LocalGraph) -> views.View:
    if local.depth_grid is None:
        return views.see_nothing(local)
    arrays = views.frame_arrays(invert_pose(local.T_world_camera), local.depth_grid)
    return views.see(nodes, np.arange(len(nodes)), local, arrays)


def view_of(points: np.ndarray, background_m: float = WALL_M) -> tuple[bool, int]:
    """Whether a wall's frame sees through a node of these points, and how much is visible."""
    local = frame(1, depth_grid=depth_grid(background_m=background_m))
    view = see_all(table_of(points, capacity=views.SAMPLED_POINTS), local)
    return bool(view.through[0]), int(view.visibilities[0])


@pytest.mark.parametrize(
    ("z_m", "through", "visibility"),
    [(0.7, True, views.NOT_VISIBLE), (1.0, False, views.FULL), (1.5, False, views.NOT_VISIBLE)],
)
def test_points_before_on_and_behind_the_measured_depth(z_m, through, visibility) -> None:
    points = np.stack([np.linspace(-0.2, 0.2, 10), np.zeros(10), np.full(10, z_m)], axis=1)
    assert view_of(points) == (through, visibility)
    assert view_of(points[:0]) == (False, views.NOT_VISIBLE)


@pytest.mark.parametrize(
    ("left_m", "visibility"),
    [(-1.0, views.FULL), (-1.7, views.HALF), (-2.4, views.QUARTER), (-2.8, views.NOT_VISIBLE)],
)
def test_visibility_of_a_node_cut_by_the_image_border(left_m, visibility) -> None:
    # The image ends at 1.07 m to the left.
    x_m = np.linspace(left_m, left_m + 2, 40)
    points = np.stack([x_m, np.zeros(40), np.full(40, WALL_M)], axis=1)
    assert view_of(points) == (False, visibility)
    # Nearer to the camera, the image ends sooner.
    assert view_of(points, background_m=3.0) == (
        visibility in (views.HALF, views.FULL),
        views.NOT_VISIBLE,
    )


@given(seeds)
@settings(max_examples=100)
def test_a_node_is_seen_through_if_half_of_it_is_in_the_image(seed: int) -> None:
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
    through, _ = view_of(points, background_m=60.0)
    assert through == bool(inside.sum() >= 20)


@pytest.mark.parametrize(("z_m", "through"), [(0.6, True), (1.2, True), (3.0, False)])
def test_what_the_depth_grid_does_not_resolve_is_not_seen_through(z_m, through) -> None:
    """Its cells may lie beside a bottle far away, which is there all the same."""
    points = slab((0, 0, z_m), (0.1, 0.25, 0.1))
    assert view_of(points[: views.SAMPLED_POINTS], background_m=8.0)[0] == through


def halves() -> DepthGrid:
    """A wall at 1 m, its left half in the first mask and its right half in the second."""
    instances = np.repeat(np.uint16([[1, 2]]), 40, axis=1).repeat(60, axis=0)
    return replace(depth_grid(), instances=instances)


def of_two_masks(grid: DepthGrid | None, *surfaces: np.ndarray) -> views.View:
    local: LocalGraph = frame(1, (LEFT, CUP), (BOARD, CUP), depth_grid=grid)
    return see_all(table_of(*surfaces), local)


def test_the_masks_share_a_node_by_its_present_points() -> None:
    covered = of_two_masks(halves(), BOARD, LEFT).covered
    assert covered[:, 0] == pytest.approx([0.5, 0.5], abs=0.2)
    assert covered[:, 1].tolist() == [1.0, 0.0]


def test_hidden_points_and_points_out_of_view_are_not_covered() -> None:
    behind, beyond = LEFT + np.float32([0.3, 0, 1.0]), LEFT - np.float32([3.0, 0, 0])
    covered = of_two_masks(halves(), np.concatenate((LEFT, behind, beyond))).covered
    assert covered[:, 0].tolist() == [1.0, 0.0]


def test_the_coverage_of_a_hidden_node_is_unknown() -> None:
    hidden = slab((0, 0, 2), (0.5, 0.5, 0.004))
    assert np.isnan(of_two_masks(halves(), hidden).covered).all()
    assert np.isnan(of_two_masks(replace(halves(), instances=None), BOARD).covered).all()
    assert of_two_masks(None, BOARD).covered.shape == (2, 0)


# --- the nodes that a frame may show -------------------------------------------------------------

# Margin of the comparison with sampled points of a ball, metres.
SMALL_M = 0.02


def shows(
    frame: views.FrameArrays, mean: np.ndarray, radius: float, rng: np.random.Generator
) -> bool:
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
def test_every_node_in_view_is_found_after_any_changes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid, known = views.NodeGrid(), {}
    for _ in range(12):
        count = int(rng.integers(0, 30))
        slots = rng.choice(150, count, replace=False)
        means, bounds = rng.uniform(-12, 12, (150, 3)), rng.uniform(0.01, 0.6, 150) ** 2
        grid.put(slots, means, bounds)
        known.update(
            {slot: (means[slot], views.BALL_DEVIATIONS * bounds[slot] ** 0.5) for slot in slots}
        )
        for slot in rng.choice(200, 10).tolist():
            grid.remove(slot)
            known.pop(slot, None)
    wall = depth_grid(background_m=rng.uniform(0.5, 9.0))
    seen = views.frame_arrays(invert_pose(random_pose(rng)), wall)
    found = grid.in_view(seen).tolist()
    assert len(found) == len(set(found)) and set(found) <= known.keys()
    for slot, (mean, radius) in known.items():
        assert slot in found or not shows(seen, mean, radius, rng)


def test_nodes_elsewhere_are_not_compared() -> None:
    grid, seen = views.NodeGrid(), views.frame_arrays(np.eye(4), depth_grid(background_m=3.0))
    assert grid.in_view(seen).tolist() == []
    slots, means = np.array([3, 5, 7, 9]), np.zeros((10, 3))
    means[slots] = [[0, 0, 2], [50, 0, 2], [0, 0, 30], [0, 0, -30]]
    grid.put(slots, means, np.full(10, 0.01))
    assert grid.in_view(seen).tolist() == [3]
    grid.remove(3)
    means[5] = [0, 0, 2]
    grid.put(slots[1:2], means, np.full(10, 0.01))
    assert grid.in_view(seen).tolist() == [5]
