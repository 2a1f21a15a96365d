"""The graph as one picture: boxes seen from above, relations as arrows, photos of the objects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib import patheffects, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Polygon

from deworldsg_ros.base.files import write_atomically
from deworldsg_ros.base.words import counted
from deworldsg_ros.client.objects import SceneObject, scene_object
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.scene.arrays import Float64, UInt8, shared_areas
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose, pose_from_quaternion
from deworldsg_ros.scene.vocabulary import verb_of
from deworldsg_ros.view.colours import (
    QUIET,
    class_colours,
    drawable_edges,
    predicate_colours,
    shade,
    view_axes,
)
from deworldsg_ros.wire import messages as wire

# --- Positions of labels that do not overlap: greedy, then improved in sweeps.
#
# All coordinates are pixels of the picture, y upwards; boxes are x1, y1, x2, y2.

# Candidates of a label: a ring of directions at each distance from its anchor.
DIRECTIONS = 16
DISTANCES_PX = (9.0, 18.0, 30.0, 45.0, 62.0, 85.0, 112.0, 145.0)
# More sweeps over a room of 90 labels change nothing.
SWEEPS = 3

# Costs of a candidate: per px² of overlap, px outside the frame, covered anchor, px of distance.
OVERLAP_COST, OUTSIDE_COST, ANCHOR_COST, DISTANCE_COST = 6.0, 50.0, 60.0, 1.6
# Text boxes include a margin: an overlap of this area is not visible.
FREE_OVERLAP_PX2 = 4.0


@dataclass(frozen=True)
class Placement:
    """Boxes of n labels.

    Attributes:
        centres: (n, 2) float64, pixels.
        sizes: (n, 2) float64, pixels.
    """

    centres: Float64
    sizes: Float64

    @property
    def boxes(self) -> Float64:
        """(n, 4) float64."""
        return boxes_at(self.centres, self.sizes)


def boxes_at(centres: Float64, sizes: Float64) -> Float64:
    """(n, 4) boxes of centres (n, 2) and sizes (n, 2); or (4,) of (2,) and (2,)."""
    return np.hstack([centres - sizes / 2, centres + sizes / 2])


def place(anchors: Float64, sizes: Float64, frame: Float64) -> Placement:
    """Place each label near its anchor and inside the frame, off other labels and anchors.

    Args:
        anchors: (n, 2), positions of the objects; the first are placed first.
        sizes: (n, 2), width and height of the labels.
        frame: (4,) box around all labels.
    """
    centres = anchors.copy()
    for sweep in range(SWEEPS + 1):
        for index in range(len(anchors)):
            candidates = _candidates(anchors[index], sizes[index])
            boxes = boxes_at(candidates, sizes[index])
            others = np.arange(len(anchors)) != index
            if sweep == 0:
                others[index:] = False
            taken = Placement(centres[others], sizes[others]).boxes
            cost = OVERLAP_COST * shared_areas(boxes, taken).sum(axis=1)
            cost += OUTSIDE_COST * _outside(boxes, frame)
            cost += ANCHOR_COST * _covered(boxes, anchors)
            cost += DISTANCE_COST * np.linalg.norm(candidates - anchors[index], axis=1)
            centres[index] = candidates[int(np.argmin(cost))]
    return Placement(centres, sizes)


def place_if_free(candidates: Float64, size: Float64, taken: Float64, frame: Float64) -> int | None:
    """Index of the first candidate centre (m, 2) at which a label covers no box, or None."""
    boxes = boxes_at(candidates, size)
    free = (shared_areas(boxes, taken).sum(axis=1) <= FREE_OVERLAP_PX2) & (
        _outside(boxes, frame) == 0
    )
    return int(np.argmax(free)) if free.any() else None


def nearest_on_box(point: Float64, box: Float64) -> Float64:
    """The point of a box (4,) nearest to a point (2,)."""
    return np.clip(point, box[:2], box[2:])


def _candidates(anchor: Float64, size: Float64) -> Float64:
    """Centres around an anchor, with the box's rim at each distance in each direction."""
    angles = np.pi / 2 + 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reach = rays * size / 2
    return np.concatenate([anchor + reach + distance * rays for distance in DISTANCES_PX])


