"""lifting_node: frame graphs, instance images, depth and poses → deworldsg/local_graph."""

from __future__ import annotations

import sys
from typing import Any

from sensor_msgs.msg import Image

from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.ros.inputs import listen_camera_info, listen_depth, listen_pose
from deworldsg_ros.ros.joining import JoiningNode
from deworldsg_ros.ros.node import run
from deworldsg_ros.ros.options import LIVE_LIFTING
from deworldsg_ros.ros.qos import source
from deworldsg_ros.streams.frames import LiftingAssembler, LiftingFrame
from deworldsg_ros.streams.poses import stamp_ns_of
from deworldsg_ros.wire.codec import frame_graph_from_message, local_graph_to_message
from deworldsg_ros.wire.messages import FrameGraphMessage


class LiftingNode(JoiningNode[LiftingFrame]):
    """Stage b as a node."""

    LIVE = LIVE_LIFTING

    def __init__(self, **options: Any) -> None:
        super().__init__("lifting_node", "local graphs", **options)
        self._lifting = Lifting(self.parameters.lifting)
        self._lifting.warm_up()
        self._publish = self.json_publisher("deworldsg/local_graph", 50)
        frames = self._frames = LiftingAssembler(self.parameters.inputs, **self.assembler_options())
        self.join(frames, self._lift)
        listen_camera_info(self, self.taking(frames.add_camera_info))
        listen_pose(self, frames)
        listen_depth(self, self.taking(frames.add_depth), self.wants_rest)
        self.listen(
            "instances",
            [source("deworldsg/instances", Image)],
            self.taking(lambda message: frames.add_instances(message, stamp_ns_of(message))),
            "reliable",
            is_wanted=self.wants_rest,
        )
        self.listen_json(
            "deworldsg/frame_graph", FrameGraphMessage, self.taking(self._add_frame_graph), 10
        )

    def configure(self) -> None:
        """Take changed parameters."""
        self._lifting.configure(self.parameters.lifting)

    def _add_frame_graph(self, message: FrameGraphMessage) -> None:
        self._frames.add_frame_graph(frame_graph_from_message(message))

    def _lift(self, frame: LiftingFrame) -> None:
        local = self._lifting.lift_frame(frame.frame_graph, frame.instances, frame)
        self._publish(local_graph_to_message(local))
        self.health.left_out(local.drops)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(LiftingNode, args)


if __name__ == "__main__":
    sys.exit(main())
