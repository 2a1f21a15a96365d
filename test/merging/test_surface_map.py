"""The surface map against plain sets of cells; cells that most frames show as something else go."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.lib.recfunctions import repack_fields
from support.merging import VOCABULARY, node_states, random_pose
from support.surfaces import CAMERA, CUP, TABLE, frame

from deworldsg_ros.config import Config, InputsConfig, MergingConfig
from deworldsg_ros.graph import graph_files
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import read_map, write_map
from deworldsg_ros.merging import SurfaceMerging
from deworldsg_ros.merging.cell_kernels import MIN_OWNER_CELLS, SHOWN, SURFACE, CellSets
from deworldsg_ros.merging.records import RECORD
from deworldsg_ros.merging.surface_map import (
    CELL_M,
    HIT,
    HIT_SHOWN,
    MAX_SCORE,
    MISS,
    MISS_SHOWN,
    SHOWN_FRACTION,
    SHOWN_M,
    VoxelMap,
)
from deworldsg_ros.merging.views import frame_arrays
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph
from deworldsg_ros.wire import messages as wire

seeds = st.integers(0, 10**6)
SHAPE = (60, 80)
Cell = tuple[int, ...]

# --- cells of owners -----------------------------------------------------------------------------


def cells_of(points: np.ndarray, cell_m: float) -> set[Cell]:
    return {tuple(cell) for cell in np.floor(points.astype(np.float64) / cell_m).astype(int)}


def neighbourhood(cell: Cell) -> list[Cell]:
    steps = np.concatenate([np.zeros((1, 3), int), np.eye(3, dtype=int), -np.eye(3, dtype=int)])
    return [tuple(near) for near in (np.array(cell) + steps).tolist()]


def reference_overlaps(seen: set[Cell], known: set[Cell]) -> tuple[float, float]:
    on_owner = sum(any(cell in known for cell in neighbourhood(c)) for c in seen)
    met = {cell for c in seen for cell in neighbourhood(c)} & known
    if not on_owner:
        return 0.0, 0.0
    return on_owner / len(seen), len(met) / len(known) if len(known) >= MIN_OWNER_CELLS else 0.0


def dense(owners: list[int], on: np.ndarray, of: np.ndarray, owner_count: int) -> np.ndarray:
    """Both overlap fractions (2, n, owner_count), including owners that no set meets."""
    assert (on > 0).any(axis=0).all()
    result = np.zeros((2, len(on), owner_count))
    result[:, :, owners] = on, of
    return result


@given(seeds)
def test_overlaps_equal_the_reference(seed: int) -> None:
    rng, cell_m = np.random.default_rng(seed), 0.05
    surfaces = VoxelMap(cell_m)
    known: list[set[Cell]] = [set() for _ in range(3)]  # a cell has room for four
    for _ in range(8):
        owner = int(rng.integers(3))
        points = rng.uniform(-0.3, 0.3, (int(rng.integers(0, 20)), 3)).astype(np.float32)
        surfaces.add([owner], surfaces.cells_of([points]))
        known[owner] |= cells_of(points, cell_m)
    counts = rng.integers(0, 30, int(rng.integers(0, 5)))
    sets = [rng.uniform(-0.3, 0.3, (count, 3)).astype(np.float32) for count in counts]
    overlaps = dense(*surfaces.overlaps(surfaces.cells_of(sets)), 3)
    for row, points in enumerate(sets):
        for owner in range(3):
            expected = reference_overlaps(cells_of(points, cell_m), known[owner])
            assert overlaps[:, row, owner] == pytest.approx(expected, abs=1e-12)
    for owner in range(3):
        assert len(surfaces.centres(owner)) == len(known[owner])


def test_growing_keeps_all_cells_and_a_removed_owner_has_none() -> None:
    surfaces, rng = VoxelMap(0.01, cells_per_owner=100_000), np.random.default_rng(1)
    sets = surfaces.cells_of([rng.uniform(-5, 5, (30_000, 3)) for _ in range(2)])
    surfaces.add([0, 1], sets)
    assert surfaces.overlaps(sets)[1].diagonal().tolist() == [1.0, 1.0]
    count = len(surfaces.centres(0))
    removed = surfaces.remove(0)
    assert len(surfaces.centres(0)) == 0
    after = dense(*surfaces.overlaps(sets), 2)[0]
    assert after[0, 0] == after[1, 0] == 0.0
    assert after[1, 1] == 1.0
    surfaces.add([2], removed)
    assert len(surfaces.centres(2)) == count
    assert dense(*surfaces.overlaps(sets), 3)[0, 0].tolist() == [0.0, after[0, 1], 1.0]


def test_room_is_limited() -> None:
    rng = np.random.default_rng(0)
    surfaces = VoxelMap(0.01, cells_per_owner=50)
    surfaces.add([0], surfaces.cells_of([rng.uniform(-1, 1, (500, 3))]))
    assert len(surfaces.centres(0)) == 50
    # Points beyond the map are ignored.
    points = np.array([[1e9, 0, 0], [0, -1e9, 0], [0, 0, 0]], np.float32)
    surfaces.add([1], surfaces.cells_of([points]))
    assert surfaces.centres(1) == pytest.approx(np.full((1, 3), 0.005))
    capacity = surfaces.capacity
    for _ in range(1000):  # removed owners take no room
        surfaces.add([2], surfaces.cells_of([rng.uniform(-9, 9, (20, 3)).astype(np.float32)]))
        surfaces.remove(2)
    assert surfaces.capacity == capacity


# --- scores of cells -----------------------------------------------------------------------------


class PlainScores:
    """The same rule for one owner, cell by cell: both scores."""

    def __init__(self) -> None:
        self.scores: dict[Cell, int] = {}
        self.shown: dict[Cell, int] = {}

    def judge(self, own: set[Cell], value: int, T: np.ndarray, grid: DepthGrid) -> set[Cell]:
        """Takes in the cells of a frame; returns those that it rejects."""
        before = dict(self.scores)
        for cell in own:
            self.scores.setdefault(cell, 0)
        for cell, score in self.scores.items():
            shown = shows(cell, value, T, grid)
            if shown is not None:
                sum_ = self.shown.get(cell, 0) + (HIT_SHOWN if shown else -MISS_SHOWN)
                self.shown[cell] = int(np.clip(sum_, -MAX_SCORE, MAX_SCORE))
            hit = True if cell in own else shown
            if hit is not None:
                change = HIT if hit else -MISS
                self.scores[cell] = int(np.clip(score + change, -MAX_SCORE, MAX_SCORE))
        return {
            cell
            for cell, score in self.scores.items()
            if score < 0 and (cell in own or before.get(cell, 0) >= 0)
        }


def shows(cell: Cell, value: int, T: np.ndarray, grid: DepthGrid) -> bool | None:
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


def indices(block: int, mask: int) -> list[tuple[int, Cell]]:
    """The bits of a mask, and the index of the cell of each."""
    corner = [4 * ((block >> shift) & (2**21 - 1)) - 2**20 for shift in (42, 21, 0)]
    bits = [bit for bit in range(64) if mask >> bit & 1]
    return [
        (bit, (corner[0] + (bit >> 4), corner[1] + (bit >> 2 & 3), corner[2] + (bit & 3)))
        for bit in bits
    ]


def scores_of(surfaces: VoxelMap, owner: int, kind: int = SURFACE) -> dict[Cell, int]:
    blocks, masks, _ = surfaces.cells(owner)
    return {
        index: int(scores[kind, bit])
        for block, mask, scores in zip(blocks.tolist(), masks.tolist(), surfaces.scores(owner))
        for bit, index in indices(block, mask)
    }


def cells_in(sets: CellSets, row: int) -> set[Cell]:
    of_row = slice(sets.starts[row], sets.starts[row + 1])
    found = zip(sets.blocks[of_row].tolist(), sets.masks[of_row].tolist())
    return {index for block, mask in found for _, index in indices(block, mask)}


@given(seeds)
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
        points = points.astype(np.float32)
        sets = surfaces.cells_of(list(points))
        surfaces.add([0, 1], sets)
        T = invert_pose(T_world_camera)
        rejected = surfaces.judge([0, 1], sets, np.array([1, 2]), frame_arrays(T, grid))
        for owner in (0, 1):
            expected = plain[owner].judge(cells_of(points[owner], CELL_M), owner + 1, T, grid)
            assert scores_of(surfaces, owner) == plain[owner].scores
            shown = {cell: plain[owner].shown.get(cell, 0) for cell in plain[owner].scores}
            assert scores_of(surfaces, owner, SHOWN) == shown
            assert cells_in(rejected, owner) == expected


def test_scores_of_merged_owners_are_added_and_a_removed_one_leaves_none() -> None:
    surfaces = VoxelMap()
    points = np.array([[0.01, 0.01, 1.0], [0.2, 0.01, 1.0]], np.float32)
    cells = surfaces.cells_of([points])
    nothing = np.zeros(SHAPE, np.uint16)
    arrays = frame_arrays(np.eye(4), DepthGrid(nothing, 8, CAMERA, nothing))
    for times in (1, 2, 3):
        surfaces.add([0, 2], surfaces.cells_of([points, points]))
        surfaces.judge([0], cells, np.array([1]), arrays)
        surfaces.judge([2], cells, np.array([1]), arrays)
        assert set(scores_of(surfaces, 0).values()) == {times * HIT}
        assert set(scores_of(surfaces, 2).values()) == {HIT}
        surfaces.remove(2)
    surfaces.add([1], surfaces.cells_of([points[:1]]))
    surfaces.add_scores([1], surfaces.cells(0), surfaces.scores(0))
    assert list(scores_of(surfaces, 1).values()) == [3 * HIT]


# --- the surfaces of nodes -----------------------------------------------------------------------

WALL_M = 1.0
# Half widths of a picture on a wall, and of a mask that includes a part of the wall.
TRUE_M, WIDE_M = 0.2, 0.45
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
    return frame(stamp, *zip(points, (TABLE, CUP)), depth_grid=grid)


def merged(*frames: LocalGraph, **options: bool) -> tuple[GlobalGraph, list[float]]:
    """The graph, and the half width of the surface of the first node after each frame, metres.

    Points beyond it, one in twenty, lie in cells that no earlier frame sampled.
    """
    graph = GlobalGraph(VOCABULARY, "world", **options)
    merging, widths = SurfaceMerging(MergingConfig()), []
    for local in frames:
        merging.merge(graph, local)
        widths.append(float(np.quantile(np.abs(graph.nodes.surface(0)[:, 0]), 0.95)))
    assert list(graph.nodes.slot_of) == list(range(1, len(frames[0]) + 1))
    return graph, widths


def views(*half_widths_m: float, **options: bool) -> list[LocalGraph]:
    return [view(stamp, half_m, **options) for stamp, half_m in enumerate(half_widths_m, start=1)]


@pytest.mark.parametrize(
    ("masks_m", "wide"),
    [
        # Two hits of the wall outweigh one miss, and no more.
        ([TRUE_M] * 2 + [WIDE_M] * 2 + [TRUE_M] * 3, "--+++--"),
        # The surface returns if later frames show it: after one hit of three frames, not yet.
        ([WIDE_M] + [TRUE_M] * 2 + [WIDE_M] * 4, "??--??+"),
    ],
)
def test_a_node_loses_the_surface_of_a_bleeding_mask(masks_m: list[float], wide: str) -> None:
    _, widths = merged(*views(*masks_m))
    for width_m, is_wide in zip(widths, wide):
        assert is_wide == "?" or (width_m > LIMIT_M) == (is_wide == "+")


def test_what_is_inside_all_masks_stays() -> None:
    masks_m = [WIDE_M if stamp % 3 == 0 else TRUE_M for stamp in range(12)]
    graph, _ = merged(*views(*masks_m), even_gaussians=True)
    x = graph.nodes.surface(0)[:, 0]
    assert len(x) > 0.9 * graph.surface_point_capacity
    assert np.histogram(x, 10, (-TRUE_M, TRUE_M))[0].min() > 20
    # The published size is that of the picture, not of the wide masks.
    deviation_m = node_states(graph, 1)[1].covariance_m2[0] ** 0.5
    assert deviation_m == pytest.approx(2 * TRUE_M / 12**0.5, rel=0.1)


def box_after(*half_widths_m: float) -> wire.GravityBox:
    builder = GraphBuilder(Config(), VOCABULARY, "world")
    for local in views(*half_widths_m):
        builder.integrate(local)
    (node,) = builder.full().nodes
    return node.box


def test_a_box_is_around_what_the_images_show_as_the_object() -> None:
    # Two frames of three are enough for the surface, and too few for the box.
    masks_m = [WIDE_M, WIDE_M, TRUE_M] * 6
    assert merged(*views(*masks_m))[1][-1] > 0.9 * WIDE_M
    assert box_after(*masks_m).size_m[0] == pytest.approx(2 * TRUE_M, abs=0.03)


def test_a_side_that_no_view_shows_to_its_end_may_be_longer() -> None:
    # The back of a picture is never seen; a wider one is cut by the border of the image.
    assert box_after(*[TRUE_M] * 8).at_least == [False, True, False]
    assert box_after(*[1.2] * 8).at_least == [True, True, False]
    # Two frames that show the ends are enough.
    assert box_after(*[1.2] * 4, *[0.9] * 40).at_least == [False, True, False]
    # Half of the masks go on beyond the box; then fewer.
    assert box_after(*[TRUE_M, WIDE_M] * 8).at_least == [True, True, False]
    assert box_after(*[TRUE_M, TRUE_M, WIDE_M] * 6).at_least == [False, True, False]


def test_without_a_detection_or_an_instance_image_the_surface_stays() -> None:
    frames = views(WIDE_M, TRUE_M, TRUE_M, instances=False)
    blind = [frame(n, (one.surface_points_world[0], TABLE)) for n, one in enumerate(frames)]
    for seen in (frames, blind):
        assert merged(*seen)[1][-1] > LIMIT_M
    both = view(1, TRUE_M, TRUE_M)
    before, _ = merged(both)
    after, _ = merged(both, *views(*[TRUE_M] * 6)[1:])
    np.testing.assert_array_equal(after.nodes.surface(1), before.nodes.surface(1))


def test_a_map_continues_the_evidence(tmp_path: Path) -> None:
    masks_m = [TRUE_M, WIDE_M, WIDE_M, TRUE_M, WIDE_M, TRUE_M, TRUE_M, WIDE_M, TRUE_M]
    config, path = Config(), tmp_path / "room.map"
    frames = [view(stamp, half_m, TRUE_M) for stamp, half_m in enumerate(masks_m, start=1)]
    for stop in (3, 5, 7):
        whole = GraphBuilder(config, VOCABULARY, "world")
        for local in frames[:stop]:
            whole.integrate(local)
        write_map(whole, path)
        again = read_map(config, path)
        for local in frames[stop:]:
            again.integrate(local)
            whole.integrate(local)
            one, other = again.graph.state(), whole.graph.state()
            np.testing.assert_array_equal(one.surface_points, other.surface_points)
            np.testing.assert_array_equal(one.surface_counts, other.surface_counts)
    arrays = graph_files.read(path)
    arrays["merging.said"] = np.array([2, 9])
    graph_files.write(path, arrays)
    assert read_map(config, path).merging.memory()["said"].tolist() == [2, 9]
    # An older release has one score of a cell.
    arrays["merging.scores"] = np.ascontiguousarray(arrays["merging.scores"][:, SURFACE])
    names = [name for name in RECORD.names or () if name != "most_certain"]
    arrays["merging.records"] = repack_fields(arrays["merging.records"][names])
    del arrays["merging.said"]
    graph_files.write(path, arrays)
    memory = read_map(config, path).merging.memory()
    assert memory["scores"].shape[1:] == (2, 64) and (memory["records"]["most_certain"] == 1).all()
    assert memory["said"].tolist() == [0, 0]
    # A map of an older release starts without evidence.
    arrays = graph_files.read(path)
    for name in ("scores", "records", "looks", "fates", "frames"):
        del arrays[f"merging.{name}"]
    del arrays["existence"]
    graph_files.write(path, arrays)
    again = read_map(config, path)
    assert again.integrate(view(99, TRUE_M)) == [1]
    assert again.full().nodes[0].existence > 0.5


# A crate on the ground, seen from 1 m above, 45 degrees downwards.
CRATE_LOW, CRATE_HIGH = np.array([-0.15, 0.9, 0.0]), np.array([0.15, 1.2, 0.25])
T_WORLD_CAMERA = np.eye(4)
T_WORLD_CAMERA[:3, :3] = np.array(
    [[1, 0, 0], [0, -(0.5**0.5), 0.5**0.5], [0, -(0.5**0.5), -(0.5**0.5)]]
)
T_WORLD_CAMERA[2, 3] = 1.0


def crate_view(stamp: int, ground_m: float | None, mask_above_m: float = 0.02) -> LocalGraph:
    """The crate, whose mask ends above its bottom, and the ground beneath it; None = no ground."""
    rays = np.ones((*SHAPE, 3))
    rays[..., 0] = (8 * (np.arange(SHAPE[1]) + 0.5) - CAMERA.cx) / CAMERA.fx
    rays[..., 1] = ((8 * (np.arange(SHAPE[0]) + 0.5) - CAMERA.cy) / CAMERA.fy)[:, None]
    rays = rays @ T_WORLD_CAMERA[:3, :3].T
    camera = T_WORLD_CAMERA[:3, 3]
    with np.errstate(divide="ignore"):
        ends = np.sort(np.stack([CRATE_LOW - camera, CRATE_HIGH - camera])[:, None, None] / rays, 0)
        enter, leave = ends[0].max(axis=2), ends[1].min(axis=2)
        ground = (ground_m - camera[2]) / rays[..., 2] if ground_m is not None else 0 * enter
    hits = (enter < leave) & (enter > 0)
    depth_m = np.where(hits, enter, np.where((ground > 0) & (ground < 9), ground, 0.0))
    points = camera + depth_m[..., None] * rays
    mask = hits & (points[..., 2] > mask_above_m)
    grid = DepthGrid(np.rint(1000 * depth_m).astype(np.uint16), 8, CAMERA, mask.astype(np.uint16))
    # The faces that the camera sees, at all pixels and not only those of the grid.
    part = np.random.default_rng(stamp).uniform(size=(900, 3))
    part[:450, 1], part[450:, 2] = 0.0, 1.0
    low = np.array([*CRATE_LOW[:2], mask_above_m])
    surface = (low + part * (CRATE_HIGH - low)).astype(np.float32)
    return frame(stamp, (surface, TABLE), T_world_camera=T_WORLD_CAMERA, depth_grid=grid)


@pytest.mark.parametrize(
    ("ground_m", "bottom_m"),
    [
        (0.0, 0.0),
        # No ground near below, as of a crate on a wall: what is seen there is the crate itself.
        (None, 0.015),
        (-0.5, 0.015),
    ],
)
def test_a_box_reaches_down_to_what_is_seen_beneath(
    ground_m: float | None, bottom_m: float
) -> None:
    builder = GraphBuilder(Config(inputs=InputsConfig(world_up="z")), VOCABULARY, "world")
    for stamp in range(1, 9):
        builder.integrate(crate_view(stamp, ground_m))
    (node,) = builder.full().nodes
    low_m = node.box.center_m[2] - node.box.size_m[2] / 2
    assert low_m == pytest.approx(bottom_m, abs=0.008)
    assert node.box.center_m[2] + node.box.size_m[2] / 2 == pytest.approx(0.25, abs=0.01)
    # Asked again, it is the same. With corrected poses it rises as a whole.
    assert builder.full().nodes[0].box == node.box
    rise = np.eye(4)
    rise[2, 3] = 0.5
    builder.apply_correction(rise, 0)
    (risen,) = builder.full().nodes
    assert risen.box.center_m[2] - risen.box.size_m[2] / 2 - low_m == pytest.approx(0.5, abs=0.01)
