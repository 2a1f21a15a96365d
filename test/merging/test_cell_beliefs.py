"""Cells of a surface that most frames show as something else are not the object's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.merging import VOCABULARY, random_pose
from support.node_states import node_states
from support.surfaces import CAMERA, CUP, TABLE, frame

from deworldsg_ros.config import Config, MergingConfig
from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.merging import SurfaceMerging
from deworldsg_ros.merging.cell_kernels import CellSets
from deworldsg_ros.merging.surface_map import (
    CELL_M,
    HIT,
    MAX_SCORE,
    MISS,
    SHOWN_FRACTION,
    SHOWN_M,
    VoxelMap,
)
from deworldsg_ros.merging.views import frame_arrays
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph

SHAPE = (60, 80)
WALL_M = 1.0
# Half widths of a picture on a wall, and of a mask that includes a part of the wall.
TRUE_M = 0.2
WIDE_M = 0.45
# Surfaces that end before this are the picture's, and beyond it the mask's.
LIMIT_M = 0.3


def view(stamp: int, *half_widths_m: float, instances: bool = True) -> LocalGraph:
    """A frame of pictures on a wall, one above the other; each mask has a half width."""
    points, masks = [], np.zeros(SHAPE, np.uint16)
    columns_m = (8 * (np.arange(SHAPE[1]) + 0.5) - CAMERA.cx) / CAMERA.fx * WALL_M
    rows_m = (8 * (np.arange(SHAPE[0]) + 0.5) - CAMERA.cy) / CAMERA.fy * WALL_M
    for row, half_m in enumerate(half_widths_m):
        low_m = -0.4 + 0.5 * row
        rng = np.random.default_rng([stamp, row])
        x, y = rng.uniform(-half_m, half_m, 400), rng.uniform(low_m, low_m + 0.2, 400)
        points.append(np.column_stack([x, y, np.full(400, WALL_M)]).astype(np.float32))
        inside = (np.abs(rows_m - low_m - 0.1) < 0.1)[:, None] & (np.abs(columns_m) < half_m)
        masks[inside] = row + 1
    depth_mm = np.full(SHAPE, 1000 * WALL_M, np.uint16)
    grid = DepthGrid(depth_mm, 8, CAMERA, masks if instances else None)
    kinds = (TABLE, CUP)
    return frame(stamp, *zip(points, kinds), depth_grid=grid)


def widths_after(*frames: LocalGraph) -> list[float]:
    """Half width of the surface of the first node after each frame, metres.

    Points beyond it, one in twenty, lie in cells that no earlier frame sampled.
    """
    graph, merging = SceneGraph(VOCABULARY, "world"), SurfaceMerging(MergingConfig())
    widths = []
    for local in frames:
        merging.merge(graph, local)
        assert list(graph.nodes.slot_of) == list(range(1, len(local) + 1))
        widths.append(float(np.quantile(np.abs(graph.nodes.surface(0)[:, 0]), 0.95)))
    return widths


def test_a_node_loses_the_surface_of_a_bleeding_mask() -> None:
    masks = [TRUE_M, TRUE_M, WIDE_M, WIDE_M, TRUE_M, TRUE_M, TRUE_M]
    widths = widths_after(*(view(stamp, half_m) for stamp, half_m in enumerate(masks)))
    assert max(widths[:2]) < LIMIT_M
    # Two hits of the wall outweigh one miss, and no more.
    assert min(widths[2:5]) > LIMIT_M
    assert max(widths[5:]) < LIMIT_M


def test_the_surface_returns_if_later_frames_show_it() -> None:
    masks = [WIDE_M, TRUE_M, TRUE_M, WIDE_M, WIDE_M, WIDE_M, WIDE_M]
    widths = widths_after(*(view(stamp, half_m) for stamp, half_m in enumerate(masks)))
    assert widths[2] < LIMIT_M
    assert widths[3] < LIMIT_M  # one hit of three frames
    assert widths[6] > LIMIT_M


def test_what_is_inside_all_masks_stays() -> None:
    graph = SceneGraph(VOCABULARY, "world", even_gaussians=True)
    merging = SurfaceMerging(MergingConfig())
    for stamp in range(12):
        merging.merge(graph, view(stamp, WIDE_M if stamp % 3 == 0 else TRUE_M))
    x = graph.nodes.surface(0)[:, 0]
    assert len(x) > 0.9 * graph.surface_point_capacity
    assert np.histogram(x, 10, (-TRUE_M, TRUE_M))[0].min() > 20
    # The published size is that of the picture, not of the wide masks.
    deviation_m = node_states(graph, 1)[1].covariance_m2[0] ** 0.5
    assert deviation_m == pytest.approx(2 * TRUE_M / 12**0.5, rel=0.1)


@pytest.mark.parametrize("missing", ["instances", "grid"])
def test_without_an_instance_image_the_surface_stays(missing: str) -> None:
    frames = [view(0, WIDE_M, instances=False), *(view(n, TRUE_M, instances=False) for n in (1, 2))]
    if missing == "grid":
        frames = [
            frame(local.stamp_ns // 10**8, (local.surface_points_world[0], TABLE))
            for local in frames
        ]
    assert widths_after(*frames)[-1] > LIMIT_M


def test_a_node_that_the_frame_does_not_detect_keeps_its_surface() -> None:
    graph, merging = SceneGraph(VOCABULARY, "world"), SurfaceMerging(MergingConfig())
    merging.merge(graph, view(0, TRUE_M, TRUE_M))
    before = graph.nodes.surface(1).copy()
    for stamp in range(1, 6):
        merging.merge(graph, view(stamp, TRUE_M))
    np.testing.assert_array_equal(graph.nodes.surface(1), before)


def test_a_map_continues_the_evidence(tmp_path: Path) -> None:
    masks = [TRUE_M, WIDE_M, WIDE_M, TRUE_M, WIDE_M, TRUE_M, TRUE_M, WIDE_M, TRUE_M]
    config = Config()
    frames = [view(stamp, half_m, TRUE_M) for stamp, half_m in enumerate(masks, start=1)]
    for stop in (3, 5, 7):
        whole = GraphBuilder(config, VOCABULARY, "world")
        for local in frames[:stop]:
            whole.integrate(local)
        write_map(whole, tmp_path / "room.map")
        again = read_map(config, tmp_path / "room.map")
        for local in frames[stop:]:
            again.integrate(local)
            whole.integrate(local)
            one, other = again.graph.state(), whole.graph.state()
            np.testing.assert_array_equal(one.surface_points, other.surface_points)
            np.testing.assert_array_equal(one.surface_counts, other.surface_counts)


def test_a_map_of_an_older_release_starts_without_evidence(tmp_path: Path) -> None:
    config = Config()
    whole = GraphBuilder(config, VOCABULARY, "world")
    for stamp in range(1, 4):
        whole.integrate(view(stamp, TRUE_M))
    path = tmp_path / "room.map"
    write_map(whole, path)
    arrays = graph_files.read(path)
    for name in ("scores", "records", "looks", "fates", "last_ns"):
        del arrays[f"merging.{name}"]
    del arrays["existence"]
    graph_files.write(path, arrays)
    again = read_map(config, path)
    assert again.integrate(view(4, TRUE_M)) == [1]
    assert again.full().nodes[0].existence > 0.5


class PlainScores:
    """The same rule for one owner, cell by cell."""

    def __init__(self) -> None:
        self.scores: dict[tuple[int, ...], int] = {}

    def add(self, points: np.ndarray) -> set[tuple[int, ...]]:
        own = {tuple(cell) for cell in np.floor(points.astype(np.float64) / CELL_M).astype(int)}
        for cell in own:
            self.scores.setdefault(cell, 0)
        return own

    def judge(self, own: set[tuple[int, ...]], value: int, T: np.ndarray, grid: DepthGrid) -> None:
        for cell, score in self.scores.items():
            hit = True if cell in own else self.shows(cell, value, T, grid)
            if hit is not None:
                change = HIT if hit else -MISS
                self.scores[cell] = int(np.clip(score + change, -MAX_SCORE, MAX_SCORE))

    @staticmethod
    def shows(cell: tuple[int, ...], value: int, T: np.ndarray, grid: DepthGrid) -> bool | None:
        """Whether a frame shows a cell as the owner's; None = it does not show it."""
        assert grid.instances is not None
        x, y, z = T[:3, :3] @ ((np.array(cell) + 0.5) * CELL_M) + T[:3, 3]
        if z < 0.1:
            return None
        camera, stride = grid.intrinsics, grid.stride_px
        column = int(np.floor((camera.fx * x / z + camera.cx) / stride))
        row = int(np.floor((camera.fy * y / z + camera.cy) / stride))
        if not (0 <= row < SHAPE[0] and 0 <= column < SHAPE[1]) or not grid.depth_mm[row, column]:
            return None
        if abs(grid.depth_mm[row, column] / 1000 - z) > SHOWN_M + SHOWN_FRACTION * z:
            return None
        return bool(grid.instances[row, column] == value)


