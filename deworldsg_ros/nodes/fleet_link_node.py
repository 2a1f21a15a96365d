"""fleet_link_node: a robot's link to the fleet. Its graph goes out, what concerns it comes back."""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

from deworldsg_ros.client.live import SceneGraphClient
from deworldsg_ros.fleet.zenoh_link import (
    ROBOT_NAME,
    Feed,
    Follower,
    NoRouterError,
    open_session,
    part_key,
    robot_key,
)
from deworldsg_ros.ros.graph_output import GraphTopics
from deworldsg_ros.ros.node import StageNode, run
from deworldsg_ros.ros.options import FleetLinkParameters
from deworldsg_ros.ros.threads import Repeating
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.wire.follow import ChangeLog


class _Link(NamedTuple):
    """The connection to the fleet."""

    session: Any
    feed: Feed
    follower: Follower
    token: Any


class FleetLinkNode(StageNode):
    """Serves the graph of `/scene_graph` to the fleet; publishes the part that concerns the robot.

    Raises:
        ConfigurationError: without a name, without Zenoh, for an endpoint that cannot be read.
    """

    PARAMETERS = FleetLinkParameters

    def __init__(self, **options: Any) -> None:
        super().__init__("fleet_link_node", "parts of the fleet's graph", **options)
        settings = self.parameters.node
        if not ROBOT_NAME.fullmatch(settings.robot):
            raise ConfigurationError(
                f"fleet_link_node: parameter robot is {settings.robot!r}: expected a name of "
                "letters, digits, _ and -, unique in the fleet"
            )
        self._client = SceneGraphClient(self.get_namespace(), self.context).__enter__()
        self._client.on_refused = lambda refusal: self.drop(refusal.reason, str(refusal))
        self._log = ChangeLog()
        self._link: _Link | None = None
        self._connect()
        self._others = GraphTopics(self, "others")
        self._is_connected = False
        self._loop = Repeating(self, self._ask, settings.period_s)

    def close(self) -> None:
        """End the thread and the connections."""
        self._loop.stop()
        self._client.close()
        if self._link is not None:
            self._link.session.close()
        super().close()

    def waiting_for(self, now_ns: int) -> list[str]:
        """The graph of this robot, and the fleet."""
        missing = []
        if self._client.newest is None:
            missing.append(f"no graph on {self.resolve_topic_name('scene_graph')}")
        if not self._is_connected:
            missing.append(f"no answer of fleet_node over {self.parameters.node.connect}")
        return missing

    def more_values(self) -> dict[str, str]:
        """Bytes on the wire."""
        link = self._link
        if link is None:
            return {}
        return {
            "bytes sent": str(link.feed.sent_bytes),
            "bytes received": str(link.follower.received_bytes),
            "objects of others": str(len(link.follower.replica.nodes)),
        }

    def _refresh(self) -> None:
        graph = self._client.newest
        if graph is not None:
            self._log.set(graph.message)

    def _connect(self) -> None:
        """Look for a router; `waiting_for` says if there is none yet."""
        settings = self.parameters.node
        try:
            session = open_session(connect=settings.connect)
        except NoRouterError:
            return
        key = robot_key(settings.robot)
        self._link = _Link(
            session,
            Feed(session, key, self._log, self.guarded(self._refresh)),
            Follower(session, part_key(settings.robot)),
            session.liveliness().declare_token(key),
        )

    def _ask(self) -> None:
        if self._link is None:
            self._connect()
        if self._link is None:
            return
        follower = self._link.follower
        changed = follower.ask(self.parameters.node.period_s + 1.0)
        self._is_connected = changed is not None
        if follower.others:
            follower.others = 0
            self.drop("same_name", "two fleet_nodes answer: the first one is followed; end one")
        if changed:
            self._others.publish(follower.replica.message())
            self.health.published()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(FleetLinkNode, args)


if __name__ == "__main__":
    sys.exit(main())