def _outside(boxes: Float64, frame: Float64) -> Float64:
    """(n,) pixels by which boxes exceed the frame."""
    below = np.maximum(frame[:2] - boxes[:, :2], 0.0).sum(axis=1)
    return np.asarray(below + np.maximum(boxes[:, 2:] - frame[2:], 0.0).sum(axis=1))


def _covered(boxes: Float64, points: Float64) -> Float64:
    """(n,) number of points that each box covers, with a margin of 3 pixels."""
    inside = (points[None] > boxes[:, None, :2] - 3.0) & (points[None] < boxes[:, None, 2:] + 3.0)
    return np.asarray(inside.all(axis=2).sum(axis=1), np.float64)


# --- The graph projected into the plane of the picture, and the canvas to draw it on.

DPI = 130
# A picture for a page: the longer side of a room, and enough for the title of a small graph.
LONG_SIDE_IN, LEAST_SIDE_IN = 13.0, 7.0
# Above and below the view: title and legend, half each.
HEAD_IN = 1.0
MARGIN_M = 0.35
BACKGROUND, INK, FAINT = "#fbfaf7", "#2d3142", "#8d93a5"
# More edges per node hide the objects.
EDGES_PER_NODE = 2.5


@dataclass(frozen=True)
class TopView:
    """The graph in the plane of the picture, metres; rows are the nodes of the graph.

    Attributes:
        axes: (3, 3) right, forward and up in the world frame.
        means: (n, 2) centres of the boxes.
        corners: (n, 4, 2) of the boxes.
        heights: (n,) along up.
        points: (k, 2) surface points of each node.
        sure: whether each node is sure (`SceneObject.is_sure`).
        path: (m, 2) camera positions.
    """

    axes: Float64
    means: Float64
    corners: Float64
    heights: Float64
    points: tuple[Float64, ...]
    sure: tuple[bool, ...]
    path: Float64

    @property
    def bounds(self) -> tuple[Float64, Float64]:
        """Lower left and upper right corner of boxes and camera path, with a margin."""
        places = np.vstack([self.corners.reshape(-1, 2), self.path])
        if not len(places):
            places = np.zeros((1, 2))
        low, high = places.min(axis=0), places.max(axis=0)
        return low - MARGIN_M, high + MARGIN_M


@dataclass(frozen=True)
class Drawing:
    """A canvas, and everything that is drawn on it.

    Attributes:
        figure, axes: of matplotlib; `axes` are in metres.
        graph: the graph.
        view: its projection.
        colours: #rrggbb of each class.
        edges: drawn edges, strongest last.
        tints: #rrggbb of each predicate of those edges.
    """

    figure: Figure
    axes: Axes
    graph: wire.SceneGraphMessage
    view: TopView
    colours: dict[str, str]
    edges: list[wire.EdgeState]
    tints: dict[str, str]

    @property
    def ends(self) -> list[tuple[wire.EdgeState, int, int]]:
        """Each drawn edge with the rows of its subject and object."""
        row_of = {node.id: row for row, node in enumerate(self.graph.nodes)}
        return [(edge, row_of[edge.subject], row_of[edge.object]) for edge in self.edges]


def drawing_of(
    graph: wire.SceneGraphMessage,
    up_world: Sequence[float] | Float64,
    camera_path_world: Float64 | None,
    strip_in: float = 0.0,
) -> Drawing:
    """The empty canvas of a graph, with a strip below; other arguments as of `picture.draw`."""
    view = _project(graph, view_axes(up_world), camera_path_world)
    figure, axes = _canvas(view, strip_in)
    edges = _strongest_edges(graph)
    return Drawing(
        figure,
        axes,
        graph,
        view,
        class_colours(node.label for node in graph.nodes),
        edges,
        predicate_colours(Counter(edge.predicate for edge in edges)),
    )


