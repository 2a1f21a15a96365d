"""region_node: the graph → the part of it around a point, on topics of its own."""

from __future__ import annotations

import math
import sys
import threading
from dataclasses import replace
from typing import Any

from geometry_msgs.msg import PoseStamped

from deworldsg_ros.client.live import GraphMessage, Region, RegionPart, SceneGraphClient
from deworldsg_ros.ros.graph_output import GraphTopics
from deworldsg_ros.ros.node import StageNode, run
from deworldsg_ros.ros.options import RegionOptions, RegionParameters
from deworldsg_ros.ros.qos import best_effort
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput

# Changes are published at once, up to ten times a second.
PERIOD_S = 0.1
# A followed centre that moves by less than this part of the radius changes nothing.
STEP = 0.02


class RegionNode(StageNode):
    """Follows `/scene_graph` and publishes `region/scene_graph` and its updates.

    Raises:
        ConfigurationError: for a centre that cannot be read.
    """

    PARAMETERS = RegionParameters
    LIVE = ("center", "radius_m", "classes")

    def __init__(self, **options: Any) -> None:
        super().__init__("region_node", "parts of the graph", **options)
        self._lock = threading.Lock()
        self._frame_id = ""
        self._region = region_of(self.parameters.node)
        self._part = RegionPart(self._region)
        self._topics = GraphTopics(self, "region")
        self._client = SceneGraphClient(self.get_namespace(), self.context)
        self._client.on_refused = lambda refusal: self.drop(refusal.reason, str(refusal))
        self._client.on_message(self.guarded(self._add))
        self._client.__enter__()
        self.create_subscription(
            PoseStamped, "region/center", self.guarded(self._follow), best_effort(1)
        )
        self.every(PERIOD_S, self._publish)

    def configure(self) -> None:
        """Take changed parameters; a centre that cannot be read is counted, and changes nothing."""
        try:
            region = region_of(self.parameters.node)
        except ConfigurationError as error:
            self.drop("invalid_region", str(error))
            return
        if region.center is None:
            region = replace(region, center=self._region.center)
        self._move(region)

    def close(self) -> None:
        """End the thread of the client."""
        self._client.close()
        super().close()

    def waiting_for(self, now_ns: int) -> list[str]:
        """The graph, and the centre."""
        missing = []
        if not self._client.has_graph:
            missing.append(f"no graph on {self.resolve_topic_name('scene_graph')}")
        if self._region.center is None:
            missing.append(f"no centre on {self.resolve_topic_name('region/center')}")
        return missing

    def more_values(self) -> dict[str, str]:
        """The size of the part."""
        return {"objects": str(self._part.size)}

    def _add(self, message: GraphMessage) -> None:
        with self._lock:
            self._frame_id = message.frame_id
            self._part.add(message)

    def _follow(self, pose: PoseStamped) -> None:
        if self.parameters.node.center:
            return
        where = pose.pose.position
        center = (where.x, where.y, where.z)
        frame_id = self._frame_id
        if not all(map(math.isfinite, center)):
            raise RefusedInput("invalid_pose", f"centre {center}: expected finite numbers")
        if frame_id and pose.header.frame_id != frame_id:
            raise RefusedInput(
                "wrong_frame", f"centre in frame '{pose.header.frame_id}': expected '{frame_id}'"
            )
        before = self._region.center
        if before is None or math.dist(before, center) > STEP * self._region.radius_m:
            self._move(replace(self._region, center=center))

    def _move(self, region: Region) -> None:
        with self._lock:
            self._region = region
            self._part.move(region)

    def _publish(self) -> None:
        with self._lock:
            graph = self._part.message()
        if graph is not None:
            self._topics.publish(graph)
            self.health.published()


def region_of(options: RegionOptions) -> Region:
    """The region of the parameters; raises ConfigurationError."""
    center = None
    if options.center:
        try:
            x, y, z = map(float, options.center.split(","))
        except ValueError:
            x = y = z = math.nan
        if not math.isfinite(x + y + z):
            raise ConfigurationError(
                f"region_node: parameter center is {options.center!r}: expected X,Y,Z in metres"
            )
        center = (x, y, z)
    classes = tuple(name.strip() for name in options.classes.split(",") if name.strip())
    return Region(center, options.radius_m, classes)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(RegionNode, args)


if __name__ == "__main__":
    sys.exit(main())
