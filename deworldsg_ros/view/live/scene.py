"""The 3D scene in the browser, its labels, and the controls beside it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import viser

from deworldsg_ros.client.objects import Point
from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.scene.arrays import Bool, Float32, Float64, Int64, UInt8, shared_areas
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.view.colours import QUIET
from deworldsg_ros.view.live.camera import Shot
from deworldsg_ros.view.live.details import image_html, note_html
from deworldsg_ros.view.live.drawing import Drawing, Label, Shape, rotations
from deworldsg_ros.view.live.state import LiveState

# --- The controls beside the scene.

NONE = "none"
# On a phone the image is small, so that the panel does not cover the scene.
IMAGE_STYLE = (
    "<style>@media (max-width:600px) {.deworldsg-camera img {max-height:11vh}}</style>"
    '<div class="deworldsg-camera" style="padding:0 .8em">'
)


class Panel:
    """The controls of a viewer. A change calls `change` with a function that changes the state.

    Args:
        server: of viser.
        change: runs a function while the state is locked, and draws again.
        fit: moves the camera of a client so that it sees everything.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        change: Callable[[Callable[[LiveState], None]], None],
        fit: Callable[[Any], None],
    ) -> None:
        self._change = change
        self._gui = gui = server.gui
        self._server = server
        self._note = gui.add_html("")
        self._add_time()
        self._object = gui.add_html("", visible=False)
        self._deselect = gui.add_button("Deselect", visible=False)
        self._deselect.on_click(lambda _: change(lambda state: setattr(state, "selected", None)))
        self._camera = gui.add_html("", visible=False)
        self._add_show(fit)
        self._add_filters()

    def _add_time(self) -> None:
        self._slider = self._gui.add_slider(
            "Update", min=0, max=1, step=1, initial_value=1, visible=False,
            hint="the graph after each recorded update",
        )  # fmt: skip
        self._newest = self._gui.add_button("Back to the newest", visible=False)
        self._slider.on_update(self._slid)
        self._newest.on_click(lambda _: self._change(lambda state: setattr(state, "moment", None)))

    def _add_show(self, fit: Callable[[Any], None]) -> None:
        gui = self._gui
        view_all = gui.add_button("View everything")
        # Open, the folders would cover the scene on a phone.
        with gui.add_folder("Show", expand_by_default=False):
            self.shape = gui.add_dropdown("Objects", ("boxes", "ellipsoids"))
            self.labels = gui.add_checkbox("Labels", True)
            self.points = gui.add_checkbox("Surface points", True)
            self.camera = gui.add_checkbox("Camera", True)
            self.floor = gui.add_checkbox("Floor grid", True)
            dark = gui.add_checkbox("Dark", False)
        self.shape.on_update(
            lambda _: self._change(lambda state: setattr(state, "shape", self.shape.value))
        )
        for box in (self.labels, self.points, self.camera, self.floor):
            box.on_update(lambda _: self._change(lambda state: None))
        dark.on_update(lambda _: set_theme(self._server, dark.value))
        view_all.on_click(lambda event: fit(event.client))

    def _add_filters(self) -> None:
        gui = self._gui
        with gui.add_folder("Filter", expand_by_default=False):
            least = gui.add_slider(
                "Objects ≥", min=0, max=1, step=0.05, initial_value=0,
                hint="least probability that it exists and is of its class",
            )  # fmt: skip
            least_relation = gui.add_slider(
                "Relations ≥", min=0, max=1, step=0.05, initial_value=0,
                hint="least probability of a relation",
            )  # fmt: skip
            self._predicates = _Names(gui, "Predicates", QUIET, self._filter)
            self._classes = _Names(gui, "Classes", frozenset(), self._filter)
        least.on_update(lambda _: self._filter(min_probability=least.value))
        least_relation.on_update(lambda _: self._filter(min_relation=least_relation.value))

    def show(self, state: LiveState, lines: Sequence[str], selected: str) -> None:
        """Show the state.

        Args:
            state: the state.
            lines: above the controls.
            selected: HTML of the selected object; empty = none.
        """
        _set(self._note, content=note_html(lines))
        _set(self._object, content=selected, visible=bool(selected))
        _set(self._deselect, visible=bool(selected))
        first, last = state.history.first, state.history.last
        _set(self._slider, min=first, max=max(last, first + 1), visible=last > first)
        moment = last if state.moment is None else state.moment
        if last > first and self._slider.value != moment:
            self._slider.value = moment
        _set(self._newest, visible=state.moment is not None)
        self._classes.show(Counter(state.table.labels))
        self._predicates.show(Counter(edge.predicate for edge in state.edges.values()))

    def show_image(self, jpeg_file: bytes) -> None:
        """Show the image of the camera; empty = none."""
        html = image_html(jpeg_file, "image of the camera with the masks of the objects")
        _set(self._camera, content=f"{IMAGE_STYLE}{html}</div>", visible=bool(html))

    def _slid(self, event: Any) -> None:
        if event.client is not None:  # and not the viewer itself
            self._change(self._choose_moment)

    def _choose_moment(self, state: LiveState) -> None:
        chosen = int(self._slider.value)
        state.moment = None if chosen >= state.history.last else chosen

    def _filter(self, **values: Any) -> None:
        if not values:
            values = {
                "hidden_classes": self._classes.hidden,
                "hidden_predicates": self._predicates.hidden,
            }
        self._change(lambda state: setattr(state, "filter", replace(state.filter, **values)))


