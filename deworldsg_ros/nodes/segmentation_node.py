"""segmentation_node: RGB-D frames with poses → deworldsg/frame_graph and deworldsg/instances."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

from sensor_msgs.msg import Image

from deworldsg_ros.checkpoints.required import require_checkpoints
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.ros.inputs import listen_camera_info, listen_depth, listen_pose, listen_rgb
from deworldsg_ros.ros.joining import MAX_QUEUE_S, JoiningNode
from deworldsg_ros.ros.node import run
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.codec import frame_graph_to_message
from deworldsg_ros.streams.frame_assemblers import FrameAssembler
from deworldsg_ros.streams.images import fill_image
from deworldsg_ros.streams.poses import set_stamp


class SegmentationNode(JoiningNode[RgbdFrame]):
    """Stage a as a node."""

    def __init__(self, **options: Any) -> None:
        super().__init__("segmentation_node", "frame graphs", max_queue_s=MAX_QUEUE_S, **options)
        inputs = self.parameters.inputs
        perception = self.parameters.perception
        require_checkpoints(perception)
        self._perception = build_perception(perception, world_up=inputs.world_up)
        self._publish_graph = self.json_publisher("deworldsg/frame_graph", 10)
        self._instances = self.create_publisher(Image, "deworldsg/instances", reliable(10))
        frames = self._frames = FrameAssembler(inputs, **self.assembler_options())
        self.join(frames, self._segment)
        listen_camera_info(self, self.taking(frames.add_camera_info))
        listen_pose(self, frames)
        listen_depth(self, self.taking(frames.add_depth), self.wants_images)
        listen_rgb(self, self.taking(frames.add_rgb), self.wants_images)

    def _segment(self, frame: RgbdFrame) -> None:
        perceived = self._perception.perceive(frame)
        camera_frame = self._frames.camera_frame
        image = Image()
        image.header.frame_id = camera_frame
        set_stamp(image, frame.stamp_ns)
        fill_image(image, perceived.instances, "mono16")
        self._instances.publish(image)
        graph = replace(perceived.frame_graph, frame_id=camera_frame)
        self._publish_graph(frame_graph_to_message(graph))
        self.health.left_out(perceived.drops)
        for reason, message in perceived.failures.items():
            self.drop(reason, message)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(SegmentationNode, args)


if __name__ == "__main__":
    sys.exit(main())
