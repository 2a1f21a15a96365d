"""`deworldsg doctor --live`: diagnostics, publishers and stamps of running nodes."""

import threading

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo, Image
from support.nodes import peer
from support.nodes_bench import stamped
from support.races import beside

from deworldsg_ros.doctor import find
from deworldsg_ros.ros.observing import observe_nodes
from deworldsg_ros.ros.qos import best_effort, reliable
from deworldsg_ros.streams.images import fill_image

VALUES = {
    "received rgb": "9.8 per second, 100 in total",
    "dropped no_pose": "60",
    "dropped by another program": "many",
    "example no_pose": "frame at 7 s has no pose",
    "frames turned by 90 degrees": "12",
    "waiting for 1": "no rgb on /rgb/image_raw for 5 s",
    "listening to 1": "/rgb/image_raw [sensor_msgs/msg/Image] reliable",
    "listening to 2": "/depth/image_raw [sensor_msgs/msg/Image] reliable",
    "listening to 3": "/rgb/camera_info [sensor_msgs/msg/CameraInfo] reliable",
    "listening to 4": "/camera/pose [geometry_msgs/msg/PoseStamped] best effort",
}


@pytest.fixture
def robot():
    """A camera under another name, best-effort depth, and poses of another clock."""
    with peer("a_robot") as robot:
        node = robot.node
        diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        node.create_publisher(Image, "/camera/color/image_raw", reliable(1))
        node.create_publisher(Image, "/depth/image_raw", best_effort(1))
        info = node.create_publisher(CameraInfo, "/rgb/camera_info", reliable(1))
        poses = node.create_publisher(PoseStamped, "/camera/pose", reliable(1))

        def publish():
            status = DiagnosticStatus(
                name="segmentation_node: /segmentation_node",
                hardware_id="deworldsg_ros",
                values=[KeyValue(key=key, value=value) for key, value in VALUES.items()],
            )
            other = DiagnosticStatus(name="motor", hardware_id="motor")
            diagnostics.publish(DiagnosticArray(status=[status, other]))
            info.publish(stamped(CameraInfo(), -(10**9)))  # no time: it is left out
            info.publish(stamped(CameraInfo(), node.get_clock().now().nanoseconds))
            poses.publish(stamped(PoseStamped(), 7 * 10**9))

        node.create_timer(0.1, publish)
        stop = threading.Event()

        def spin():
            while not stop.is_set():
                robot.spin_for(0.1)

        thread = threading.Thread(target=spin)
        thread.start()
        yield
        stop.set()
        thread.join()


def test_a_running_system_is_examined(robot):
    texts = {finding.code: str(finding) for finding in find(observe_nodes(4.0))}
    assert set(texts) == {"no_publisher", "qos", "clock", "late_poses", "turned"}
    assert "Nobody publishes /rgb/image_raw" in texts["no_publisher"]
    assert "/camera/color/image_raw" in texts["no_publisher"]
    assert "/depth/image_raw is published best effort" in texts["qos"]
    assert "/camera/pose are" in texts["clock"]
    assert "60 images" in texts["late_poses"]


def test_without_nodes_that_is_the_finding():
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        assert [finding.code for finding in find(observe_nodes(2.0, context))] == ["no_nodes"]
    finally:
        rclpy.try_shutdown(context=context)


def test_what_the_messages_say_is_named_first():
    """Depth of the other camera, in millimetres as floats, beside our own poses of a goal."""
    values = {
        "received depth": "9.8 per second, 100 in total",
        "listening to 1": "/rgb/image_raw [sensor_msgs/msg/Image] reliable",
        "listening to 2": "/depth/image_raw [sensor_msgs/msg/Image] reliable",
        "listening to 3": "/rgb/camera_info [sensor_msgs/msg/CameraInfo] reliable",
        "listening to 4": "/camera/pose [geometry_msgs/msg/PoseStamped] reliable",
        "waiting for 1": "no pose on /camera/pose for 5 s",
    }
    with peer("a_camera") as camera:
        node = camera.node
        makers = {
            "/diagnostics": lambda: DiagnosticArray(
                status=[
                    DiagnosticStatus(
                        name="lifting_node: /lifting_node",
                        hardware_id="deworldsg_ros",
                        values=[KeyValue(key=key, value=value) for key, value in values.items()],
                    )
                ]
            ),
            "/rgb/image_raw": lambda: pixels(np.zeros((4, 6, 3), np.uint8), "rgb8", "color"),
            "/depth/image_raw": lambda: pixels(np.full((4, 6), 1500, "f4"), "32FC1", "depth"),
            "/rgb/camera_info": lambda: intrinsics(600.0),
            "/depth/camera_info": lambda: intrinsics(400.0),
            "/deworldsg/goal": PoseStamped,
        }
        publishers = {
            topic: node.create_publisher(type(make()), topic, reliable(1))
            for topic, make in makers.items()
        }

        def publish():
            for topic, make in makers.items():
                publishers[topic].publish(make())

        node.create_timer(0.1, publish)
        with beside(lambda: camera.spin_for(0.1)):
            seen = observe_nodes(4.0)
    assert seen.headers["depth"].frame_id == "depth"
    assert seen.headers["depth"].intrinsics.fx == 400.0
    assert seen.headers["camera_info"].intrinsics.fx == 600.0
    assert seen.headers["depth"].middle_m == 1500.0
    texts = {finding.code: str(finding) for finding in find(seen)}
    assert set(texts) == {"no_publisher", "clock", "depth_unit"}  # the stamps are 0
    assert "No topics of these types" in texts["no_publisher"]
    assert "millimetres" in texts["depth_unit"]


def pixels(values, encoding, frame):
    message = Image()
    fill_image(message, values, encoding)
    message.header.frame_id = frame
    return message


def intrinsics(focal):
    return CameraInfo(width=6, height=4, k=[focal, 0.0, 3.0, 0.0, focal, 2.0, 0.0, 0.0, 1.0])
