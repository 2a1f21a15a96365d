"""fleet_node: the graphs of all robots → one graph, and to each robot what concerns it."""

from __future__ import annotations

import json
import sys
import time
from contextlib import suppress
from typing import Any

from deworldsg_ros.fleet.fleet import Fleet
from deworldsg_ros.fleet.zenoh_link import Feed, NoRouterError, Robots, open_session, part_key
from deworldsg_ros.ros.graph_output import GraphTopics
from deworldsg_ros.ros.node import StageNode, run
from deworldsg_ros.ros.options import FleetParameters
from deworldsg_ros.ros.threads import Repeating
from deworldsg_ros.wire.follow import ChangeLog

# A robot that did not answer for this time is reported.
SILENCE_S = 5.0


class FleetNode(StageNode):
    """Asks every robot for its changes, combines the graphs, serves the parts.

    Raises:
        ConfigurationError: without Zenoh, for an endpoint that cannot be read or is in use.
    """

    PARAMETERS = FleetParameters

    def __init__(self, **options: Any) -> None:
        super().__init__("fleet_node", "graphs of the fleet", **options)
        self._session: Any = None
        self._robots: Robots | None = None
        self._connect()
        self._fleet = Fleet()
        self._topics = GraphTopics(self, "fleet")
        self._publish_robots = self.text_publisher("fleet/robots", 1, latched=True)
        self._feeds: dict[str, Feed] = {}
        self._parts: dict[str, ChangeLog] = {}
        self._answered_s: dict[str, float] = {}
        self._loop = Repeating(self, self._step, self.parameters.node.period_s)

    def close(self) -> None:
        """End the thread and the connections."""
        self._loop.stop()
        if self._session is not None:
            self._session.close()
        super().close()

    def waiting_for(self, now_ns: int) -> list[str]:
        """Robots that do not answer, and those that are not located."""
        if self._robots is None:
            return [f"no router answers at {self.parameters.node.connect}"]
        now_s = time.monotonic()
        missing = [
            f"{name} has not answered for {now_s - last_s:.0f} s"
            for name, last_s in sorted(self._answered_s.copy().items())
            if now_s - last_s > SILENCE_S
        ]
        missing += [
            f"{name} is not located: {member.reason}"
            for name, member in sorted(self._fleet.members.copy().items())
            if member.T_fleet_world is None
        ]
        return missing or ([] if self._answered_s else ["no robot: start fleet_link_node on each"])

    def more_values(self) -> dict[str, str]:
        """Robots and bytes on the wire."""
        robots = self._robots
        return {
            "robots": str(len(self._answered_s)),
            "bytes received": str(0 if robots is None else robots.received_bytes),
            "bytes sent": str(sum(feed.sent_bytes for feed in list(self._feeds.values()))),
        }

    def _connect(self) -> None:
        """Listen, or look for a router; `waiting_for` says if there is none yet."""
        settings = self.parameters.node
        listen = "" if settings.connect else settings.listen
        with suppress(NoRouterError):
            self._session = open_session(connect=settings.connect, listen=listen)
            self._robots = Robots(self._session)

    def _step(self) -> None:
        if self._robots is None:
            self._connect()
        robots = self._robots
        if robots is None:
            return
        answers = robots.ask(self.parameters.node.period_s + 1.0)
        for error in robots.take_errors():
            with self.refusing():
                raise error
        for name in robots.take_forgotten():
            self._answered_s.pop(name, None)
            self._fleet.members.pop(name, None)
            self._parts.pop(name, None)
            if name in self._feeds:
                self._feeds.pop(name).close()
        for name, changed in answers.items():
            if changed is not None:
                self._answered_s[name] = time.monotonic()
            if changed:
                self._fleet.update(name, robots.followers[name].replica.message())
        if not any(answers.values()):
            return
        self._topics.publish(self._fleet.combine())
        for name in self._fleet.members:
            with self.refusing():  # what one robot sent stops no other robot
                self._serve(name)
        self._publish_robots(json.dumps(self._fleet.status()))
        self.health.published()

    def _serve(self, name: str) -> None:
        """Bring a robot's part of the graph up to date."""
        part = self._fleet.part_for(name)
        if name not in self._feeds:
            self._parts[name] = ChangeLog()
            self._feeds[name] = Feed(self._session, part_key(name), self._parts[name])
        if part is not None:
            self._parts[name].set(part)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(FleetNode, args)


if __name__ == "__main__":
    sys.exit(main())