def _project(
    graph: wire.SceneGraphMessage, axes_of_view: Float64, camera_path: Float64 | None
) -> TopView:
    plane, up = axes_of_view[:2], axes_of_view[2].tolist()
    items = [scene_object(node, graph.frame_id, (up[0], up[1], up[2])) for node in graph.nodes]
    centres = np.array([item.position_m for item in items], np.float64).reshape(-1, 3)
    path = np.zeros((0, 3)) if camera_path is None else np.asarray(camera_path, np.float64)
    return TopView(
        axes_of_view,
        centres @ plane.T,
        np.array([_corners(item, plane) for item in items], np.float64).reshape(-1, 4, 2),
        centres @ axes_of_view[2],
        tuple(surface_points(node) @ plane.T for node in graph.nodes),
        tuple(item.is_sure for item in items),
        path.reshape(-1, 3) @ plane.T,
    )


def _corners(item: SceneObject, plane: Float64) -> Float64:
    """Corners (4, 2) of a box seen from above; its third axis is up."""
    rotation = pose_from_quaternion(np.zeros(3), np.array(item.orientation_xyzw))[:3, :3]
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    offsets = signs * np.array(item.size_m[:2]) / 2 @ rotation[:, :2].T
    return np.asarray((np.array(item.position_m) + offsets) @ plane.T)


def _canvas(view: TopView, strip_in: float) -> tuple[Figure, Axes]:
    low, high = view.bounds
    extent = high - low
    size_in = np.maximum(extent * (LONG_SIDE_IN / extent.max()), LEAST_SIDE_IN)
    height_in = size_in[1] + HEAD_IN + strip_in
    figure = Figure(figsize=(size_in[0], height_in), dpi=DPI)
    FigureCanvasAgg(figure)
    foot = (HEAD_IN / 2 + strip_in) / height_in
    axes = figure.add_axes((0.0, foot, 1.0, size_in[1] / height_in))
    axes.set_axis_off()
    middle, half = (low + high) / 2, extent / 2
    half = np.max(half / size_in) * size_in
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    axes.set_aspect("equal", adjustable="box")
    return figure, axes


def _strongest_edges(graph: wire.SceneGraphMessage) -> list[wire.EdgeState]:
    """The strongest edges but QUIET ones, strongest last, so that they are drawn on top."""
    loud = [edge for edge in drawable_edges(graph) if edge.predicate not in QUIET]
    edges = sorted(loud, key=_strength, reverse=True)
    return edges[: int(EDGES_PER_NODE * len(graph.nodes))][::-1]


def _strength(edge: wire.EdgeState) -> tuple[float, int]:
    return (round(edge.probability, 2), edge.observations)


# --- Texts of the picture: labels of objects and relations, title, scale, legend; and the photos.

# Side of a photo, and the line below it.
PHOTO_IN, CAPTION_IN = 1.1, 0.3
# More labels leave no free space on a page.
MOST_LABELS = 90
# Of matplotlib's arc3 arrows: enough to separate an edge from its opposite.
CURVATURE = 0.16
HALO = [patheffects.withStroke(linewidth=2.6, foreground=BACKGROUND)]
PREDICATE_STYLE: dict[str, Any] = {"fontsize": 7.0, "fontstyle": "italic"}
# Positions of a predicate along its arrow, best first.
PREDICATE_FRACTIONS = (0.5, 0.42, 0.58, 0.34, 0.66)


def edge_alpha(edge: wire.EdgeState) -> float:
    """Opacity of an edge, 0 to 1: it grows with the probability and the observations."""
    seen = min(edge.observations, 5) / 5 if edge.provenance == "visual" else 1.0
    return float(0.12 + 0.78 * min(edge.probability, 1.0) ** 2 * (0.35 + 0.65 * seen))


