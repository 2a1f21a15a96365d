"""Markers of `view.markers` as ROS messages."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from geometry_msgs.msg import Point
from visualization_msgs.msg import Marker, MarkerArray

KINDS = {"sphere": Marker.SPHERE, "text": Marker.TEXT_VIEW_FACING, "arrow": Marker.ARROW}


def marker_array(markers: Iterable[Any], frame_id: str, stamp: Any) -> MarkerArray:
    """All markers of the graph, after a marker that deletes the previous ones.

    A viewer that joins late or loses messages thus shows the same as any other.

    Args:
        markers: as `view.markers.Marker`.
        frame_id: world frame.
        stamp: builtin_interfaces/Time.
    """
    clear = Marker(action=Marker.DELETEALL)
    clear.header.frame_id, clear.header.stamp = frame_id, stamp
    array = MarkerArray(markers=[clear])
    for item in markers:
        marker = Marker(type=KINDS[item.kind], action=Marker.ADD, ns=item.namespace, id=item.id)
        marker.header.frame_id, marker.header.stamp = frame_id, stamp
        position, orientation = marker.pose.position, marker.pose.orientation
        position.x, position.y, position.z = map(float, item.position)
        orientation.x, orientation.y, orientation.z, orientation.w = map(float, item.quat_xyzw)
        marker.scale.x, marker.scale.y, marker.scale.z = map(float, item.scale)
        colour = marker.color
        colour.r, colour.g, colour.b, colour.a = map(float, item.rgba)
        marker.text = item.text
        marker.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in item.points]
        array.markers.append(marker)
    return array
