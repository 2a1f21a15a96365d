"""Ask a scene graph: `SceneGraph.load(path)` for a file, `SceneGraphClient()` for the topics.

Nothing here needs ROS but `SceneGraphClient`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from deworldsg_ros.client.changes import Changes, Pairing
from deworldsg_ros.client.explain import Explanation
from deworldsg_ros.client.goals import Goal, Robot
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.next_view import NextView
from deworldsg_ros.client.objects import HiddenObject, Relation, Room, Rooms, SceneObject
from deworldsg_ros.client.removal import Order, Removal
from deworldsg_ros.graph.seen_cells import ViewCamera
from deworldsg_ros.scene.errors import ClientError

if TYPE_CHECKING:
    from deworldsg_ros.client.live import SceneGraphClient

__all__ = [
    "Changes",
    "ClientError",
    "Explanation",
    "Goal",
    "HiddenObject",
    "Order",
    "NextView",
    "Pairing",
    "Relation",
    "Removal",
    "Robot",
    "Room",
    "Rooms",
    "SceneGraph",
    "SceneGraphClient",
    "SceneObject",
    "ViewCamera",
]


def __getattr__(name: str) -> Any:
    # Only the live client needs ROS.
    if name == "SceneGraphClient":
        from deworldsg_ros.client.live import SceneGraphClient

        return SceneGraphClient
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