def draw_labels(drawing: Drawing) -> Placement:
    """Write the labels of the most observed objects; return their boxes in pixels."""
    axes, nodes = drawing.axes, drawing.graph.nodes
    rows = sorted(range(len(nodes)), key=lambda row: -nodes[row].observations)[:MOST_LABELS]
    if not rows:
        return Placement(np.zeros((0, 2)), np.zeros((0, 2)))
    sure = drawing.view.sure
    styles = [_label_style(sure[row], len(rows)) for row in rows]
    texts = [f"{nodes[row].label}{'' if sure[row] else '?'} {nodes[row].id}" for row in rows]
    sizes = np.array([_text_size(axes, text, **style) for text, style in zip(texts, styles)])
    anchors = axes.transData.transform(drawing.view.means[rows])
    placed = place(anchors, sizes, _frame_px(axes))
    to_data = axes.transData.inverted()
    for row, text, style, anchor, centre, box in zip(
        rows, texts, styles, anchors, placed.centres, placed.boxes
    ):
        colour = shade(drawing.colours[nodes[row].label], 0.62)
        near = nearest_on_box(anchor, box)
        if np.linalg.norm(near - anchor) > 14:  # pixels; a label farther away gets a line
            line = to_data.transform([near, anchor])
            axes.plot(*line.T, color=colour, linewidth=0.6, alpha=0.55, zorder=6)
        _write(axes, to_data.transform(centre), text, color=colour, zorder=8, **style)
    return placed


def draw_predicates(drawing: Drawing, labels: Placement) -> None:
    """Write the predicates of the strongest edges into free space along their arrows."""
    axes, means = drawing.axes, drawing.view.means
    pixels = axes.transData.transform(means) if len(means) else np.zeros((0, 2))
    taken = np.vstack([labels.boxes, boxes_at(pixels, np.array([8.0, 8.0]))])
    frame, to_data = _frame_px(axes), axes.transData.inverted()
    sizes = {name: _text_size(axes, name, **PREDICATE_STYLE) for name in drawing.tints}
    for edge, subject, object_ in reversed(drawing.ends):
        tail, tip, size = pixels[subject], pixels[object_], sizes[edge.predicate]
        if np.linalg.norm(tip - tail) < size[0] + 8:
            continue
        candidates = np.array([_along(tail, tip, fraction) for fraction in PREDICATE_FRACTIONS])
        chosen = place_if_free(candidates, size, taken, frame)
        if chosen is None:
            continue
        centre = candidates[chosen]
        taken = np.vstack([taken, boxes_at(centre, size)])
        colour = shade(drawing.tints[edge.predicate], 0.8)
        style = {"alpha": max(edge_alpha(edge), 0.55), "zorder": 7, **PREDICATE_STYLE}
        _write(axes, to_data.transform(centre), edge.predicate, color=colour, **style)


def draw_frame(drawing: Drawing, strip_in: float = 0.0) -> None:
    """Write title, scale bar, world axes, and the legend of predicates, above a strip."""
    figure = drawing.figure
    height_in = figure.get_figheight()
    pad = 0.25 / figure.get_figwidth()
    top, bottom = 1 - 0.27 / height_in, (0.27 + strip_in) / height_in
    graph = drawing.graph
    title = f"{counted(len(graph.nodes), 'object')}, {counted(len(graph.edges), 'relation')}"
    figure.text(pad, top, title, fontsize=12, fontweight="bold", color=INK, va="center")
    note = "seen from above"
    if drawing.edges:
        note += "; arrows lead from A to B"
    if not all(drawing.view.sure):
        note += "; pale, with ?: not sure"
    if any(edge.predicate in QUIET for edge in graph.edges):
        note += "; relations “near” are left out"
    if len(drawing.view.path):
        note += "; dotted line: the camera, from ● to ○"
    figure.text(1 - pad, top, note, fontsize=8.5, color=FAINT, va="center", ha="right")
    _draw_scale(drawing, pad, bottom)
    _draw_legend(drawing, pad, bottom)


