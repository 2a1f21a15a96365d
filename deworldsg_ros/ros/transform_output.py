"""Camera poses on /tf."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import TransformStamped

from deworldsg_ros.ros.inputs import POSE_DEPTH, TFMessage
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.streams.poses import set_stamp
from deworldsg_ros.streams.transforms import TransformTree


def camera_transform(
    tree: TransformTree, stamp_ns: int, world_frame: str, camera_frame: str, T_world_camera: Float64
) -> TransformStamped:
    """The transform from the world to the root of the TF tree that contains the camera.

    In TF a frame has one parent. The optical frame usually has one already: the camera's housing.

    Args:
        tree: static transforms of the camera's mounting.
        stamp_ns: stamp of the image.
        world_frame: frame_id of the pose.
        camera_frame: optical frame.
        T_world_camera: (4, 4) pose of the optical frame.
    """
    root = tree.root(camera_frame)
    T_camera_root = tree.between(stamp_ns, camera_frame, root) if root != camera_frame else None
    T = T_world_camera if T_camera_root is None else T_world_camera @ T_camera_root
    message = TransformStamped(child_frame_id=root)
    message.header.frame_id = world_frame
    set_stamp(message, stamp_ns)
    put_pose(T, message.transform.translation, message.transform.rotation)
    return message


def put_pose(T: Float64, position: Any, orientation: Any) -> None:
    """Write a pose (4, 4) into a Point or Vector3, and a Quaternion."""
    position.x, position.y, position.z = map(float, T[:3, 3])
    orientation.x, orientation.y, orientation.z, orientation.w = map(
        float, quaternion_from_rotation(T[:3, :3])
    )


class TransformOutput:
    """Publishes the camera's pose on /tf, for the root of its mounting on /tf_static.

    Raises:
        ConfigurationError: if tf2_msgs is not installed.
    """

    def __init__(self, node: StageNode) -> None:
        if TFMessage is None:
            raise ConfigurationError(
                "parameter odometry.publish_tf is true, but tf2_msgs is not installed: install all "
                "of ROS 2, or set it to false"
            )
        self._mounting = TransformTree(0)
        self._output = node.create_publisher(TFMessage, "/tf", reliable(POSE_DEPTH))
        node.create_subscription(
            TFMessage,
            "/tf_static",
            node.guarded(lambda message: self._mounting.add(message, static=True)),
            reliable(POSE_DEPTH, latched=True),
        )

    def publish(
        self, stamp_ns: int, world_frame: str, camera_frame: str, T_world_camera: Float64
    ) -> None:
        """Publish a pose (4, 4) of the optical frame."""
        transform = camera_transform(
            self._mounting, stamp_ns, world_frame, camera_frame, T_world_camera
        )
        self._output.publish(TFMessage(transforms=[transform]))
