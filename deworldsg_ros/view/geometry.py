"""Geometry of all views: axes of ellipsoids, axes of the top view, edges to draw."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64

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