def draw_photos(drawing: Drawing, photos: Mapping[int, UInt8]) -> None:
    """A row of photos below the view, those of the most observed objects, with their names."""
    figure, nodes = drawing.figure, drawing.graph.nodes
    width_in, height_in = figure.get_figwidth(), figure.get_figheight()
    gap_in = 0.1
    shown = sorted(
        (node for node in nodes if node.id in photos), key=lambda node: -node.observations
    )[: int((width_in - gap_in) / (PHOTO_IN + gap_in))]
    for index, node in enumerate(shown):
        left = (gap_in + index * (PHOTO_IN + gap_in)) / width_in
        place = (left, CAPTION_IN / height_in, PHOTO_IN / width_in, PHOTO_IN / height_in)
        axes = figure.add_axes(place)
        axes.imshow(photos[node.id], interpolation="none")
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set(color=drawing.colours[node.label], linewidth=2.0)
        text = f"{node.label} {node.id}"
        # The photos are narrow.
        text = text if len(text) <= 17 else f"{node.label[: 15 - len(str(node.id))]}… {node.id}"
        middle = left + PHOTO_IN / 2 / width_in
        style: dict[str, Any] = {"fontsize": 8, "color": INK, "ha": "center", "va": "center"}
        figure.text(middle, CAPTION_IN / 2 / height_in, text, **style)


def _draw_scale(drawing: Drawing, pad: float, bottom: float) -> None:
    figure, to_px = drawing.figure, drawing.axes.transData.transform
    metre_px = float(to_px((1, 0))[0] - to_px((0, 0))[0])
    length_m = max((m for m in (0.1, 0.25, 0.5, 1, 2, 5, 10, 50) if m * metre_px < 280), default=50)
    end = pad + length_m * metre_px / figure.bbox.width
    figure.add_artist(Line2D([pad, end], [bottom, bottom], color=INK, linewidth=2.2))
    style: dict[str, Any] = {"fontsize": 9, "va": "center"}
    figure.text(end + pad / 3, bottom, f"{length_m:g} m", color=INK, **style)
    right, forward = map(_axis_name, drawing.view.axes[:2])
    axes = f"world frame {drawing.graph.frame_id!r}: {right} →, {forward} ↑"
    figure.text(end + pad * 3, bottom, axes, color=FAINT, **style)


def _draw_legend(drawing: Drawing, pad: float, bottom: float) -> None:
    handles = [
        Line2D([], [], color=tint, linewidth=2.0, label=f"A {verb_of(predicate)} B")
        for predicate, tint in drawing.tints.items()
    ]
    if handles:
        drawing.figure.legend(
            handles=handles[:10],
            loc="center right",
            bbox_to_anchor=(1 - pad / 2, bottom),
            ncols=10,
            frameon=False,
            fontsize=8.5,
            labelcolor=INK,
            handlelength=1.3,
            columnspacing=1.2,
            handletextpad=0.5,
        )


def _axis_name(axis: Float64) -> str:
    """`x`, `-y`, … for an axis of the world frame; the coordinates of any other direction."""
    largest = int(np.abs(axis).argmax())
    if abs(axis[largest]) > 0.999:
        return ("" if axis[largest] > 0 else "-") + "xyz"[largest]
    return "(" + ", ".join(f"{value:.2f}" for value in axis) + ")"


def _write(axes: Axes, position: Float64, text: str, **style: Any) -> None:
    x, y = position.tolist()
    axes.text(x, y, text, ha="center", va="center", path_effects=HALO, **style)


def _text_size(axes: Axes, text: str, **style: Any) -> Float64:
    """(2,) width and height of a text in pixels, with a small margin."""
    probe = axes.text(0, 0, text, **style)
    extent = probe.get_window_extent(axes.figure.canvas.get_renderer())  # type: ignore[attr-defined]
    probe.remove()
    return np.array([extent.width + 3, extent.height + 1])


def _frame_px(axes: Axes) -> Float64:
    extent = axes.get_window_extent()
    return np.array([extent.x0 + 4, extent.y0 + 4, extent.x1 - 4, extent.y1 - 4])


def _label_style(is_sure: bool, label_count: int) -> dict[str, Any]:
    if not is_sure:
        return {"fontsize": 7.0, "alpha": 0.75}
    return {"fontsize": 9.0 if label_count <= 40 else 8.0, "fontweight": "bold"}


