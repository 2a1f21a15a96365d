"""The 3D view of the page as a plotly figure: ellipsoids, surface points, labels, relations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64, Int64
from deworldsg_ros.scene.extent import surface_points
from deworldsg_ros.view.colours import class_colours, predicate_colours
from deworldsg_ros.view.geometry import SIGMAS, covariances_of, drawable_edges, means_of
from deworldsg_ros.view.solids import arrow_head, ellipsoid, joined

# With 162 vertices per ellipsoid (42 above FINE_UP_TO objects), a page stays below 6 MB.
POINTS_SHOWN = 20_000
FINE_UP_TO = 100
# Edges below this probability are faint.
STRONG = 0.5
HEAD_M = 0.055
MARGIN_M = 0.3


def figure_of(
    graph: wire.SceneGraphMessage, axes_of_view: Float64, camera_path_world: Float64 | None
) -> Any:
    """The plotly figure of a graph.

    Args:
        graph: the graph, with or without surface points.
        axes_of_view: (3, 3) rows right, forward and up in the world frame.
        camera_path_world: (n, 3) positions of the camera, metres; None = not drawn.
    """
    return go.Figure(
        [
            *_class_traces(graph, axes_of_view),
            *_relation_traces(graph, axes_of_view),
            *_path_traces(camera_path_world, axes_of_view),
        ]
    )


def bounds(figure: Any) -> tuple[Float64, Float64]:
    """Corners (3,) of the box around everything in a figure, with a margin, metres."""
    corners = [
        np.stack([np.asarray(trace[axis], np.float64) for axis in "xyz"], axis=1)
        for trace in figure.data
    ]
    points = np.concatenate([*corners, np.zeros((0, 3))])
    if not len(points):
        points = np.zeros((1, 3))
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    return low - MARGIN_M, high + MARGIN_M


def layout(low: Float64, high: Float64) -> dict[str, Any]:
    """Axes, camera and legend of the figure; `low` and `high` are its bounds."""
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


def _class_traces(graph: wire.SceneGraphMessage, axes_of_view: Float64) -> list[Any]:
    """Ellipsoids, surface points and labels of each class; the name of a trace is the class."""
    means = means_of(graph) @ axes_of_view.T
    covariances = axes_of_view @ covariances_of(graph) @ axes_of_view.T
    colours = class_colours(node.label for node in graph.nodes)
    subdivisions = 2 if len(graph.nodes) <= FINE_UP_TO else 1
    surfaces = {node.id: surface_points(node) for node in graph.nodes}
    total_points = sum(map(len, surfaces.values()))
    stride = max(1, -(-total_points // POINTS_SHOWN))
    traces: list[Any] = []
    for label, colour in sorted(colours.items()):
        rows = [row for row, node in enumerate(graph.nodes) if node.label == label]
        nodes = [graph.nodes[row] for row in rows]
        group = {"name": label, "hoverinfo": "skip"}
        solids = [ellipsoid(means[row], covariances[row], subdivisions) for row in rows]
        traces.append(_ellipsoid_trace(nodes, solids, label, colour))
        points = [surfaces[node.id][::stride] for node in nodes]
        marker = {"size": 1.3, "color": colour, "opacity": 0.5}
        traces.append(
            _scatter(
                np.concatenate(points) @ axes_of_view.T,
                mode="markers",
                marker=marker,
                meta="points",
                **group,
            )
        )
        tops = means[rows] + np.outer(SIGMAS * np.sqrt(covariances[rows, 2, 2]), [0.0, 0.0, 1.0])
        traces.append(
            _scatter(
                tops,
                mode="text",
                text=[f"{escape(label)} {node.id}" for node in nodes],
                textposition="top center",
                textfont={"size": _text_sizes(covariances[rows]), "color": "#2d3142"},
                meta="labels",
                **group,
            )
        )
    return traces


def _ellipsoid_trace(
    nodes: Sequence[wire.NodeState], solids: list[tuple[Float64, Int64]], label: str, colour: str
) -> Any:
    """One mesh of the ellipsoids of a class; each vertex carries the id of its node."""
    owners = [
        np.full(len(vertices), node.id, np.int32) for node, (vertices, _) in zip(nodes, solids)
    ]
    return _mesh(
        joined(solids),
        name=label,
        hoverinfo="none",
        color=colour,
        opacity=0.32,
        customdata=np.concatenate(owners),
        meta="objects",
    )


def _text_sizes(covariances: Float64) -> list[int]:
    """Small objects have small labels, because they stand close together."""
    return [12 if np.sqrt(np.trace(covariance)) > 0.2 else 9 for covariance in covariances]


def _relation_traces(graph: wire.SceneGraphMessage, axes_of_view: Float64) -> list[Any]:
    """Lines, heads and hover texts of each predicate, strong and weak edges apart."""
    edges = drawable_edges(graph)
    means = dict(zip((node.id for node in graph.nodes), means_of(graph) @ axes_of_view.T))
    names = {node.id: f"{escape(node.label)} {node.id}" for node in graph.nodes}
    tints = predicate_colours(Counter(edge.predicate for edge in edges))
    traces: list[Any] = []
    for predicate, tint in tints.items():
        in_legend = True
        for strong in (True, False):
            chosen = [
                edge
                for edge in edges
                if edge.predicate == predicate and (edge.probability >= STRONG) == strong
            ]
            if chosen:
                ends = np.array([[means[edge.subject], means[edge.object]] for edge in chosen])
                texts = [_hover_text(edge, names) for edge in chosen]
                group = {"legendgroup": predicate, "meta": "relations"}
                traces.append(_line_trace(ends, tint, strong, escape(predicate), in_legend, group))
                traces += _arrow_traces(ends, texts, tint, strong, group)
                in_legend = False
    return traces


def _hover_text(edge: wire.EdgeState, names: dict[int, str]) -> str:
    return (
        f"{names[edge.subject]} <b>{escape(edge.predicate)}</b> {names[edge.object]}<br>"
        f"{100 * edge.probability:.0f} %, {edge.provenance}, {edge.observations} observations"
    )


def _line_trace(
    ends: Float64, tint: str, strong: bool, name: str, in_legend: bool, group: dict[str, str]
) -> Any:
    """Lines from tail to tip; NaN separates them."""
    gaps = np.full((len(ends), 1, 3), np.nan)
    return _scatter(
        np.concatenate([ends, gaps], axis=1).reshape(-1, 3),
        mode="lines",
        line={"color": tint, "width": 4 if strong else 2},
        opacity=0.9 if strong else 0.3,
        hoverinfo="skip",
        name=name,
        showlegend=in_legend,
        **group,
    )


def _arrow_traces(
    ends: Float64, texts: list[str], tint: str, strong: bool, group: dict[str, str]
) -> list[Any]:
    """Arrow heads, and a point with a hover text in the middle of each line."""
    heads = _mesh(
        joined([_head(tail, tip) for tail, tip in ends]),
        color=tint,
        opacity=1.0 if strong else 0.3,
        hoverinfo="skip",
        **group,
    )
    points = _scatter(
        ends.mean(axis=1),
        mode="markers",
        marker={"size": 3.5, "color": tint, "opacity": 0.9 if strong else 0.3},
        hovertext=texts,
        hovertemplate="%{hovertext}<extra></extra>",
        **group,
    )
    return [heads, points]


def _head(tail: Float64, tip: Float64) -> tuple[Float64, Any]:
    """Arrow head near the tip; of no visible size if the ends coincide."""
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