class _Names:
    """A checkbox for each name that has appeared, with the number of its uses.

    Attributes:
        hidden: names that are not checked, among them some that have not appeared.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        title: str,
        hidden: Iterable[str],
        changed: Callable[[], None],
    ) -> None:
        self.hidden = frozenset(hidden)
        self._gui = gui
        self._changed = changed
        self._boxes: dict[str, Any] = {}
        with gui.add_folder(title, expand_by_default=False) as self._folder:
            switch = gui.add_button_group("Show", ("all", NONE))
        switch.on_click(lambda _: self._switch(switch.value == NONE))

    def show(self, counts: Mapping[str, int]) -> None:
        """Show the numbers of the names."""
        with self._folder:
            for name in sorted(counts.keys() - self._boxes.keys()):
                box = self._gui.add_checkbox(name, name not in self.hidden)
                box.on_update(lambda event, name=name: self._ticked(event, name))
                self._boxes[name] = box
        for name, box in self._boxes.items():
            _set(box, label=f"{name} ({counts.get(name, 0)})")

    def _ticked(self, event: Any, name: str) -> None:
        if event.client is not None:
            self.hidden = self.hidden ^ {name} if self._is_stale(name) else self.hidden
            self._changed()

    def _is_stale(self, name: str) -> bool:
        return bool(self._boxes[name].value) == (name in self.hidden)

    def _switch(self, none: bool) -> None:
        self.hidden = frozenset(self._boxes) if none else frozenset()
        for box in self._boxes.values():
            box.value = not none
        self._changed()


def set_theme(server: viser.ViserServer, dark: bool) -> None:
    """Light or dark; nothing of the viewer is sent to other machines, so no button to share it."""
    server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)


def _set(handle: Any, **values: Any) -> None:
    """Assign what has changed: viser sends every assignment."""
    for name, value in values.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)


# --- Labels that do not overlap on the screen of one browser.

# Of viser's labels at a scale of one: 12 px letters of this mean width, in a frame.
LETTER_PX = 6.6
HEIGHT_PX = 20.0
FRAME_PX = 12.0
# viser's anchors of a label, and where its centre then is, in half widths and half heights.
ANCHORS = (
    ("bottom-center", 0.0, -1.0),
    ("center-left", 1.0, 0.0),
    ("center-right", -1.0, 0.0),
    ("top-center", 0.0, 1.0),
)
# Objects that cover less than a pixel or two need no label.
FARTHEST_M = 60.0


class Camera(NamedTuple):
    """The camera of a browser.

    Attributes:
        position: (3,) world, metres.
        wxyz: (4,) of its optical axes (x right, y down, z forward) to world.
        fov_rad: vertical field of view.
        width, height: of the view, pixels.
    """

    position: Float64
    wxyz: Float64
    fov_rad: float
    width: float
    height: float

    def project(self, points: Float64) -> tuple[Float64, Float64]:
        """Pixels (n, 2), y downwards, and depths (n,) in metres of points (n, 3)."""
        local = (points - self.position) @ rotations(np.asarray(self.wxyz, np.float64)[None])[0]
        depths = local[:, 2]
        focal_px = self.height / 2 / np.tan(self.fov_rad / 2)
        middle = np.array([self.width, self.height]) / 2
        return middle + focal_px * local[:, :2] / np.maximum(depths, 1e-6)[:, None], depths


class Placed(NamedTuple):
    """A label that is shown, and its anchor for viser."""

    label: Label
    anchor: str


def place(labels: Sequence[Label], camera: Camera, most: int) -> list[Placed]:
    """The labels that have room, at most so many; those of more weight first.

    A label stands above its point, or beside, or below. Without room it is not shown.
    """
    if not labels or most < 1:
        return []
    points_px, depths = camera.project(np.array([label.position for label in labels]))
    sizes = np.array([(FRAME_PX + LETTER_PX * len(label.text), HEIGHT_PX) for label in labels])
    in_view = _in_view(points_px, depths, camera)
    order = sorted(np.flatnonzero(in_view).tolist(), key=lambda index: -labels[index].weight)
    anchors = np.array([(x, y) for _, x, y in ANCHORS])
    taken = np.zeros((most, 4))
    placed: list[Placed] = []
    for index in order:
        half = sizes[index] / 2
        centres = points_px[index] + anchors * half
        boxes = np.hstack([centres - half, centres + half])
        free = shared_areas(boxes, taken[: len(placed)]).sum(axis=1) == 0
        if not free.any():
            continue
        best = int(np.argmax(free))
        taken[len(placed)] = boxes[best]
        placed.append(Placed(labels[index], ANCHORS[best][0]))
        if len(placed) == most:
            break
    return placed


def _in_view(points_px: Float64, depths: Float64, camera: Camera) -> Bool:
    inside = (points_px >= 0) & (points_px <= (camera.width, camera.height))
    return np.asarray(inside.all(axis=1) & (depths > 0.05) & (depths < FARTHEST_M))


# --- The labels in one browser: placed for its camera, in a fixed set of handles.

# One label for so many pixels of the view, and never more than this.
PIXELS_PER_LABEL = 7_000
MOST_LABELS = 150
# From where one looks first, in axes of the floor, with some room around what is seen.
FIRST_VIEW = np.array([-0.35, -0.75, 0.55])
MARGIN, LEAST_HALF_M = 1.04, 0.3


class ClientLabels:
    """Shows labels to one client of a viser server.

    Args:
        client: of viser.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._handles: list[Any] = []
        self._slots: dict[str, int] = {}
        self._seen: tuple[Any, ...] = ()

    def show(self, labels: Sequence[Label]) -> None:
        """Place the labels for the present view; does nothing if neither has changed."""
        camera = camera_of(self._client)
        seen = (labels, *camera.position, *camera.wxyz, camera.width, camera.height)
        if len(seen) == len(self._seen) and seen[0] is self._seen[0] and seen[1:] == self._seen[1:]:
            return
        self._seen = seen
        most = min(int(camera.width * camera.height / PIXELS_PER_LABEL), MOST_LABELS)
        placed = {item.label.key: item for item in place(labels, camera, most)}
        # A label keeps its handle, so that only labels that appear or vanish are sent.
        self._slots = {key: slot for key, slot in self._slots.items() if key in placed}
        free = iter(sorted(set(range(MOST_LABELS)) - set(self._slots.values())))
        with self._client.atomic():
            for key, item in placed.items():
                self._put(self._slots.setdefault(key, -1), key, item, free)
            for slot in set(range(len(self._handles))) - set(self._slots.values()):
                self._handles[slot].visible = False

    def _put(self, slot: int, key: str, item: Placed, free: Any) -> None:
        if slot < 0:
            slot = self._slots[key] = next(free)
        while slot >= len(self._handles):
            name = f"/label{len(self._handles)}"
            self._handles.append(self._client.scene.add_label(name, "", visible=False))
        handle = self._handles[slot]
        handle.text, handle.anchor = item.label.text, item.anchor
        handle.position = item.label.position
        handle.visible = True