def _along(tail: Float64, tip: Float64, fraction: float) -> Float64:
    """Point of the curve that an arc3 arrow follows (a quadratic Bézier), pixels."""
    chord = tip - tail
    control = (tail + tip) / 2 + CURVATURE * np.array([chord[1], -chord[0]])
    rest = 1 - fraction
    return np.asarray(
        rest**2 * tail + 2 * rest * fraction * control + fraction**2 * tip, np.float64
    )


# --- The graph as one picture: boxes seen from above, relations as arrows, photos of the objects.
#
# A crowded room stays readable by six rules: "near" is left out; of two mutual relations one is
# drawn; weak edges are faint; at most EDGES_PER_NODE edges per node are drawn, the strongest; a
# predicate is written only into free space; above MOST_LABELS objects, the most observed have
# labels.

# More surface points add time, not detail, at this resolution.
POINTS_DRAWN = 30_000


@rc_context({"text.parse_math": False})  # a label may contain $
def draw(
    graph: wire.SceneGraphMessage,
    path: str | Path,
    *,
    up_world: Sequence[float] | Float64 = (0.0, 0.0, 1.0),
    camera_path_world: Float64 | None = None,
    photos: Mapping[int, UInt8] | None = None,
) -> None:
    """Write the picture as a PNG.

    Args:
        graph: the graph, with or without surface points.
        path: file to write.
        up_world: (3,) direction that points up in the world frame.
        camera_path_world: (n, 3) positions of the camera, metres; None = not drawn.
        photos: (s, s, 3) uint8 RGB by id of the node (`photos_of`), for the strip below.

    Raises:
        ValueError: for an up direction of zero length.
        OSError: if the picture cannot be written.
    """
    strip_in = PHOTO_IN + CAPTION_IN if photos else 0.0
    drawing = drawing_of(graph, up_world, camera_path_world, strip_in)
    _draw_points(drawing)
    _draw_path(drawing)
    _draw_boxes(drawing)
    _draw_arrows(drawing)
    draw_predicates(drawing, draw_labels(drawing))
    draw_frame(drawing, strip_in)
    if photos:
        draw_photos(drawing, photos)
    write_atomically(
        Path(path),
        lambda file: drawing.figure.savefig(file, format="png", dpi=DPI, facecolor=BACKGROUND),
    )


