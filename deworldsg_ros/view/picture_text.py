"""Texts of the picture: labels of objects and relations, title, scale, legend; and the photos."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64, UInt8
from deworldsg_ros.view.colours import QUIET, shade
from deworldsg_ros.view.labelling import Placement, boxes_at, nearest_on_box, place, place_if_free
from deworldsg_ros.view.top_view import BACKGROUND, FAINT, INK, Drawing
from deworldsg_ros.words import counted

# Side of a photo, and the line below it.
PHOTO_IN, CAPTION_IN = 1.1, 0.3
# More labels leave no free space on a page.
MOST_LABELS = 90
# Nodes that are objects with a smaller probability are pale and have a small label.
SURE_FROM = 0.75
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
    styles = [_label_style(nodes[row], len(rows)) for row in rows]
    texts = [f"{nodes[row].label} {nodes[row].id}" for row in rows]
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
        Line2D([], [], color=tint, linewidth=2.0, label=predicate)
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


def is_sure(node: wire.NodeState) -> bool:
    """Whether a node is an object for sure, or its existence is not estimated."""
    return node.existence is msgspec.UNSET or node.existence >= SURE_FROM


def _label_style(node: wire.NodeState, label_count: int) -> dict[str, Any]:
    if not is_sure(node):
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