def has_area(client: Any) -> bool:
    """Whether the page of a client of viser has room for a picture: a panel may cover all of it."""
    return bool(client.camera.image_width > 0 and client.camera.image_height > 0)


def camera_of(client: Any) -> Camera:
    """The camera of a client of viser."""
    camera = client.camera
    return Camera(camera.position, camera.wxyz, camera.fov, camera.image_width, camera.image_height)


def overview(
    low: Float64, high: Float64, axes: Float64, fov_rad: float, aspect: float
) -> tuple[Float64, Float64]:
    """Where a camera sees everything: its position and the point it looks at, each (3,).

    Args:
        low: lower corner (3,) of what is drawn, world.
        high: upper corner (3,).
        axes: rows (3, 3) two horizontal directions and up, world.
        fov_rad: vertical field of view.
        aspect: width over height of the view.
    """
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, LEAST_HALF_M)
    backwards = FIRST_VIEW / np.linalg.norm(FIRST_VIEW) @ axes
    right = np.cross(axes[2], backwards)
    right /= np.linalg.norm(right)
    corners = half * np.array(list(product((-1, 1), repeat=3)))
    x, y = np.abs(corners @ right), np.abs(corners @ np.cross(backwards, right))
    slope = np.tan(fov_rad / 2)
    distances = np.maximum(x / (slope * aspect), y / slope) + corners @ backwards
    return middle + MARGIN * distances.max() * backwards, middle


# --- The 3D scene in the browser. Handles are made once; updates change their arrays.

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
