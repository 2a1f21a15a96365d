"""Transforms on /tf: poses of the camera, and objects of the graph."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import TransformStamped

from deworldsg_ros.ros.inputs import POSE_DEPTH, TFMessage
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import quaternion_from_rotation
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.limits import OBJECT_FRAME
from deworldsg_ros.streams.poses import TransformTree, set_stamp
from deworldsg_ros.wire import messages as wire


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


class MapTransform:
    """Publishes how the frame of the poses lies in that of the map: a topic, and /tf_static.

    In TF it is only where tf2_msgs is installed.
    """

    def __init__(self, node: StageNode) -> None:
        self._output = node.create_publisher(
            TransformStamped, "deworldsg/map_transform", reliable(1, latched=True)
        )
        self._tf: Any = None
        if TFMessage is not None:
            self._tf = node.create_publisher(TFMessage, "/tf_static", reliable(1, latched=True))

    def publish(
        self, stamp_ns: int, map_frame: str, world_frame: str, T_map_world: Float64
    ) -> None:
        """Publish a transform (4, 4)."""
        message = TransformStamped(child_frame_id=world_frame)
        message.header.frame_id = map_frame
        set_stamp(message, stamp_ns)
        put_pose(T_map_world, message.transform.translation, message.transform.rotation)
        self._output.publish(message)
        if self._tf is not None:
            self._tf.publish(TFMessage(transforms=[message]))