@given(st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_scores_equal_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    surfaces, plain = VoxelMap(), [PlainScores(), PlainScores()]
    camera_world = random_pose(rng)
    for _ in range(8):
        # Points in front of a camera that turns a little, at the depth that it measures.
        turn = np.eye(4)
        turn[:3, 3] = rng.normal(0, 0.02, 3)
        T_world_camera = camera_world @ turn
        depth_mm = rng.choice([0, 900, 980, 1000], SHAPE, p=[0.1, 0.1, 0.2, 0.6]).astype(np.uint16)
        instances = rng.integers(0, 3, SHAPE).astype(np.uint16)
        grid = DepthGrid(depth_mm, 8, CAMERA, instances)
        in_camera = rng.uniform((-1.2, -0.9, 0.9), (1.2, 0.9, 1.05), (2, 60, 3))
        points = in_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        sets = surfaces.cells_of(list(points.astype(np.float32)))
        surfaces.add([0, 1], sets)
        T = invert_pose(T_world_camera)
        rejected = surfaces.judge([0, 1], sets, np.array([1, 2]), frame_arrays(T, grid))
        for owner in (0, 1):
            before = dict(plain[owner].scores)
            own = plain[owner].add(points[owner].astype(np.float32))
            plain[owner].judge(own, owner + 1, T, grid)
            assert scores_of(surfaces, owner) == plain[owner].scores
            expected = {
                cell
                for cell, score in plain[owner].scores.items()
                if score < 0 and (cell in own or before.get(cell, 0) >= 0)
            }
            assert cells_in(rejected, owner) == expected


def scores_of(surfaces: VoxelMap, owner: int) -> dict[tuple[int, ...], int]:
    blocks, masks, _ = surfaces.cells(owner)
    scores = surfaces.scores(owner)
    return {
        index: int(scores[place, bit])
        for place in range(len(blocks))
        for bit, index in indices(int(blocks[place]), int(masks[place]))
    }


def cells_in(sets: CellSets, row: int) -> set[tuple[int, ...]]:
    return {
        index
        for place in range(sets.starts[row], sets.starts[row + 1])
        for _, index in indices(int(sets.blocks[place]), int(sets.masks[place]))
    }


def indices(block: int, mask: int) -> list[tuple[int, tuple[int, ...]]]:
    """The bits of a mask, and the index of the cell of each."""
    corner = [4 * ((block >> shift) & (2**21 - 1)) - 2**20 for shift in (42, 21, 0)]
    bits = [bit for bit in range(64) if mask >> bit & 1]
    return [
        (bit, (corner[0] + (bit >> 4), corner[1] + (bit >> 2 & 3), corner[2] + (bit & 3)))
        for bit in bits
    ]


def test_scores_of_merged_owners_are_added() -> None:
    surfaces = VoxelMap()
    points = np.array([[0.01, 0.01, 1.0], [0.2, 0.01, 1.0]], np.float32)
    cells = surfaces.cells_of([points])
    grid = DepthGrid(np.zeros(SHAPE, np.uint16), 8, CAMERA, np.zeros(SHAPE, np.uint16))
    surfaces.add([0], cells)
    for _ in range(3):
        surfaces.judge([0], cells, np.array([1]), frame_arrays(np.eye(4), grid))
    assert set(scores_of(surfaces, 0).values()) == {3 * HIT}
    surfaces.add([1], surfaces.cells_of([points[:1]]))
    surfaces.add_scores([1], surfaces.cells(0), surfaces.scores(0))
    assert list(scores_of(surfaces, 1).values()) == [3 * HIT]


def test_a_removed_owner_leaves_no_scores() -> None:
    surfaces = VoxelMap()
    cells = surfaces.cells_of([np.array([[0.01, 0.01, 1.0]], np.float32)])
    grid = DepthGrid(np.zeros(SHAPE, np.uint16), 8, CAMERA, np.zeros(SHAPE, np.uint16))
    for _ in range(3):
        surfaces.add([0], cells)
        surfaces.judge([0], cells, np.array([1]), frame_arrays(np.eye(4), grid))
        assert list(scores_of(surfaces, 0).values()) == [HIT]
        surfaces.remove(0)
