"""Markers for RViz and Foxglove, without ROS; `ros.graph_output` converts them to messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.view.colours import (
    SIGMAS,
    class_colours,
    covariances_of,
    means_of,
    principal_axes,
    to_rgb,
)
from deworldsg_ros.wire import messages as wire

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)
# RViz refuses a scale of zero, and thinner ellipsoids are hard to see.
LEAST_DIAMETER_M = 0.01
SHAFT_M, HEAD_M, HEAD_LENGTH_M = 0.012, 0.035, 0.06
TEXT_M, SMALL_TEXT_M = 0.09, 0.06
ID_LIMIT = 2**31  # Marker.id is an int32


@dataclass(frozen=True)
class Marker:
    """One marker, in the frame of the graph.

    Attributes:
        namespace, id: identity, stable for the life of a node or edge.
        kind: "sphere" (an ellipsoid by its scale), "text" or "arrow".
        position: metres; the origin for arrows.
        quat_xyzw: orientation.
        scale: metres; diameters of a sphere; (shaft, head, head length) of an arrow; (0, 0, height)
            of a text.
        rgba: 0 to 1.
        text: content of a text.
        points: tail and tip of an arrow.
    """

    namespace: str
    id: int
    kind: Literal["sphere", "text", "arrow"]
    position: Vector
    quat_xyzw: Quaternion
    scale: Vector
    rgba: Quaternion
    text: str = ""
    points: tuple[Vector, ...] = ()


def markers(message: wire.SceneGraphMessage) -> list[Marker]:
    """Ellipsoids (2σ) with labels, and arrows with predicates."""
    colours = class_colours(node.label for node in message.nodes)
    means, covariances = means_of(message), covariances_of(message)
    result: list[Marker] = []
    for node, mean, covariance in zip(message.nodes, means, covariances):
        result += _node_markers(node, mean, covariance, colours[node.label])
    row_of = {node.id: row for row, node in enumerate(message.nodes)}
    for edge in message.edges:
        if edge.subject in row_of and edge.object in row_of:
            tail, tip = means[row_of[edge.subject]], means[row_of[edge.object]]
            result += _edge_markers(edge, tail, tip)
    return result


def pair_id(subject: int, object_: int) -> int:
    """An id of an ordered pair (Szudzik's pairing), unique for node ids below 46341."""
    low_first = object_ * object_ + subject
    high_first = subject * subject + subject + object_
    return (high_first if subject >= object_ else low_first) % ID_LIMIT


def _vector(values: Float64) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)


def _node_markers(
    node: wire.NodeState, mean: Float64, covariance: Float64, colour: str
) -> list[Marker]:
    deviations, axes = principal_axes(covariance)
    x, y, z, w = quaternion_from_rotation(axes).tolist()
    diameters = np.maximum(2 * SIGMAS * deviations, LEAST_DIAMETER_M)
    above = mean + np.array([0.0, 0.0, SIGMAS * np.sqrt(covariance[2, 2]) + TEXT_M])
    number = node.id % ID_LIMIT
    ellipsoid = Marker(
        "objects", number, "sphere", _vector(mean), (x, y, z, w), _vector(diameters),
        (*to_rgb(colour), 0.55),
    )  # fmt: skip
    label = Marker(
        "labels", number, "text", _vector(above), IDENTITY, (0.0, 0.0, TEXT_M),
        (1.0, 1.0, 1.0, 1.0), f"{node.label} #{node.id}",
    )  # fmt: skip
    return [ellipsoid, label]


def _edge_markers(edge: wire.EdgeState, tail: Float64, tip: Float64) -> list[Marker]:
    number = pair_id(edge.subject, edge.object)
    alpha = 0.25 + 0.7 * min(edge.probability, 1.0)
    # Nearer to the tail, so that the texts of two opposite edges do not overlap.
    position = tail + 0.4 * (tip - tail)
    arrow = Marker(
        "relations", number, "arrow", (0.0, 0.0, 0.0), IDENTITY, (SHAFT_M, HEAD_M, HEAD_LENGTH_M),
        (0.95, 0.75, 0.2, alpha), "", (_vector(tail), _vector(tip)),
    )  # fmt: skip
    predicate = Marker(
        "predicates", number, "text", _vector(position), IDENTITY, (0.0, 0.0, SMALL_TEXT_M),
        (1.0, 0.9, 0.6, alpha), edge.predicate,
    )  # fmt: skip
    return [arrow, predicate]
