"""The objects of the graph as frames on /tf."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import TransformStamped

from deworldsg_ros.ros.inputs import POSE_DEPTH, TFMessage
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.names import OBJECT_FRAME


def object_transforms(
    graph: wire.SceneGraphMessage, stamp: Any, prefix: str = ""
) -> list[TransformStamped]:
    """A transform from the world to the box of each object that has one; frame ``object_ID``.

    Args:
        graph: a snapshot.
        stamp: builtin_interfaces/Time.
        prefix: of the frames, e.g. ``robot1/``.
    """
    transforms = []
    for node in graph.nodes:
        if not isinstance(node.box, wire.GravityBox):
            continue
        found = TransformStamped(child_frame_id=f"{prefix}{OBJECT_FRAME}{node.id}")
        found.header.frame_id, found.header.stamp = graph.frame_id, stamp
        at, turned = found.transform.translation, found.transform.rotation
        at.x, at.y, at.z = map(float, node.box.center_m)
        turned.x, turned.y, turned.z, turned.w = map(float, node.box.orientation_xyzw)
        transforms.append(found)
    return transforms


class ObjectTransforms:
    """Publishes the objects on /tf; below a namespace, their frames have its prefix.

    Raises:
        ConfigurationError: if tf2_msgs is not installed.
    """

    def __init__(self, node: StageNode) -> None:
        if TFMessage is None:
            raise ConfigurationError(
                "parameter output.publish_tf is true, but tf2_msgs is not installed: install all "
                "of ROS 2, or set it to false"
            )
        self._prefix = f"{node.get_namespace()}/".lstrip("/")
        self._output = node.create_publisher(TFMessage, "/tf", reliable(POSE_DEPTH))

    def publish(self, graph: wire.SceneGraphMessage, stamp: Any) -> None:
        """Publish the objects of a snapshot."""
        transforms = object_transforms(graph, stamp, self._prefix)
        if transforms:
            self._output.publish(TFMessage(transforms=transforms))
