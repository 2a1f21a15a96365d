"""The graph projected into the plane of the picture, and the canvas to draw it on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from deworldsg_ros.client.objects import SceneObject, scene_object
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.scene.extent import surface_points
from deworldsg_ros.view.colours import QUIET, class_colours, predicate_colours
from deworldsg_ros.view.geometry import drawable_edges, view_axes

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
        path: (m, 2) camera positions.
    """

    axes: Float64
    means: Float64
    corners: Float64
    heights: Float64
    points: tuple[Float64, ...]
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
