"""The graph as one HTML page with a 3D view; the file contains everything and works offline."""

from __future__ import annotations

import base64
import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deworldsg_ros.base.files import write_atomically
from deworldsg_ros.client.objects import SceneObject, scene_object
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.scene.vocabulary import verb_of
from deworldsg_ros.view.colours import class_colours, drawable_edges, predicate_colours, view_axes
from deworldsg_ros.wire import messages as wire

ASSETS = Path(__file__).with_name("assets")
# More add megabytes, not detail.
MOST_POINTS = 20_000
MOST_PATH_POINTS = 1_000


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
    content = content_of(graph, view_axes(up_world), camera_path_world)
    parts = {
        "__TITLE__": f"Scene graph of {len(graph.nodes)} objects",
        "__GRAPH__": _script_safe(json.dumps(content)),
        "__THREE__": (ASSETS / "three.min.js").read_text(encoding="utf-8"),
        "__PAGE__": (ASSETS / "page.js").read_text(encoding="utf-8"),
    }
    html = (ASSETS / "page.html").read_text(encoding="utf-8")
    # In one pass: a label may contain one of these names.
    html = re.sub("|".join(parts), lambda match: parts[match[0]], html)
    write_atomically(Path(path), html)


def _script_safe(text: str) -> str:
    """JSON that cannot end the script element around it."""
    return text.replace("<", "\\u003c")


def content_of(
    graph: wire.SceneGraphMessage, axes_of_view: Float64, camera_path_world: Float64 | None
) -> dict[str, Any]:
    """Everything that the page shows, as plain values.

    Args:
        graph: the graph, with or without surface points.
        axes_of_view: (3, 3), rows right, forward and up in the world frame. Positions in the page
            are in these axes, but for those that it prints.
        camera_path_world: (n, 3) positions of the camera, metres; None = not drawn.
    """
    colours = class_colours(node.label for node in graph.nodes)
    up = axes_of_view[2].tolist()
    items = [scene_object(node, graph.frame_id, (up[0], up[1], up[2])) for node in graph.nodes]
    edges = sorted(drawable_edges(graph), key=lambda edge: -edge.probability)
    hidden = graph.hidden if isinstance(graph.hidden, list) else []
    path = np.zeros((0, 3)) if camera_path_world is None else np.asarray(camera_path_world)
    path = path[:: max(1, -(-len(path) // MOST_PATH_POINTS))].reshape(-1, 3)
    return {
        "frame_id": graph.frame_id,
        "nodes": [_node(item, colours[item.label], axes_of_view) for item in items],
        "edges": [_edge(edge) for edge in edges],
        "tints": predicate_colours(Counter(edge.predicate for edge in edges)),
        "hidden": Counter(node.reason for node in hidden),
        "points": _points(graph, axes_of_view),
        "path": np.round(path @ axes_of_view.T, 3).tolist(),
    }


def _node(item: SceneObject, colour: str, axes_of_view: Float64) -> dict[str, Any]:
    rotation = pose_from_quaternion(np.zeros(3), np.array(item.orientation_xyzw))[:3, :3]
    return {
        "id": item.id,
        "label": item.label,
        "named": item.is_named,
        "probability": round(item.probability, 3),
        "sure": item.is_sure,
        "colour": colour,
        "looks": item.colour,
        "classes": [[belief.label, round(belief.probability, 3)] for belief in item.classes],
        "other": round(item.other_classes, 3),
        "existence": None if item.existence is None else round(item.existence, 3),
        "observations": item.observations,
        "position": np.round(item.position_m, 3).tolist(),
        "size": np.round(item.size_m, 3).tolist(),
        "sizeWords": item.size_words,
        "centre": np.round(axes_of_view @ item.position_m, 4).tolist(),
        # Columns of the rotation, one after the other.
        "axes": np.round((axes_of_view @ rotation).T, 4).ravel().tolist(),
    }


def _edge(edge: wire.EdgeState) -> dict[str, Any]:
    return {
        "subject": edge.subject,
        "object": edge.object,
        "predicate": edge.predicate,
        "verb": verb_of(edge.predicate),
        "probability": round(edge.probability, 3),
        "provenance": edge.provenance,
        "observations": edge.observations,
    }


def _points(graph: wire.SceneGraphMessage, axes_of_view: Float64) -> dict[str, Any]:
    """The surface points: int16 steps from a corner, base64, and how many each node has."""
    clouds = [surface_points(node) for node in graph.nodes]
    stride = max(1, -(-sum(map(len, clouds)) // MOST_POINTS))
    clouds = [cloud[::stride] @ axes_of_view.T for cloud in clouds]
    points = np.concatenate([*clouds, np.zeros((0, 3))])
    low = points.min(axis=0) if len(points) else np.zeros(3)
    step = max(float((points - low).max(initial=0.0)) / np.iinfo(np.uint16).max, 1e-6)
    steps = np.round((points - low) / step).astype("<u2")
    return {
        "low": low.tolist(),
        "step": step,
        "counts": [len(cloud) for cloud in clouds],
        "xyz": base64.b64encode(steps.tobytes()).decode(),
    }
