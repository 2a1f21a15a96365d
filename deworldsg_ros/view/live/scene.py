"""The 3D scene in the browser. Handles are made once; updates change their arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from deworldsg_ros.client.objects import Point
from deworldsg_ros.scene.arrays import Float32, Float64, Int64, UInt8
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.scene.extent import horizontal_axes
from deworldsg_ros.view.live.camera import Shot
from deworldsg_ros.view.live.drawing import Drawing, Shape

ARROW = {"shaft_radius": 0.009, "head_radius": 0.03, "head_length": 0.08}
OUTLINE_PX, LINE_PX, TRAIL_PX = 2.0, 2.0, 2.0
POINT_M = 0.012
TRAIL_RGB, FRUSTUM_RGB, GRID_RGB = (216, 120, 40), (216, 120, 40), (150, 154, 166)
GRID_MARGIN_M = 1.5
# More points of the trail are not visible.
MOST_TRAIL = 1000
SPHERE_RINGS = 12

_NO_PLACE, _NO_TURN = np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]])


class ViserScene:
    """The scene of a viser server.

    Args:
        server: of viser.
        on_click: called with the id of the object that was clicked.
    """

    def __init__(self, server: viser.ViserServer, on_click: Callable[[int], None]) -> None:
        self._scene = server.scene
        self._ids: Int64 = np.zeros(0, np.int64)
        self._shape: Shape = "boxes"
        solids = {"boxes": _solid(_cube()), "ellipsoids": _solid(_sphere())}
        self._solids = {
            shape: self._scene.add_batched_meshes_simple(
                f"/{shape}",
                vertices,
                faces,
                batched_wxyzs=_NO_TURN,
                batched_positions=_NO_PLACE,
                batched_scales=np.ones((1, 3)),
                batched_colors=np.zeros((1, 3), np.uint8),
                batched_opacities=np.ones(1),
                lod="off",
                flat_shading=shape == "boxes",
                cast_shadow=False,
                receive_shadow=False,
                visible=False,
            )
            for shape, (vertices, faces) in solids.items()
        }
        for handle in self._solids.values():
            handle.on_click(lambda event: self._clicked(event, on_click))
        none, no_colours = np.zeros((1, 2, 3)), np.zeros((1, 2, 3), np.uint8)
        lines = self._scene.add_line_segments
        self._outlines = lines("/outlines", none, no_colours, **_screen(OUTLINE_PX), visible=False)
        self._lines = lines("/symmetric", none, no_colours, **_screen(LINE_PX), visible=False)
        self._trail = lines("/trail", none, TRAIL_RGB, **_screen(TRAIL_PX), visible=False)
        self._arrows = self._scene.add_arrows(
            "/directed", none, no_colours[:, 0], **ARROW, visible=False
        )
        self._points = self._scene.add_point_cloud(
            "/points", _NO_PLACE, np.zeros((1, 3), np.uint8), point_size=POINT_M,
            point_shape="circle", precision="float32", visible=False,
        )  # fmt: skip
        self._frustum: viser.CameraFrustumHandle | None = None
        self._grid: tuple[viser.GridHandle, Float64] | None = None

    def show(self, drawing: Drawing, shape: Shape) -> None:
        """Show the objects and relations of a drawing."""
        self._ids = drawing.ids
        for name, handle in self._solids.items():
            handle.visible = name == shape and len(drawing.ids) > 0
        if len(drawing.ids):
            solids = self._solids[shape]
            solids.batched_positions = drawing.positions
            solids.batched_wxyzs = drawing.wxyzs
            solids.batched_scales = drawing.scales
            solids.batched_colors = _linear(drawing.colours)
            solids.batched_opacities = drawing.opacities
        _put_segments(self._outlines, drawing.outlines, _both_ends(drawing.outline_colours))
        _put_segments(self._arrows, drawing.arrows, drawing.arrow_colours)
        _put_segments(self._lines, drawing.lines, _both_ends(drawing.line_colours))

    def show_points(self, points: Float32, colours: UInt8) -> None:
        """Show surface points (n, 3) with their colours (n, 3)."""
        self._points.visible = len(points) > 0
        if len(points):
            self._points.points, self._points.colors = points, colours

    def show_camera(self, shots: Sequence[Shot]) -> None:
        """Show the frustum of the last frame, and the way of all frames."""
        if not shots:
            self._trail.visible = False
            if self._frustum is not None:
                self._frustum.visible = False
            return
        newest = shots[-1]
        places = np.array([shot.T_world_camera[:3, 3] for shot in shots])
        places = places[:: -(-len(places) // MOST_TRAIL)]
        _put_segments(self._trail, np.stack([places[:-1], places[1:]], axis=1), None)
        if self._frustum is None:
            self._frustum = self._scene.add_camera_frustum(
                "/camera", newest.fov_rad, newest.aspect, scale=0.22, color=FRUSTUM_RGB,
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        self._frustum.visible = True
        self._frustum.fov, self._frustum.aspect = newest.fov_rad, newest.aspect
        self._frustum.wxyz = np.roll(quaternion_from_rotation(newest.T_world_camera[:3, :3]), 1)
        self._frustum.position = newest.T_world_camera[:3, 3]

    def show_floor(self, low: Float64, high: Float64, floor_m: float, up: Point) -> None:
        """Show a grid below the objects, if it is not there already.

        Args:
            low: lower corner (3,) of the objects, world.
            high: upper corner (3,).
            floor_m: height along `up`.
            up: unit vector against gravity.
        """
        axes = horizontal_axes(up)
        corners = np.stack([axes @ low, axes @ high])
        middle = corners.mean(axis=0)
        size_m = float(np.ptp(corners[:, :2], axis=0).max()) + 2 * GRID_MARGIN_M
        layout = np.round([middle[0], middle[1], floor_m, size_m, *up], 1)
        if self._grid is not None and np.abs(self._grid[1] - layout).max() < 0.35:
            return
        self._scene.set_up_direction(up)
        handle = self._scene.add_grid(
            "/floor", layout[3], layout[3], cell_size=0.5, section_size=1.0,
            cell_color=GRID_RGB, section_color=GRID_RGB, cell_thickness=0.5,
            wxyz=np.roll(quaternion_from_rotation(axes.T), 1),
            position=np.array([middle[0], middle[1], floor_m]) @ axes,
            visible=self._grid is None or self._grid[0].visible,
        )  # fmt: skip
        self._grid = handle, layout

    def switch_floor(self, visible: bool) -> None:
        """Show or hide the floor grid."""
        if self._grid is not None:
            self._grid[0].visible = visible

    def _clicked(self, event: Any, on_click: Callable[[int], None]) -> None:
        index, ids = event.instance_index, self._ids
        if index is not None and index < len(ids):
            on_click(int(ids[index]))


def _solid(rings: Float64) -> tuple[Float64, Int64]:
    """A closed surface from rings (m, n, 3) of points, from the lowest one to the highest.

    Returns vertices (m n, 3), and triangles (f, 3) that face outwards.
    """
    count, size = rings.shape[:2]
    corners = np.arange(count * size).reshape(count, size)
    low, high = corners[:-1], corners[1:]
    right_low, right_high = np.roll(low, -1, axis=1), np.roll(high, -1, axis=1)
    sides = [np.stack(t, axis=-1) for t in ((low, right_low, right_high), (low, right_high, high))]
    ends = [corners[0, [0, i + 1, i]] for i in range(1, size - 1)]
    ends += [corners[-1, [0, i, i + 1]] for i in range(1, size - 1)]
    return rings.reshape(-1, 3), np.concatenate([part.reshape(-1, 3) for part in sides + ends])


def _cube() -> Float64:
    """Two rings (2, 4, 3): bottom and top of the unit cube."""
    ring = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
    return np.stack([np.insert(ring, 2, height, axis=1) for height in (-0.5, 0.5)])


def _sphere() -> Float64:
    """Rings (m, n, 3) of a sphere of diameter one."""
    tilts = np.linspace(-0.49 * np.pi, 0.49 * np.pi, SPHERE_RINGS)[:, None]
    angles = 2 * np.pi * np.arange(2 * SPHERE_RINGS) / (2 * SPHERE_RINGS)
    x, y = np.cos(tilts) * np.cos(angles), np.cos(tilts) * np.sin(angles)
    return np.stack([x, y, np.broadcast_to(np.sin(tilts), x.shape)], axis=-1) / 2


def _screen(width_px: float) -> dict[str, Any]:
    return {"thickness": width_px, "thickness_units": "screen"}


def _put_segments(handle: Any, segments: Float64, colours: UInt8 | None) -> None:
    """Replace segments (n, 2, 3) and their colours; None = the colours stay."""
    handle.visible = len(segments) > 0
    if len(segments):
        handle.points = segments.astype(np.float32)
        if colours is not None:
            handle.colors = _linear(colours)


def _linear(colours: UInt8) -> UInt8:
    """sRGB as linear light: viser takes the colours of lines and batches so, but not of points."""
    share = colours / 255
    return np.round(255 * ((share + 0.055) / 1.055) ** 2.4).astype(np.uint8)


def _both_ends(colours: UInt8) -> UInt8:
    """The colours (n, 2, 3) of both ends of lines, of one colour (n, 3) each."""
    return np.repeat(colours[:, None], 2, axis=1)
