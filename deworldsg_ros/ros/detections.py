"""The objects of the graph as vision_msgs/Detection3DArray, where that package is installed."""

from __future__ import annotations

from contextlib import suppress
from importlib import import_module
from typing import Any

from deworldsg_ros.scene import wire

# The messages of the package vision_msgs; None = it is not installed.
VISION_MSGS: Any = None
with suppress(ImportError):
    VISION_MSGS = import_module("vision_msgs.msg")

TOPIC = "scene_graph/detections"


def detection_array(graph: wire.SceneGraphMessage, stamp: Any, messages: Any = VISION_MSGS) -> Any:
    """All objects that have a box.

    The score of a class is its probability times that of existence. The pose of a hypothesis is the
    mean of the visible surface, with the covariance of the Gaussian.

    Args:
        graph: a snapshot.
        stamp: builtin_interfaces/Time.
        messages: the package vision_msgs.msg.
    """
    array = messages.Detection3DArray()
    array.header.frame_id, array.header.stamp = graph.frame_id, stamp
    for node in graph.nodes:
        if not isinstance(node.box, wire.GravityBox):
            continue
        detection = messages.Detection3D(id=str(node.id))
        detection.header.frame_id, detection.header.stamp = graph.frame_id, stamp
        _set(detection.bbox.center.position, "xyz", node.box.center_m)
        _set(detection.bbox.center.orientation, "xyzw", node.box.orientation_xyzw)
        _set(detection.bbox.size, "xyz", node.box.size_m)
        existence = node.existence if isinstance(node.existence, float) else 1.0
        for belief in node.classes:
            result = messages.ObjectHypothesisWithPose()
            result.hypothesis.class_id = belief.label
            result.hypothesis.score = existence * belief.probability
            _set(result.pose.pose.position, "xyz", node.mean_m)
            result.pose.pose.orientation.w = 1.0
            result.pose.covariance = _six_by_six(node.covariance_m2)
            detection.results.append(result)
        array.detections.append(detection)
    return array


def _set(target: Any, names: str, values: list[float]) -> None:
    for name, value in zip(names, values):
        setattr(target, name, float(value))


def _six_by_six(covariance_m2: list[float]) -> list[float]:
    """(36,) row by row: position first; the orientation has no covariance."""
    rows = [covariance_m2[3 * row : 3 * row + 3] + [0.0] * 3 for row in range(3)]
    return [float(value) for row in [*rows, *([[0.0] * 6] * 3)] for value in row]
