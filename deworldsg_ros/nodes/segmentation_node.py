"""segmentation_node: RGB-D frames with poses → deworldsg/frame_graph and deworldsg/instances."""

from __future__ import annotations

import sys
from typing import Any

from sensor_msgs.msg import Image

from deworldsg_ros.ros.models import PerceivingNode
from deworldsg_ros.ros.node import run
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.streams.images import fill_image
from deworldsg_ros.streams.poses import set_stamp
from deworldsg_ros.wire.codec import frame_graph_to_message


class SegmentationNode(PerceivingNode):
    """Stage a as a node."""

    def __init__(self, **options: Any) -> None:
        super().__init__("segmentation_node", "frame graphs", **options)
        self._publish_graph = self.json_publisher("deworldsg/frame_graph", 10)
        self._instances = self.create_publisher(Image, "deworldsg/instances", reliable(10))
        self.listen_to_camera(self._segment)

    def _segment(self, frame: RgbdFrame) -> None:
        perceived = self.perceive(frame)
        image = Image()
        image.header.frame_id = perceived.frame_graph.frame_id
        set_stamp(image, frame.stamp_ns)
        fill_image(image, perceived.instances, "mono16")
        self.finish()
        self._instances.publish(image)
        self._publish_graph(frame_graph_to_message(perceived.frame_graph))


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(SegmentationNode, args)


if __name__ == "__main__":
    sys.exit(main())
