"""The graph as one HTML page with a 3D view; the file contains everything and works offline."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs

from deworldsg_ros.files import write_atomically
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.view.colours import class_colours
from deworldsg_ros.view.geometry import (
    SIGMAS,
    covariances_of,
    means_of,
    principal_axes,
    view_axes,
)
from deworldsg_ros.view.page_figure import bounds, figure_of, layout

TEMPLATE = Path(__file__).with_name("assets") / "page.html"


def write(
    graph: wire.SceneGraphMessage,
    path: str | Path,
    *,
    up_world: Sequence[float] | Float64 = (0.0, 0.0, 1.0),
    camera_path_world: Float64 | None = None,
) -> None:
    """Write the page.

    Args:
        graph: the graph, with or without surface points.
        path: HTML file to write.
        up_world: (3,) direction that points up in the world frame.
        camera_path_world: (n, 3) positions of the camera, metres; None = not drawn.

    Raises:
        ValueError: for an up direction of zero length.
        OSError: if the page cannot be written.
    """
    axes_of_view = view_axes(up_world)
    figure = figure_of(graph, axes_of_view, camera_path_world)
    low, high = bounds(figure)
    figure.update_layout(layout(low, high))
    html = TEMPLATE.read_text(encoding="utf-8")
    parts = {
        "__TITLE__": f"Scene graph: {len(graph.nodes)} objects, {len(graph.edges)} relations",
        "__FIGURE__": _script_safe(figure.to_json()),
        "__GRAPH__": _script_safe(json.dumps(_details(graph, axes_of_view, low, high))),
        "__PLOTLY__": get_plotlyjs(),
    }
    # In one pass: a label may contain one of these names.
    html = re.sub("|".join(parts), lambda match: parts[match[0]], html)
    write_atomically(Path(path), html)


def _script_safe(text: str) -> str:
    """JSON that cannot end the script element around it."""
    return text.replace("<", "\\u003c")


def _details(
    graph: wire.SceneGraphMessage, axes_of_view: Float64, low: Float64, high: Float64
) -> dict[str, Any]:
    """The list beside the 3D view: objects with their camera targets, and edges."""
    colours = class_colours(node.label for node in graph.nodes)
    middle, largest = (low + high) / 2, float((high - low).max())
    shown = means_of(graph) @ axes_of_view.T
    return {
        "frame_id": graph.frame_id,
        "nodes": [
            {
                "id": node.id,
                "label": node.label,
                "colour": colours[node.label],
                "classes": [[item.label, round(item.probability, 3)] for item in node.classes],
                "position": [round(value, 3) for value in node.mean_m],
                "size": np.round(2 * SIGMAS * principal_axes(covariance)[0], 3).tolist(),
                "observations": node.observations,
                "shown": np.round(point, 4).tolist(),
                "centre": np.round((point - middle) / largest, 4).tolist(),
            }
            for node, point, covariance in zip(graph.nodes, shown, covariances_of(graph))
        ],
        "edges": [
            {
                "subject": edge.subject,
                "object": edge.object,
                "predicate": edge.predicate,
                "probability": round(edge.probability, 3),
                "provenance": edge.provenance,
            }
            for edge in sorted(graph.edges, key=lambda edge: -edge.probability)
        ],
    }
