#!/usr/bin/env python3
"""A detector in a process of its own, as in docs/your_own_detector.md.

python tools/example_detector.py [--ros-args -r rgb/image_raw/compressed:=YOUR_TOPIC]
"""

import json
from contextlib import suppress

import cv2
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import String

from deworldsg_ros.perception.backends.embedded import NanoDetDetector  # put yours here


class ExampleDetector(Node):
    """Sends what a network finds in each image, with the stamp of the image."""

    def __init__(self) -> None:
        super().__init__("example_detector")
        self.network = NanoDetDetector(threads=1)
        self.out = self.create_publisher(String, "deworldsg/detections", 10)
        self.create_subscription(CompressedImage, "rgb/image_raw/compressed", self.detect, 10)

    def detect(self, image: CompressedImage) -> None:
        """Detect objects in an image, and send them."""
        bgr = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
        found = self.network.detect(bgr[:, :, ::-1].copy(), 0.2)
        names = [self.network.classes[best] for best in found.class_probabilities.argmax(axis=1)]
        message = {
            "schema": {"name": "detections", "version": 1},
            "stamp": {"sec": image.header.stamp.sec, "nanosec": image.header.stamp.nanosec},
            "frame_id": image.header.frame_id,
            "detections": [
                {"box_xyxy": box, "hypotheses": [{"name": name, "score": score}]}
                for box, name, score in zip(found.boxes_xyxy.tolist(), names, found.scores.tolist())
            ],
        }
        self.out.publish(String(data=json.dumps(message)))


if __name__ == "__main__":
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):  # Ctrl-C, SIGTERM
        rclpy.spin(ExampleDetector())
