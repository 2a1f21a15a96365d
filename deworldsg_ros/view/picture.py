"""The graph as one picture: seen from above, Gaussians as 2σ ellipses, relations as arrows.

What is left out, so that a full room stays readable: of two mutual relations one is drawn; weak
edges are faint; at most EDGES_A_NODE edges a node are drawn, the surest; a predicate is written
only where it covers nothing; of more than MOST_LABELS objects, the most observed have labels.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, FancyArrowPatch

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.view.colours import class_colours, predicate_colours, shade
from deworldsg_ros.view.geometry import SIGMAS, covariances_of, drawable_edges, means_of, view_axes
from deworldsg_ros.view.labelling import Placement, nearest_on_box, place, place_if_free

DPI = 130
LONG_SIDE_IN, LEAST_SIDE_IN = 13.0, 7.0
MARGIN_M = 0.35
BACKGROUND, INK, FAINT = "#fbfaf7", "#2d3142", "#8d93a5"
MOST_LABELS = 90
# Objects seen in fewer frames are drawn paler.
SURE_FROM = 3
EDGES_A_NODE = 2.5
POINTS_DRAWN = 30_000
CURVATURE = 0.16
HALO = [patheffects.withStroke(linewidth=2.6, foreground=BACKGROUND)]


@dataclass(frozen=True)
class TopView:
    """The graph in the plane of the picture, metres; rows are the graph's nodes."""

    means: Float64
    covariances: Float64
    heights: Float64
    points: tuple[Float64, ...]
    path: Float64

    @property
    def bounds(self) -> tuple[Float64, Float64]:
        """Lower left and upper right corner of everything that is drawn, with a margin."""
        reach = SIGMAS * np.sqrt(np.stack([np.diag(c) for c in self.covariances] or [np.zeros(2)]))
        means = self.means if len(self.means) else np.zeros((1, 2))
        low = np.vstack([means - reach, self.path.reshape(-1, 2)]).min(axis=0)
        high = np.vstack([means + reach, self.path.reshape(-1, 2)]).max(axis=0)
        return low - MARGIN_M, high + MARGIN_M


def draw(
    graph: wire.SceneGraphMessage,
    path: str | Path,
    *,
    up_world: Sequence[float] | Float64 = (0.0, 0.0, 1.0),
    camera_path_world: Float64 | None = None,
) -> None:
    """Write the picture as a PNG.

    Args:
        graph: with surface points, or without.
        path: of the file.
        up_world: (3,) direction that points up in the world frame.
        camera_path_world: (n, 3) positions of the camera, metres, to be drawn too.
    """
    axes_of_view = view_axes(up_world)
    view = _project(graph, axes_of_view, camera_path_world)
    figure, axes = _canvas(view)
    colours = class_colours(node.label for node in graph.nodes)
    edges = _chosen_edges(graph)
    tints = predicate_colours(Counter(edge.predicate for edge in edges))

    _draw_points(axes, graph, view, colours)
    _draw_path(axes, view)
    _draw_ellipses(axes, graph, view, colours)
    _draw_arrows(axes, graph, view, edges, tints)
    placed = _draw_labels(axes, graph, view, colours)
    _draw_predicates(axes, graph, view, edges, tints, placed)
    _draw_frame(figure, axes, graph, view, axes_of_view, tints)
    figure.savefig(path, dpi=DPI, facecolor=BACKGROUND)


def _project(
    graph: wire.SceneGraphMessage, axes_of_view: Float64, camera_path: Float64 | None
) -> TopView:
    plane = axes_of_view[:2]
    means = means_of(graph)
    path = np.zeros((0, 3)) if camera_path is None else np.asarray(camera_path, np.float64)
    return TopView(
        means @ plane.T,
        plane @ covariances_of(graph) @ plane.T,
        means @ axes_of_view[2],
        tuple(
            np.array(node.surface_points_m, np.float64).reshape(-1, 3) @ plane.T
            for node in graph.nodes
        ),
        path.reshape(-1, 3) @ plane.T,
    )


def _canvas(view: TopView) -> tuple[Figure, Axes]:
    low, high = view.bounds
    extent = high - low
    size_in = np.maximum(extent * (LONG_SIDE_IN / extent.max()), LEAST_SIDE_IN)
    figure = Figure(figsize=(size_in[0], size_in[1] + 1.0), dpi=DPI)
    FigureCanvasAgg(figure)
    head = 0.5 / (size_in[1] + 1.0)
    axes = figure.add_axes((0.0, head, 1.0, 1.0 - 2 * head))
    axes.set_axis_off()
    middle, half = (low + high) / 2, extent / 2
    half = np.max(half / size_in) * size_in
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])
    axes.set_aspect("equal", adjustable="box")
    return figure, axes


