"""Pose corrections: which nodes move with corrected poses.

When a SLAM system closes a loop, it corrects the poses of a part of the trajectory. Nodes first
seen in that part have the error of its poses and are moved by the correction. A node that was seen
before and again in that part averages both. Its earlier observations had correct poses, so it
stays.
"""

from __future__ import annotations

from deworldsg_ros.scene.graph import SceneGraph


def nodes_since(graph: SceneGraph, since_ns: int) -> list[int]:
    """Ids of the nodes first seen at a stamp or later, ascending."""
    nodes = graph.nodes
    return sorted(nodes.ids[nodes.first_seen_ns >= since_ns].tolist())
