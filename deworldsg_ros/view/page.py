"""The graph as one page with the 3D view, which works offline: everything is in the file."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.view.colours import class_colours, predicate_colours
from deworldsg_ros.view.geometry import (
    SIGMAS,
    covariances_of,
    drawable_edges,
    means_of,
    principal_axes,
    view_axes,
)
from deworldsg_ros.view.solids import arrow_head, ellipsoid, joined

TEMPLATE = Path(__file__).with_name("assets") / "page.html"
POINTS_SHOWN = 20_000
FINE_UP_TO = 100
STRONG = 0.5
HEAD_M = 0.055
MARGIN_M = 0.3


def write(
    graph: wire.SceneGraphMessage,
    path: str | Path,
    *,
    up_world: Sequence[float] | Float64 = (0.0, 0.0, 1.0),
    camera_path_world: Float64 | None = None,
) -> None:
    """Write the page.

    Args:
        graph: with surface points, or without.
        path: of the HTML file.
        up_world: (3,) direction that points up in the world frame.
        camera_path_world: (n, 3) positions of the camera, metres, to be shown too.
    """
    axes_of_view = view_axes(up_world)
    figure = go.Figure(
        [
            *_class_traces(graph, axes_of_view),
            *_relation_traces(graph, axes_of_view),
            *_path_traces(camera_path_world, axes_of_view),
        ]
    )
    low, high = _bounds(figure)
    figure.update_layout(_layout(low, high))
    html = TEMPLATE.read_text(encoding="utf-8")
    for name, text in {
        "__TITLE__": f"Scene graph: {len(graph.nodes)} objects, {len(graph.edges)} relations",
        "__FIGURE__": _script_safe(figure.to_json()),
        "__GRAPH__": _script_safe(json.dumps(_details(graph, axes_of_view, low, high))),
        "__PLOTLY__": get_plotlyjs(),
    }.items():
        html = html.replace(name, text, 1)
    Path(path).write_text(html, encoding="utf-8")


def _script_safe(text: str) -> str:
    """JSON that cannot end the script element that it stands in."""
    return text.replace("<", "\\u003c")


def _class_traces(graph: wire.SceneGraphMessage, axes_of_view: Float64) -> list[Any]:
    """Of each class: ellipsoids, surface points and labels; the trace's name is the class."""
    means = means_of(graph) @ axes_of_view.T
    covariances = axes_of_view @ covariances_of(graph) @ axes_of_view.T
    colours = class_colours(node.label for node in graph.nodes)
    subdivisions = 2 if len(graph.nodes) <= FINE_UP_TO else 1
    total_points = sum(len(node.surface_points_m) for node in graph.nodes)
    stride = max(1, -(-total_points // POINTS_SHOWN))
    traces: list[Any] = []
    for label in sorted(colours):
        rows = [row for row, node in enumerate(graph.nodes) if node.label == label]
        group = {"name": label, "hoverinfo": "skip"}
        solids = [ellipsoid(means[row], covariances[row], subdivisions) for row in rows]
        owners = [
            np.full(len(vertices), graph.nodes[row].id, np.int32)
            for row, (vertices, _) in zip(rows, solids)
        ]
        traces.append(
            _mesh(
                joined(solids),
                **(group | {"hoverinfo": "none"}),
                color=colours[label],
                opacity=0.32,
                customdata=np.concatenate(owners),
                meta="objects",
            )
        )
        points = np.concatenate(
            [
                np.array(graph.nodes[row].surface_points_m[::stride], np.float64).reshape(-1, 3)
                for row in rows
            ]
        )
        marker = {"size": 1.3, "color": colours[label], "opacity": 0.5}
        traces.append(
            _scatter(points @ axes_of_view.T, mode="markers", marker=marker, meta="points", **group)
        )
        tops = means[rows] + np.outer(SIGMAS * np.sqrt(covariances[rows, 2, 2]), [0.0, 0.0, 1.0])
        traces.append(
            _scatter(
                tops,
                mode="text",
                text=[f"{escape(label)} {graph.nodes[row].id}" for row in rows],
                textposition="top center",
                textfont={"size": _text_sizes(covariances[rows]), "color": "#2d3142"},
                meta="labels",
                **group,
            )
        )
    return traces


def _text_sizes(covariances: Float64) -> list[int]:
    """Small objects have small labels: they are the ones that stand close together."""
    return [12 if np.sqrt(np.trace(covariance)) > 0.2 else 9 for covariance in covariances]


def _relation_traces(graph: wire.SceneGraphMessage, axes_of_view: Float64) -> list[Any]:
    """Of each predicate: lines, the weak ones fainter, heads, and a point to hover over."""
    edges = drawable_edges(graph)
    means = dict(zip((node.id for node in graph.nodes), means_of(graph) @ axes_of_view.T))
    names = {node.id: f"{escape(node.label)} {node.id}" for node in graph.nodes}
    tints = predicate_colours(Counter(edge.predicate for edge in edges))
    traces: list[Any] = []
    for predicate, tint in tints.items():
        for strong in (True, False):
            chosen = [
                edge
                for edge in edges
                if edge.predicate == predicate and (edge.probability >= STRONG) == strong
            ]
            if not chosen:
                continue
            group = {"legendgroup": predicate, "meta": "relations"}
            ends = np.array([[means[edge.subject], means[edge.object]] for edge in chosen])
            shown = not any(trace.legendgroup == predicate for trace in traces)
            gaps = np.full((len(ends), 1, 3), np.nan)
            traces.append(
                _scatter(
                    np.concatenate([ends, gaps], axis=1).reshape(-1, 3),
                    mode="lines",
                    line={"color": tint, "width": 4 if strong else 2},
                    opacity=0.9 if strong else 0.3,
                    hoverinfo="skip",
                    name=escape(predicate),
                    showlegend=shown,
                    **group,
                )
            )
            heads = [_head(tail, tip) for tail, tip in ends]
            traces.append(
                _mesh(
                    joined(heads),
                    color=tint,
                    opacity=1.0 if strong else 0.3,
                    hoverinfo="skip",
                    **group,
                )
            )
            texts = [
                f"{names[edge.subject]} <b>{escape(predicate)}</b> {names[edge.object]}<br>"
                f"{100 * edge.probability:.0f} %, {edge.provenance}, seen {edge.observations}×"
                for edge in chosen
            ]
            traces.append(
                _scatter(
                    ends.mean(axis=1),
                    mode="markers",
                    marker={"size": 3.5, "color": tint, "opacity": 0.9 if strong else 0.3},
                    hovertext=texts,
                    hovertemplate="%{hovertext}<extra></extra>",
                    **group,
                )
            )
    return traces


def _head(tail: Float64, tip: Float64) -> tuple[Float64, Any]:
    """Arrow head near the tip; nothing where the ends are in one place."""
    length_m = float(np.linalg.norm(tip - tail))
    if length_m < 1e-6:
        return arrow_head(tip, np.array([0.0, 0.0, 1.0]), 1e-6)
    return arrow_head(tip - 0.12 * (tip - tail), tip - tail, min(HEAD_M, 0.4 * length_m))


def _path_traces(camera_path: Float64 | None, axes_of_view: Float64) -> list[Any]:
    if camera_path is None or not len(camera_path):
        return []
    return [
        _scatter(
            np.asarray(camera_path, np.float64).reshape(-1, 3) @ axes_of_view.T,
            mode="lines",
            line={"color": "#8d93a5", "width": 2, "dash": "dot"},
            hoverinfo="skip",
            name="camera",
            showlegend=True,
            meta="camera",
        )
    ]


def _scatter(points: Float64, **options: Any) -> Any:
    x, y, z = points.astype(np.float32).T
    return go.Scatter3d(x=x, y=y, z=z, **({"showlegend": False} | options))


def _mesh(solid: tuple[Float64, Any], **options: Any) -> Any:
    x, y, z = solid[0].astype(np.float32).T
    narrow = np.uint16 if len(solid[0]) <= np.iinfo(np.uint16).max else np.uint32
    i, j, k = solid[1].astype(narrow).T
    light = {"ambient": 0.75, "diffuse": 0.5, "specular": 0.1, "roughness": 0.9}
    shape = {"x": x, "y": y, "z": z, "i": i, "j": j, "k": k, "lighting": light}
    return go.Mesh3d(**shape, **({"showlegend": False} | options))


def _bounds(figure: Any) -> tuple[Float64, Float64]:
    """Corners of the box around everything that is shown."""
    corners = [
        np.stack([np.asarray(trace[axis], np.float64) for axis in "xyz"], axis=1)
        for trace in figure.data
    ]
    points = np.concatenate([*corners, np.zeros((0, 3))])
    if not len(points):
        points = np.zeros((1, 3))
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    return low - MARGIN_M, high + MARGIN_M


def _layout(low: Float64, high: Float64) -> dict[str, Any]:
    extent = high - low
    ratio = extent / extent.max()
    axis = {
        "title": {"text": ""},
        "showbackground": False,
        "showspikes": False,
        "gridcolor": "#e6e4de",
        "zeroline": False,
        "tickfont": {"size": 9, "color": "#a7abb8"},
    }
    ranges = {f"{name}axis": axis | {"range": [low[at], high[at]]} for at, name in enumerate("xyz")}
    ranges["zaxis"] |= {"showbackground": False, "showticklabels": False}
    return {
        "scene": {
            **ranges,
            "aspectmode": "manual",
            "aspectratio": dict(zip("xyz", ratio.tolist())),
            "camera": {"eye": {"x": -0.12, "y": -0.9, "z": 0.78}},
            "dragmode": "turntable",
        },
        "legend": {
            "font": {"size": 12},
            "bgcolor": "rgba(0,0,0,0)",
            "x": 0.01,
            "xanchor": "left",
            "y": 0.01,
            "yanchor": "bottom",
        },
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "paper_bgcolor": "#fbfaf7",
        "hoverlabel": {"bgcolor": "white", "font": {"color": "#2d3142"}},
    }


def _details(
    graph: wire.SceneGraphMessage, axes_of_view: Float64, low: Float64, high: Float64
) -> dict[str, Any]:
    """What the page's own list shows, and where to look for it."""
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
                "shown": np.round(place, 4).tolist(),
                "centre": np.round((place - middle) / largest, 4).tolist(),
            }
            for node, place, covariance in zip(graph.nodes, shown, covariances_of(graph))
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
