"""The graph as one HTML page with a 3D view: what the page shows of it, as plain values.

A kept page is one file that contains everything and works offline (`write`). The live viewer sends
the same values as messages (`live.server`).
"""

from __future__ import annotations

import base64
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deworldsg_ros.base.files import write_atomically
from deworldsg_ros.client.explain import explain_relation
from deworldsg_ros.client.objects import SURE, Rooms, SceneObject, relation_of, scene_object
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.graph.surface import Surface, surface_of
from deworldsg_ros.scene.arrays import Float32, Float64, Int8, UInt8
from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.scene.vocabulary import verb_of
from deworldsg_ros.view.colours import (
    MUTUAL,
    SIGMAS,
    class_colours,
    drawable_edges,
    predicate_colours,
    principal_axes,
    view_axes,
)
from deworldsg_ros.wire import messages as wire

ASSETS = Path(__file__).with_name("assets")
# More add megabytes, not detail.
MOST_POINTS = 20_000
MOST_PATH_POINTS = 1_000
# Of the room's surface, in a kept page: 16 bytes each.
MOST_SURFACE_POINTS = 50_000
# Of surface points, metres: int16 reaches 65 m from the first one.
SURFACE_STEP_M = 0.002
# Relations whose reasons a kept page has, the most probable ones.
MOST_REASONS = 400
# A second class is worth a word from this share of the first one's probability on, and as likely
# as the first from the other.
PERHAPS, AS_LIKELY = 0.1, 0.5


def write(
    graph: wire.SceneGraphMessage,
    path: str | Path,
    *,
    up_world: Sequence[float] | Float64 = (0.0, 0.0, 1.0),
    camera_path_world: Float64 | None = None,
    space: SeenSpace | None = None,
) -> None:
    """Write the page.

    Args:
        graph: the graph, with or without surface points.
        path: HTML file to write.
        up_world: (3,) direction that points up in the world frame.
        camera_path_world: (n, 3) positions of the camera, metres; None = not drawn.
        space: what the camera saw of the room, for its surface; None = not drawn.

    Raises:
        ValueError: for an up direction of zero length.
        OSError: if the page cannot be written.
    """
    axes_of_view = view_axes(up_world)
    content = content_of(graph, axes_of_view, camera_path_world)
    surface = surface_of(space, MOST_SURFACE_POINTS)
    if len(surface):
        content["surface"] = surface_values(surface, surface.kept(), axes_of_view)
    write_atomically(Path(path), html_of(f"Scene graph of {len(graph.nodes)} objects", content))


def html_of(title: str, content: dict[str, Any] | None) -> str:
    """The page.

    Args:
        title: of the window.
        content: its first message (`content_of`); None = the page asks the server that it is from.
    """
    parts = {
        "__TITLE__": title,
        # It cannot end its element.
        "__GRAPH__": json.dumps(content, separators=(",", ":")).replace("<", "\\u003c"),
        "__THREE__": (ASSETS / "three.min.js").read_text(encoding="utf-8"),
        "__PAGE__": (ASSETS / "page.js").read_text(encoding="utf-8"),
    }
    html = (ASSETS / "page.html").read_text(encoding="utf-8")
    # In one pass: a label may contain one of these names.
    return re.sub("|".join(parts), lambda match: parts[match[0]], html)


