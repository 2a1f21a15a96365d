"""The room's surface: a point a cell, colours, what later views see through, and its bounds."""

import numpy as np
import pytest
from support.merging import VOCABULARY, local_graph
from support.spaces import BLOCK, BLOCK_RGB, add_view, looking, seen_room
from support.view import box_at, make_node

from deworldsg_ros.graph.provenance import GREY, SeenSpace, TrailChange
from deworldsg_ros.graph.surface import (
    CELL_M,
    Surface,
    SurfaceOfSpace,
    objects_at,
    surface_of,
)
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import DepthGrid

HEIGHT, WIDTH = 60, 80
CAMERA = np.array([60.0, 60.0, WIDTH / 2, HEIGHT / 2])
RED, BLUE = (200, 10, 10), (10, 10, 200)


def wall(depth_m, colour=RED):
    """The images of a wall across the view."""
    depth_mm = np.full((HEIGHT, WIDTH), round(1000 * depth_m), np.uint16)
    return depth_mm, np.full((HEIGHT, WIDTH, 3), colour, np.uint8)


def at(x, y=0.0, z=0.0):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def test_a_wall_has_a_point_a_pixel_in_its_place_and_colour():
    surface = Surface()
    surface.add(*wall(2.0), CAMERA, at(1.0))
    points, colours, sides = surface.kept()
    assert len(points) == HEIGHT * WIDTH  # 3 cm apart
    np.testing.assert_allclose(points[:, 2], 2.0, atol=1e-5)
    # Pixels are centred at half numbers of the grid.
    np.testing.assert_allclose(points[0, :2], (1.0 - 39.5 / 30, -29.5 / 30), atol=1e-4)
    assert (colours == RED).all()
    towards = at(1.0)[:3, 3] - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(sides / 127, towards, atol=0.01)


def test_a_cell_has_one_point_however_often_it_is_seen():
    surface = Surface()
    rng = np.random.default_rng(0)
    for _ in range(20):
        surface.add(*wall(1.0), CAMERA, at(*rng.uniform(-0.1, 0.1, 2)))
    points = surface.kept()[0]
    cells = np.unique(np.floor(points / CELL_M), axis=0)
    assert len(cells) == len(points)
    assert len(points) < 1.5 * (80 * 60 * (1 / 60) ** 2) / CELL_M**2


def test_what_was_carried_away_is_seen_through():
    surface = Surface()
    depth_mm, rgb = wall(3.0)
    depth_mm[20:40, 30:50], rgb[20:40, 30:50] = 1500, BLUE
    surface.add(depth_mm, rgb, CAMERA, at(0.0))
    assert (surface.kept()[1] == BLUE).all(axis=1).sum() == 400
    for _ in range(3):
        surface.add(*wall(3.0), CAMERA, at(0.0))
    points, colours, _ = surface.kept()
    assert (colours == RED).all() and (points[:, 2] > 2.9).all()
    assert surface.gone.sum() == 400
    # Others behind it are hidden, and stay.
    surface.add(depth_mm, rgb, CAMERA, at(0.0))
    assert len(surface.kept()[0]) > len(points)


def test_edges_and_invalid_pixels_are_no_surface():
    depth_mm, rgb = wall(2.0)
    depth_mm[:, 40] = 1500  # a thin flying line
    depth_mm[10] = 0
    depth_mm[30, 20] = 900  # a flying pixel
    surface = Surface()
    surface.add(depth_mm, rgb, CAMERA, at(0.0))
    rows = np.round(surface.points[:, 1] / surface.points[:, 2] * 60 + 29.5).astype(int)
    columns = np.round(surface.points[:, 0] / surface.points[:, 2] * 60 + 39.5).astype(int)
    assert 10 not in rows and (30, 20) not in set(zip(rows.tolist(), columns.tolist()))
    assert (surface.points[:, 2] > 0.95).all()


@pytest.mark.parametrize("most", [100, 1000, 5000])
def test_a_large_room_has_wider_cells_and_not_more_points(most):
    surface = Surface(most)
    for x in range(8):
        surface.add(*wall(2.0), CAMERA, at(2.0 * x))
        assert len(surface) <= most
    assert surface.cell_m > CELL_M and surface.begun > 0
    points = surface.kept()[0]
    assert len(points) > most / 3
    assert np.ptp(points[:, 0]) > 15.0


def test_the_views_of_a_graph_keep_their_colours():
    space = SeenSpace()
    camera = Intrinsics(*(8 * CAMERA), 8 * WIDTH, 8 * HEIGHT)
    for number, (colour, x) in enumerate([(RED, 0.0), (BLUE, 4.0), (None, 8.0)]):
        depth_mm, rgb = wall(2.0, colour or RED)
        grid = DepthGrid(depth_mm, 8, camera, None, None if colour is None else rgb)
        nothing = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, len(VOCABULARY.classes)))
        space.note(local_graph(number, *nothing, depth_grid=grid, T_world_camera=at(x)))
    assert len(space) == 3
    again = SeenSpace()
    again.restore(space.arrays())
    found = {tuple(row) for row in surface_of(again).kept()[1].tolist()}
    assert found == {RED, BLUE, (GREY,) * 3}
    older = {name: value for name, value in space.arrays().items() if name != "view_colours"}
    again.restore(older)
    assert (again.colours == GREY).all() and again.colours.shape == (3, HEIGHT, WIDTH, 3)
    assert len(surface_of(None)) == 0


def test_points_have_the_id_of_the_smallest_box_around_them():
    points, colours, _ = surface_of(seen_room()).kept()
    low, high = np.array(BLOCK)
    block = box_at(((low + high) / 2).tolist(), (high - low).tolist())
    room = box_at([0, 0, 1.25], [3.8, 2.8, 2.6])
    nodes = [make_node(7, "box", box=block), make_node(9, "room", box=room), make_node(3, "x")]
    for order in (nodes, nodes[::-1]):
        ids = objects_at(points, order)
        is_block = (colours == BLOCK_RGB).all(axis=1)
        assert is_block.sum() > 100
        assert set(ids[is_block]) == {7}
        assert set(ids[~is_block & (np.abs(points[:, 0]) > 1.95)]) == {0}
        assert 9 in ids


def test_a_surface_that_grows_is_that_of_all_views_and_one_that_moved_is_made_anew():
    space, grown = seen_room(), SurfaceOfSpace()
    first = grown.of(space)
    add_view(space, looking((-1.0, 0.5, 1.2), -40.0), 10**11)
    assert grown.of(space) is first
    np.testing.assert_array_equal(first.kept()[0], surface_of(space).kept()[0])
    count = len(first.kept()[0])
    for name in ("depths_mm", "colours", "poses", "cameras", "stamps_ns"):
        setattr(space, name, getattr(space, name)[3:])  # as when there are too many
    assert len(grown.of(space).kept()[0]) == count
    space.move(TrailChange(np.zeros(1, np.int64), *[np.stack([np.eye(4), at(5.0)])] * 2))
    moved = grown.of(space)
    assert moved is not first
    assert moved.kept()[0][:, 0].min() > 2.0
    assert len(grown.of(SeenSpace())) == 0
