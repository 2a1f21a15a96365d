"""Corrections of poses: what was built on poses that have since been corrected moves along.

When a SLAM system closes a loop it changes the poses of a stretch of the trajectory. Objects that
were first seen on that stretch lie where the uncorrected poses put them, and are moved by the
correction. A node that was known before, and seen again on the stretch, is a mean of both; the
earlier observations founded it and hold it in place, so it stays.
"""

from __future__ import annotations

from deworldsg_ros.scene.graph import SceneGraph


def nodes_since(graph: SceneGraph, since_ns: int) -> list[int]:
    """Ids of the nodes first seen at a stamp or later, ascending."""
    nodes = graph.nodes
    return sorted(nodes.ids[nodes.first_seen_ns >= since_ns].tolist())