def content_of(
    graph: wire.SceneGraphMessage, axes_of_view: Float64, camera_path_world: Float64 | None
) -> dict[str, Any]:
    """Everything that a kept page shows, as the message that a live one would get.

    Args:
        graph: the graph, with or without surface points.
        axes_of_view: (3, 3), rows right, forward and up in the world frame. Positions in the page
            are in these axes, but for those that it prints.
        camera_path_world: (n, 3) positions of the camera, metres; None = not drawn.
    """
    up = axes_of_view[2].tolist()
    items = {
        node.id: scene_object(node, graph.frame_id, (up[0], up[1], up[2])) for node in graph.nodes
    }
    edges = sorted(drawable_edges(graph), key=lambda edge: -edge.probability)
    hidden = graph.hidden if isinstance(graph.hidden, list) else []
    rooms = graph.rooms if isinstance(graph.rooms, list) else []
    path = np.zeros((0, 3)) if camera_path_world is None else np.asarray(camera_path_world)
    path = path[:: max(1, -(-len(path) // MOST_PATH_POINTS))].reshape(-1, 3)
    clouds = {node.id: surface_points(node) for node in graph.nodes}
    stride = max(1, -(-sum(map(len, clouds.values())) // MOST_POINTS))
    return {
        "head": {
            **colours_of(items.values(), edges),
            "frame_id": graph.frame_id,
            "hidden": Counter(node.reason for node in hidden),
            "rooms": room_values(rooms, axes_of_view),
        },
        "nodes": [values_of(item, axes_of_view) for item in items.values()],
        "edges": [
            {**edge_values(edge), **({"why": why(edge, items)} if rank < MOST_REASONS else {})}
            for rank, edge in enumerate(edges)
        ],
        "clouds": [
            cloud_values(item, clouds[item.id][::stride], axes_of_view) for item in items.values()
        ],
        "path": path_values(path, axes_of_view),
    }


def colours_of(
    items: Iterable[SceneObject], edges: Iterable[wire.EdgeState]
) -> dict[str, dict[str, str]]:
    """#rrggbb of each class and of each predicate, the frequent ones first, and their verbs."""
    counts = Counter(edge.predicate for edge in edges)
    return {
        "colours": class_colours(item.label for item in sorted(items, key=lambda item: item.id)),
        "tints": predicate_colours(counts),
        "verbs": {predicate: verb_of(predicate) for predicate in counts},
    }


def values_of(item: SceneObject, axes_of_view: Float64) -> dict[str, Any]:
    """What the page shows of an object."""
    quaternion = np.array(item.orientation_xyzw)  # of length one, but for its last digits
    quaternion /= np.linalg.norm(quaternion)
    rotation = pose_from_quaternion(np.zeros(3), quaternion)[:3, :3]
    deviations, axes = principal_axes(np.array(item.covariance_m2))
    words = in_words(item)
    return {
        "id": item.id,
        "label": item.label,
        "named": item.is_named,
        "probability": round(item.probability, 3),
        "sure": item.is_sure,
        "words": words if words != item.label else None,
        "looks": item.colour,
        "classes": [[belief.label, round(belief.probability, 3)] for belief in item.classes],
        "other": round(item.other_classes, 3),
        "existence": None if item.existence is None else round(item.existence, 3),
        "observations": item.observations,
        "position": _rounded(item.position_m, 3),
        "size": _rounded(item.size_m, 3),
        "sizeWords": item.size_words,
        "centre": _rounded(axes_of_view @ item.position_m, 4),
        # Columns of the rotation, one after the other.
        "axes": _rounded((axes_of_view @ rotation).T.ravel(), 4),
        # The Gaussian: its mean, and its half axes at 2σ, one after the other.
        "mean": _rounded(axes_of_view @ item.mean_m, 3),
        "deviations": _rounded((axes_of_view @ (axes * SIGMAS * deviations)).T.ravel(), 3),
    }


def edge_values(edge: wire.EdgeState) -> dict[str, Any]:
    """What the page shows of a relation."""
    return {
        "subject": edge.subject,
        "object": edge.object,
        "predicate": edge.predicate,
        "mutual": edge.mutual is True or edge.predicate in MUTUAL,
        "probability": round(edge.probability, 3),
        "provenance": edge.provenance,
    }


def why(edge: wire.EdgeState, items: Mapping[int, SceneObject]) -> list[str]:
    """Where the belief in a relation comes from, in sentences."""
    relation = relation_of(edge, items[edge.subject], items[edge.object], None)
    return list(explain_relation(relation).lines)


def cloud_values(
    item: SceneObject, points: Float32 | Float64, axes_of_view: Float64
) -> dict[str, Any]:
    """Surface points (n, 3) of an object: int16 millimetres from its centre, base64."""
    steps = np.clip((points - np.array(item.position_m)) @ axes_of_view.T * 1000, -32767, 32767)
    return {
        "id": item.id,
        "from": _rounded(axes_of_view @ item.position_m, 4),
        "mm": base64.b64encode(np.round(steps).astype("<i2").tobytes()).decode(),
    }


def surface_values(
    surface: Surface, points: tuple[Float32, UInt8, Int8], axes_of_view: Float64
) -> dict[str, Any]:
    """Some points of the room's surface, with their colours and sides; base64.

    Positions are steps from the first point of the surface.
    """
    positions, colours, sides = points
    origin = surface.points[0]
    steps = np.clip((positions - origin) @ axes_of_view.T / SURFACE_STEP_M, -32767, 32767)
    turned = np.clip(sides @ axes_of_view.T, -127, 127)
    return {
        "origin": _rounded(axes_of_view @ origin, 4),
        "step": SURFACE_STEP_M,
        "cell": round(surface.cell_m, 4),
        "steps": base64.b64encode(np.round(steps).astype("<i2").tobytes()).decode(),
        "rgb": base64.b64encode(colours.tobytes()).decode(),
        "sides": base64.b64encode(np.round(turned).astype(np.int8).tobytes()).decode(),
    }


def room_values(states: Iterable[wire.RoomState], axes_of_view: Float64) -> list[dict[str, Any]]:
    """The outlines of rooms, their names, and the objects in them."""
    return [
        {
            "id": room.id,
            "name": room.name,
            "sure": room.probability >= SURE,
            "outline": path_values(np.array(room.outline_m).reshape(-1, 3), axes_of_view),
            "objects": [[node_id, share] for node_id, share in room.objects.items()],
        }
        for room in Rooms.of_message(states)
    ]


def path_values(positions_world: Float64, axes_of_view: Float64) -> list[list[float]]:
    """Positions (n, 3) of the camera."""
    values: list[list[float]] = np.round(positions_world @ axes_of_view.T, 3).tolist()
    return values


def in_words(item: SceneObject) -> str:
    """The class of an object as one would say it: "cup, or perhaps a bowl"."""
    if not item.classes:
        return item.label
    first = item.classes[0]
    if not item.is_named:
        return f"something, perhaps {_article(first.label)} {first.label}"
    others = [c for c in item.classes[1:] if c.probability >= PERHAPS * first.probability]
    likely = [c.label for c in others if c.probability >= AS_LIKELY * first.probability]
    if likely:
        rest = ", or something else" if item.other_classes > first.probability else ""
        return " or ".join([first.label, *likely[:2]]) + rest
    if others:
        return f"{first.label}, or perhaps {_article(others[0].label)} {others[0].label}"
    if item.other_classes > PERHAPS * first.probability:
        return f"{first.label}, or perhaps something else"
    return first.label


def _article(noun: str) -> str:
    return "an" if noun[:1].lower() in "aeiou" else "a"


def _rounded(values: Any, digits: int) -> list[float]:
    return [round(value, digits) for value in np.asarray(values, np.float64).tolist()]
