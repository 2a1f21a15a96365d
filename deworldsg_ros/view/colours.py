"""Colours and geometry that all views share."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.wire import messages as wire

# --- Geometry of all views: axes of ellipsoids, axes of the top view, edges to draw.

# Size of ellipses and ellipsoids, in standard deviations.
SIGMAS = 2.0

# Symmetric relations: one line shows both directions.
MUTUAL = frozenset({"near", "close by", "next to", "with", "against", "and"})


def principal_axes(covariance: Float64) -> tuple[Float64, Float64]:
    """Standard deviations along the principal axes, and the axes.

    Args:
        covariance: (3, 3) float64, square metres.

    Returns:
        (3,) metres, greatest first, and (3, 3), a right-handed rotation with the axes as columns.
    """
    variances, axes = np.linalg.eigh(covariance)
    axes = axes[:, ::-1]
    if np.linalg.det(axes) < 0:
        axes = axes * np.array([1.0, 1.0, -1.0])
    return np.sqrt(np.maximum(variances[::-1], 0.0)), axes


def view_axes(up_world: Sequence[float] | Float64) -> Float64:
    """Axes of a view from above: (3, 3), rows right, forward and up, right-handed.

    Right is the horizontal part of the world's x axis, or of its y axis where x points up.

    Args:
        up_world: (3,) direction that points up in the world frame.

    Raises:
        ValueError: for another shape, a length of zero, or values that are not finite.
    """
    up = np.asarray(up_world, np.float64)
    norm = float(np.linalg.norm(up)) if up.shape == (3,) else 0.0
    if not np.isfinite(norm) or norm < 1e-9:
        raise ValueError(f"up direction {up.tolist()}: expected three finite values, not all zero")
    up = up / norm
    seed = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = seed - (seed @ up) * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def means_of(graph: wire.SceneGraphMessage) -> Float64:
    """Means of the nodes: (n, 3) metres, world frame."""
    return np.array([node.mean_m for node in graph.nodes], np.float64).reshape(-1, 3)


def covariances_of(graph: wire.SceneGraphMessage) -> Float64:
    """Covariances of the nodes: (n, 3, 3) square metres, world frame."""
    return np.array([node.covariance_m2 for node in graph.nodes], np.float64).reshape(-1, 3, 3)


def drawable_edges(graph: wire.SceneGraphMessage) -> list[wire.EdgeState]:
    """Edges with both ends in the graph; of two opposite symmetric ones the more probable."""
    known = {node.id for node in graph.nodes}
    best: dict[tuple[int, int, str], wire.EdgeState] = {}
    for edge in graph.edges:
        if edge.subject not in known or edge.object not in known:
            continue
        ends = (edge.subject, edge.object)
        if edge.predicate in MUTUAL:
            ends = (min(ends), max(ends))
        key = (*ends, edge.predicate)
        if key not in best or edge.probability > best[key].probability:
            best[key] = edge
    return list(best.values())


# --- One colour per class: the same in every view, and stable while a graph grows.

Rgb = tuple[float, float, float]

PALETTE = (
    "#3b6fb6", "#e07b28", "#3f9b4f", "#d1495b", "#8e5ea2", "#8c6d53", "#c9a227", "#3aa6a0",
    "#d6679a", "#5b6c7d", "#7fa23a", "#b5542f", "#5360c4", "#2f8f8f", "#a83f6f", "#6f7f2f",
    "#4aa3d8", "#e2965a", "#77b255", "#a78bd0",
)  # fmt: skip

PREDICATE_PALETTE = (
    "#2f6fab", "#c2571a", "#2e8b57", "#8a4fbf", "#b8336a", "#8a7a1f", "#1f8a8a", "#7a4a2b",
)  # fmt: skip
# So frequent that its arrows are grey.
QUIET = frozenset({"near"})
GREY = "#8d93a5"


def class_colours(labels: Iterable[str]) -> dict[str, str]:
    """#rrggbb of each label.

    A label has a preferred colour; if an earlier label uses it, the next free one is taken. With
    labels in the order of node ids, a new label changes no colour.
    """
    colours: dict[str, str] = {}
    taken: set[str] = set()
    for label in labels:
        if label in colours:
            continue
        start = zlib.crc32(label.encode())
        order = [PALETTE[(start + step) % len(PALETTE)] for step in range(len(PALETTE))]
        colours[label] = next((colour for colour in order if colour not in taken), order[0])
        taken.add(colours[label])
    return colours


def to_rgb(colour: str) -> Rgb:
    """Red, green and blue from 0 to 1, of #rrggbb."""
    red, green, blue = (int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return red, green, blue


def predicate_colours(counts: Mapping[str, int]) -> dict[str, str]:
    """#rrggbb of each predicate, most frequent first; grey beyond the palette."""
    ordered = sorted(counts, key=lambda name: (-counts[name], name))
    colours = dict.fromkeys(ordered, GREY)
    loud = [name for name in ordered if name not in QUIET]
    colours.update(zip(loud, PREDICATE_PALETTE))
    return colours


def shade(colour: str, factor: float) -> str:
    """A darker #rrggbb: each channel times a factor below one."""
    return "#" + "".join(f"{round(255 * factor * value):02x}" for value in to_rgb(colour))
