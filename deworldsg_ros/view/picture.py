"""The graph as one picture: boxes seen from above, relations as arrows, photos of the objects.

A crowded room stays readable by six rules: "near" is left out; of two mutual relations one is
drawn; weak edges are faint; at most EDGES_PER_NODE edges per node are drawn, the strongest; a
predicate is written only into free space; above MOST_LABELS objects, the most observed have labels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.patches import FancyArrowPatch, Polygon

from deworldsg_ros.files import write_atomically
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64, UInt8
from deworldsg_ros.view.colours import shade
from deworldsg_ros.view.picture_text import (
    CAPTION_IN,
    CURVATURE,
    PHOTO_IN,
    draw_frame,
    draw_labels,
    draw_photos,
    draw_predicates,
    edge_alpha,
    is_sure,
)
from deworldsg_ros.view.top_view import BACKGROUND, DPI, FAINT, Drawing, drawing_of

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
        photos: (s, s, 3) uint8 RGB by id of the node (`photos.photos_of`), for the strip below.

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
        alpha = 1.0 if is_sure(nodes[row]) else 0.45
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
