"""Answers as ROS messages."""

from __future__ import annotations

from collections.abc import Sequence

from builtin_interfaces.msg import Time
from diagnostic_msgs.srv import AddDiagnostics
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from std_msgs.msg import Header
from std_srvs.srv import Trigger

# The types of the services of graph_node: with JSON in `load_namespace`, and without arguments.
TEXT_SERVICE, TRIGGER_SERVICE = AddDiagnostics, Trigger


def pose_stamped(
    position_m: Sequence[float], orientation_xyzw: Sequence[float], frame_id: str, stamp_ns: int
) -> PoseStamped:
    """A pose as a message, e.g. for Nav2."""
    sec, nanosec = divmod(stamp_ns, 10**9)
    x, y, z = position_m
    qx, qy, qz, qw = orientation_xyzw
    return PoseStamped(
        header=Header(stamp=Time(sec=sec, nanosec=nanosec), frame_id=frame_id),
        pose=Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw)),
    )
