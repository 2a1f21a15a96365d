"""Coverage of nodes by masks against known masks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.surfaces import depth_grid, slab

from deworldsg_ros.merging.coverage import coverage
from deworldsg_ros.scene.frame_graph import DepthGrid
from deworldsg_ros.scene.nodes import NodeTable

BOARD = slab((0, 0, 1), (0.8, 0.8, 0.004))
OTHERWISE = np.array([[0.1, 0.2], [0.3, 0.4]])


def table_of(*surfaces: np.ndarray) -> NodeTable:
    nodes = NodeTable(1, 512)
    for index, points in enumerate(surfaces):
        nodes.set_surface(nodes.append(index + 1), points)
    return nodes


def covered(grid: DepthGrid | None, *surfaces: np.ndarray) -> np.ndarray:
    """Fractions of nodes in two masks: the left half, then the right half of a board."""
    rows = np.arange(len(surfaces))
    values = np.array([1, 2])
    return coverage(table_of(*surfaces), rows, values, np.eye(4), grid, OTHERWISE[:, rows])


def halves() -> DepthGrid:
    """A wall at 1 m, its left half in the first mask and its right half in the second."""
    instances = np.repeat(np.uint16([[1, 2]]), 40, axis=1).repeat(60, axis=0)
    return dataclasses.replace(depth_grid(), instances=instances)


def test_the_masks_share_a_node_by_its_visible_surface() -> None:
    left = slab((-0.2, 0, 1), (0.3, 0.3, 0.004))
    fractions = covered(halves(), BOARD, left)
    assert fractions[:, 0] == pytest.approx([0.5, 0.5], abs=0.2)
    assert fractions[:, 1].tolist() == [1.0, 0.0]


def test_hidden_points_and_points_out_of_view_do_not_count() -> None:
    left = slab((-0.2, 0, 1), (0.3, 0.3, 0.004))
    behind, beyond = left + np.float32([0.3, 0, 1.0]), left - np.float32([3.0, 0, 0])
    fractions = covered(halves(), np.concatenate((left, behind, beyond)))
    assert fractions[:, 0].tolist() == [1.0, 0.0]


def test_a_node_that_the_grid_does_not_show_keeps_the_other_fraction() -> None:
    grid = halves()
    hidden = slab((0, 0, 2), (0.5, 0.5, 0.004))
    assert covered(grid, hidden)[:, 0].tolist() == [0.1, 0.3]
    for missing in (None, dataclasses.replace(grid, instances=None)):
        assert covered(missing, BOARD, hidden).tolist() == OTHERWISE.tolist()
