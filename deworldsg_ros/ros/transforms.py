"""Transforms on /tf, and the poses that a SLAM system has corrected."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Path

from deworldsg_ros.graph.provenance import Trail, TrailChange
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.qos import reliable, source
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import invert_pose, quaternion_from_rotation
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.scene.limits import OBJECT_FRAME
from deworldsg_ros.streams.poses import (
    MAX_FRAMES,
    GraphTrajectory,
    TransformTree,
    pose_from_message,
    pose_from_transform,
    set_stamp,
    stamp_ns_of,
    trajectory_from_message,
)
from deworldsg_ros.wire import messages as wire

try:  # Part of ROS 2, but not of its wheels.
    from tf2_msgs.msg import TFMessage as TFMessage
except ImportError:
    TFMessage = None
try:  # Part of RTAB-Map.
    from rtabmap_msgs.msg import MapGraph as MapGraph
except ImportError:
    MapGraph = None

# Messages that DDS keeps: half a second of poses at 200 Hz, and as much camera_info.
POSE_DEPTH = 100


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


# --- What a SLAM system tells when it has corrected its poses.

CORRECTION_TOPIC, TRAJECTORY_TOPIC = "deworldsg/pose_correction", "deworldsg/trajectory"
Correct = Callable[[Trail], TrailChange | None]


class Corrections:
    """Listens to corrected poses: whole trajectories, one transform since a stamp, or jumps of TF.

    A jump of a transform below the world frame, as of map -> odom when slam_toolbox closes a loop,
    counts if nobody publishes on the other two topics.

    Args:
        node: subscribes.
        world_frame: of the poses of the frames; empty = not known yet.
        take: called with the correction of a `Trail`; a correction raises RefusedInput.
    """

    def __init__(
        self,
        node: StageNode,
        world_frame: Callable[[], str],
        take: Callable[[Correct], None],
    ) -> None:
        self._node, self._world_frame, self._take = node, world_frame, take
        self._graphs = GraphTrajectory()
        # Of each moving frame below the world: when it was where; and what moves below others.
        self._last: dict[str, tuple[int, Float64]] = {}
        self._parents: set[str] = set()
        node.create_subscription(
            PoseStamped, CORRECTION_TOPIC, node.guarded(self._correct), reliable(10)
        )
        kinds = [Path] if MapGraph is None else [Path, MapGraph]
        sources = [source(TRAJECTORY_TOPIC, kind) for kind in kinds]
        node.listen("trajectory", sources, self._follow, "auto", depth=1)
        if TFMessage is not None and node.parameters.merging.association != "paper":
            node.create_subscription(
                TFMessage, "/tf", node.guarded(self._transforms), reliable(POSE_DEPTH)
            )

    def _correct(self, message: Any) -> None:
        self._node.health.received(CORRECTION_TOPIC)
        T_new_old, frame_id = pose_from_message(message)
        since_ns, world_frame = stamp_ns_of(message), self._world_frame()
        if not world_frame:
            raise RefusedInput(
                "no_graph", "pose correction before the first local graph: no node to correct"
            )
        self._check_frame("pose correction", frame_id)
        self._take(lambda trail: trail.since(T_new_old, since_ns))

    def _follow(self, message: Any) -> None:
        is_graph = hasattr(message, "poses_id")
        read = self._graphs.read if is_graph else trajectory_from_message
        stamps_ns, poses, frame_id = read(message)
        if len(stamps_ns) and self._world_frame():
            self._check_frame("trajectory", frame_id)
            self._take(lambda trail: trail.follow(stamps_ns, poses))

    def _transforms(self, message: Any) -> None:
        for transform in message.transforms:
            parent = str(transform.header.frame_id).lstrip("/")
            child = str(transform.child_frame_id).lstrip("/")
            if len(self._parents) < MAX_FRAMES:
                self._parents.add(parent)
            if parent != self._world_frame() or len(self._last) >= MAX_FRAMES:
                continue
            T, stamp_ns = pose_from_transform(transform.transform), stamp_ns_of(transform)
            last_ns, T_last = self._last.get(child, (stamp_ns, T))
            self._last[child] = stamp_ns, T
            # What nothing moves below is the robot itself: it does not jump, it moves.
            if child in self._parents and (T_last != T).any() and not self._is_told():
                self._jump(T @ invert_pose(T_last), (last_ns + stamp_ns) // 2 + 1)

    def _jump(self, T_new_old: Float64, at_ns: int) -> None:
        self._take(lambda trail: trail.jump(T_new_old, at_ns))

    def _is_told(self) -> bool:
        """Whether somebody publishes corrections."""
        topics = (CORRECTION_TOPIC, TRAJECTORY_TOPIC)
        names = (self._node.resolve_topic_name(topic) for topic in topics)
        return any(self._node.count_publishers(name) for name in names)

    def _check_frame(self, what: str, frame_id: str) -> None:
        if frame_id != self._world_frame():
            raise RefusedInput(
                "wrong_frame",
                f"{what} is in frame '{frame_id}', expected '{self._world_frame()}'",
            )


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