def _draw_points(
    axes: Axes, graph: wire.SceneGraphMessage, view: TopView, colours: dict[str, str]
) -> None:
    total = sum(map(len, view.points))
    stride = max(1, -(-total // POINTS_DRAWN))
    for row in np.argsort(view.heights):
        points = view.points[row][::stride]
        colour = colours[graph.nodes[row].label]
        axes.scatter(
            points[:, 0], points[:, 1], s=6, color=colour, alpha=0.22, linewidths=0, zorder=1
        )


def _draw_path(axes: Axes, view: TopView) -> None:
    if not len(view.path):
        return
    axes.plot(*view.path.T, color=FAINT, linewidth=1.1, linestyle=(0, (1, 2)), zorder=2)
    axes.plot(*view.path[0], "o", color=FAINT, markersize=5, zorder=2)
    if len(view.path) > 1:
        axes.plot(*view.path[-1], "o", color=BACKGROUND, mec=FAINT, markersize=5, zorder=2)


def _draw_ellipses(
    axes: Axes, graph: wire.SceneGraphMessage, view: TopView, colours: dict[str, str]
) -> None:
    for order, row in enumerate(np.argsort(view.heights)):
        node = graph.nodes[row]
        variances, directions = np.linalg.eigh(view.covariances[row])
        width, height = 2 * SIGMAS * np.sqrt(np.maximum(variances[::-1], 1e-8))
        angle = float(np.degrees(np.arctan2(directions[1, 1], directions[0, 1])))
        sure = 1.0 if node.observations >= SURE_FROM else 0.45
        shape: dict[str, Any] = {"xy": view.means[row], "width": width, "height": height}
        fill, rim = colours[node.label], shade(colours[node.label], 0.8)
        zorder = 3 + order / (len(graph.nodes) + 1)
        axes.add_patch(
            Ellipse(**shape, angle=angle, fc=fill, alpha=0.13 * sure, lw=0, zorder=zorder)
        )
        axes.add_patch(
            Ellipse(
                **shape, angle=angle, fill=False, ec=rim, alpha=0.9 * sure, lw=1.3, zorder=zorder
            )
        )
        axes.plot(*view.means[row], "o", color=rim, markersize=3.4, alpha=sure, zorder=zorder)


def _strength(edge: wire.EdgeState) -> tuple[float, int]:
    return (round(edge.probability, 2), edge.observations)


def _chosen_edges(graph: wire.SceneGraphMessage) -> list[wire.EdgeState]:
    """The surest edges, weakest first, so that the surest are drawn on top."""
    edges = sorted(drawable_edges(graph), key=_strength, reverse=True)
    return edges[: int(EDGES_A_NODE * len(graph.nodes))][::-1]


def _draw_arrows(
    axes: Axes,
    graph: wire.SceneGraphMessage,
    view: TopView,
    edges: list[wire.EdgeState],
    tints: dict[str, str],
) -> None:
    row_of = {node.id: row for row, node in enumerate(graph.nodes)}
    for edge in edges:
        tail, tip = view.means[row_of[edge.subject]], view.means[row_of[edge.object]]
        axes.add_patch(
            FancyArrowPatch(
                tuple(tail),
                tuple(tip),
                arrowstyle="-|>,head_length=5,head_width=2.4",
                connectionstyle=f"arc3,rad={CURVATURE}",
                shrinkA=3,
                shrinkB=4,
                color=tints[edge.predicate],
                alpha=_alpha(edge),
                linewidth=1.15,
                zorder=5,
            )
        )


def _alpha(edge: wire.EdgeState) -> float:
    seen = min(edge.observations, 5) / 5 if edge.provenance == "visual" else 1.0
    return float(0.12 + 0.78 * min(edge.probability, 1.0) ** 2 * (0.35 + 0.65 * seen))


def _text_size(axes: Axes, text: str, **style: Any) -> Float64:
    """Width and height of a text in pixels, with some air."""
    probe = axes.text(0, 0, text, **style)
    extent = probe.get_window_extent(axes.figure.canvas.get_renderer())  # type: ignore[attr-defined]
    probe.remove()
    return np.array([extent.width + 3, extent.height + 1])


def _pair(values: Float64) -> tuple[float, float]:
    x, y = values.tolist()
    return (x, y)


def _frame_px(axes: Axes) -> Float64:
    extent = axes.get_window_extent()
    return np.array([extent.x0 + 4, extent.y0 + 4, extent.x1 - 4, extent.y1 - 4])


def _label_style(node: wire.NodeState, label_count: int) -> dict[str, Any]:
    """Objects that were hardly seen do not shout."""
    if node.observations < SURE_FROM:
        return {"fontsize": 7.0, "alpha": 0.75}
    return {"fontsize": 9.0 if label_count <= 40 else 8.0, "fontweight": "bold"}


def _draw_labels(
    axes: Axes, graph: wire.SceneGraphMessage, view: TopView, colours: dict[str, str]
) -> Placement:
    rows = sorted(range(len(graph.nodes)), key=lambda row: -graph.nodes[row].observations)
    rows = rows[:MOST_LABELS]
    if not rows:
        return Placement(np.zeros((0, 2)), np.zeros((0, 2)))
    styles = [_label_style(graph.nodes[row], len(rows)) for row in rows]
    texts = [f"{graph.nodes[row].label} {graph.nodes[row].id}" for row in rows]
    sizes = np.array([_text_size(axes, text, **style) for text, style in zip(texts, styles)])
    anchors = axes.transData.transform(view.means[rows])
    placed = place(anchors, sizes, _frame_px(axes))
    to_data = axes.transData.inverted()
    for row, text, style, anchor, centre, box in zip(
        rows, texts, styles, anchors, placed.centres, placed.boxes
    ):
        colour = shade(colours[graph.nodes[row].label], 0.62)
        near = nearest_on_box(anchor, box)
        if np.linalg.norm(near - anchor) > 14:
            line = to_data.transform([near, anchor])
            axes.plot(*line.T, color=colour, linewidth=0.6, alpha=0.55, zorder=6)
        axes.text(
            *_pair(to_data.transform(centre)),
            text,
            color=colour,
            ha="center",
            va="center",
            zorder=8,
            path_effects=HALO,
            **style,
        )
    return placed


def _along(tail: Float64, tip: Float64, fraction: float) -> Float64:
    """Point of the curve that an arc3 arrow follows (a quadratic Bézier), pixels."""
    chord = tip - tail
    control = (tail + tip) / 2 + CURVATURE * np.array([chord[1], -chord[0]])
    rest = 1 - fraction
    return np.asarray(
        rest**2 * tail + 2 * rest * fraction * control + fraction**2 * tip, np.float64
    )


def _draw_predicates(
    axes: Axes,
    graph: wire.SceneGraphMessage,
    view: TopView,
    edges: list[wire.EdgeState],
    tints: dict[str, str],
    placed: Placement,
) -> None:
    row_of = {node.id: row for row, node in enumerate(graph.nodes)}
    pixels = axes.transData.transform(view.means) if len(view.means) else np.zeros((0, 2))
    taken = np.vstack([placed.boxes, np.hstack([pixels - 4, pixels + 4])])
    frame, to_data = _frame_px(axes), axes.transData.inverted()
    style: dict[str, Any] = {"fontsize": 7.0, "fontstyle": "italic"}
    sizes = {name: _text_size(axes, name, **style) for name in tints}
    for edge in reversed(edges):
        tail, tip = pixels[row_of[edge.subject]], pixels[row_of[edge.object]]
        fractions = (0.5, 0.42, 0.58, 0.34, 0.66)
        candidates = np.array([_along(tail, tip, fraction) for fraction in fractions])
        size = sizes[edge.predicate]
        if np.linalg.norm(tip - tail) < size[0] + 8:
            continue
        chosen = place_if_free(candidates, size, taken, frame)
        if chosen is None:
            continue
        centre = candidates[chosen]
        taken = np.vstack([taken, np.hstack([centre - size / 2, centre + size / 2])])
        axes.text(
            *_pair(to_data.transform(centre)),
            edge.predicate,
            color=shade(tints[edge.predicate], 0.8),
            alpha=max(_alpha(edge), 0.55),
            ha="center",
            va="center",
            zorder=7,
            path_effects=HALO,
            **style,
        )


def _draw_frame(
    figure: Figure,
    axes: Axes,
    graph: wire.SceneGraphMessage,
    view: TopView,
    axes_of_view: Float64,
    tints: dict[str, str],
) -> None:
    """Title, scale bar, the world's axes and the predicates' colours."""
    pad = 0.25 / figure.get_figwidth()
    top, bottom = 1 - 0.27 / figure.get_figheight(), 0.27 / figure.get_figheight()
    title = f"{len(graph.nodes)} objects, {len(graph.edges)} relations"
    figure.text(pad, top, title, fontsize=12, fontweight="bold", color=INK, va="center")
    note = f"seen from above, frame {graph.frame_id!r}; ellipses: {SIGMAS:g}σ"
    if len(view.path):
        note += "; dotted: the camera's way from ● to ○"
    figure.text(1 - pad, top, note, fontsize=8.5, color=FAINT, va="center", ha="right")

    metre_px = float(axes.transData.transform((1, 0))[0] - axes.transData.transform((0, 0))[0])
    length_m = max((m for m in (0.1, 0.25, 0.5, 1, 2, 5, 10, 50) if m * metre_px < 280), default=50)
    width = length_m * metre_px / figure.bbox.width
    figure.add_artist(Line2D([pad, pad + width], [bottom, bottom], color=INK, linewidth=2.2))
    figure.text(
        pad + width + pad / 3, bottom, f"{length_m:g} m", fontsize=9, color=INK, va="center"
    )
    names = " ".join(
        f"{name} {_axis_name(axis)}" for name, axis in zip(("→", "↑"), axes_of_view[:2])
    )
    figure.text(pad + width + pad * 3, bottom, names, fontsize=9, color=FAINT, va="center")
    handles = [
        Line2D([], [], color=tint, linewidth=2.0, label=predicate)
        for predicate, tint in tints.items()
    ]
    if handles:
        figure.legend(
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
    """`x`, `-y`, … where the direction is an axis of the world; its coordinates otherwise."""
    largest = int(np.abs(axis).argmax())
    if abs(axis[largest]) > 0.999:
        return ("" if axis[largest] > 0 else "-") + "xyz"[largest]
    return "(" + ", ".join(f"{value:.2f}" for value in axis) + ")"