def _draw_points(drawing: Drawing) -> None:
    view = drawing.view
    stride = max(1, -(-sum(map(len, view.points)) // POINTS_DRAWN))
    for row in np.argsort(view.heights):
        x, y = view.points[row][::stride].T
        colour = drawing.colours[drawing.graph.nodes[row].label]
        drawing.axes.scatter(x, y, s=6, color=colour, alpha=0.22, linewidths=0, zorder=1)


def _draw_path(drawing: Drawing) -> None:
    path, axes = drawing.view.path, drawing.axes
    if not len(path):
        return
    axes.plot(*path.T, color=FAINT, linewidth=1.1, linestyle=(0, (1, 2)), zorder=2)
    axes.plot(*path[0], "o", color=FAINT, markersize=5, zorder=2)
    if len(path) > 1:
        axes.plot(*path[-1], "o", color=BACKGROUND, mec=FAINT, markersize=5, zorder=2)


def _draw_boxes(drawing: Drawing) -> None:
    """Boxes of the nodes, higher objects on top; unsure ones paler."""
    view, nodes, axes = drawing.view, drawing.graph.nodes, drawing.axes
    for order, row in enumerate(np.argsort(view.heights)):
        alpha = 1.0 if view.sure[row] else 0.45
        fill = drawing.colours[nodes[row].label]
        rim = shade(fill, 0.8)
        zorder = 3 + order / (len(nodes) + 1)
        corners = view.corners[row]
        axes.add_patch(Polygon(corners, fc=fill, alpha=0.13 * alpha, lw=0, zorder=zorder))
        axes.add_patch(
            Polygon(corners, fill=False, ec=rim, alpha=0.9 * alpha, lw=1.3, zorder=zorder)
        )
        axes.plot(*view.means[row], "o", color=rim, markersize=3.4, alpha=alpha, zorder=zorder)


def _draw_arrows(drawing: Drawing) -> None:
    for edge, tail, tip in drawing.ends:
        drawing.axes.add_patch(
            FancyArrowPatch(
                tuple(drawing.view.means[tail]),
                tuple(drawing.view.means[tip]),
                arrowstyle="-|>,head_length=5,head_width=2.4",
                connectionstyle=f"arc3,rad={CURVATURE}",
                shrinkA=3,
                shrinkB=4,
                color=drawing.tints[edge.predicate],
                alpha=edge_alpha(edge),
                linewidth=1.15,
                zorder=5,
            )
        )


# --- A photo of each object, cut from frames of the camera.

POINTS_OF_AN_OBJECT = 64
# A point is seen if the depth image has a surface this close to it, and this part of its distance.
NEAR_M, NEAR_PART = 0.05, 0.02
# Of an object that is cut off or covered by more than this, there is no photo.
LEAST_SEEN = 0.5
# Around the object, as a part of the photo.
PHOTO_MARGIN = 0.18


def photos_of(
    graph: wire.SceneGraphMessage, frames: Iterable[RgbdFrame], side_px: int
) -> dict[int, UInt8]:
    """The best photo of each object that a frame shows.

    Args:
        graph: with surface points.
        frames: in the world frame of the graph.
        side_px: sides of the photos.

    Returns:
        (side_px, side_px, 3) uint8 RGB by id of the node. Of an object that no frame shows by at
        least one half, there is none.
    """
    points = {node.id: _sample(surface_points(node)) for node in graph.nodes}
    best: dict[int, tuple[float, RgbdFrame, Float64]] = {}
    for frame in frames:
        for node_id, cloud in points.items():
            if not len(cloud):
                continue
            score, box = _sight(frame, cloud)
            if score > 0 and (node_id not in best or score > best[node_id][0]):
                best[node_id] = score, frame, box
    return {node_id: _cut(frame, box, side_px) for node_id, (_, frame, box) in best.items()}


def _sample(points: Float64) -> Float64:
    return points[:: max(1, len(points) // POINTS_OF_AN_OBJECT)]


def _sight(frame: RgbdFrame, points: Float64) -> tuple[float, Float64]:
    """How well a frame shows an object: 0 = not; and the box x1 y1 x2 y2 around its points."""
    T = invert_pose(frame.T_world_camera)
    x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
    camera = frame.intrinsics
    is_ahead = z > NEAR_M
    depth = np.where(is_ahead, z, 1.0)
    u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    inside = is_ahead & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    if inside.mean() < LEAST_SEEN:
        return 0.0, np.zeros(4)
    seen_m = frame.depth_m[v[inside].astype(int), u[inside].astype(int)]
    share = float((np.abs(seen_m - z[inside]) < NEAR_M + NEAR_PART * z[inside]).sum()) / len(points)
    u, v = u[inside], v[inside]
    box = np.array([u.min(), v.min(), u.max() + 1, v.max() + 1])
    if share < LEAST_SEEN:
        return 0.0, box
    # More pixels are better, but not if the object is covered.
    return share**4 * float(np.sqrt((box[2] - box[0]) * (box[3] - box[1]))), box


def _cut(frame: RgbdFrame, box: Float64, side_px: int) -> UInt8:
    """A square around a box, moved into the image; what is still outside is grey."""
    height, width = frame.rgb.shape[:2]
    side = int(np.ceil(max(box[2] - box[0], box[3] - box[1]) * (1 + 2 * PHOTO_MARGIN)))
    middle = np.array([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2])
    room = np.array([width - side, height - side])
    low = np.where(room >= 0, np.clip(middle - side / 2, 0, np.maximum(room, 0)), room / 2)
    x, y = np.round(low).astype(int).tolist()
    photo = np.full((side, side, 3), 128, np.uint8)
    rows, columns = slice(max(y, 0), y + side), slice(max(x, 0), x + side)
    part = frame.rgb[rows, columns]
    top, left = max(-y, 0), max(-x, 0)
    photo[top : top + part.shape[0], left : left + part.shape[1]] = part
    how = cv2.INTER_AREA if side > side_px else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(photo, (side_px, side_px), interpolation=how))
