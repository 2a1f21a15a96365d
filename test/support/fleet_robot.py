"""A robot of a fleet, without cameras: replays local graphs into a graph, and serves it.

python -m support.fleet_robot PLAN.json: see `Plan`. Ends with SIGTERM, and writes its results.
"""

from __future__ import annotations

import dataclasses
import signal
import sys
import threading
import zlib
from pathlib import Path

import msgspec
import numpy as np

from deworldsg_ros.config import Config
from deworldsg_ros.fleet.zenoh_link import Feed, Follower, open_session, part_key, robot_key
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.gaussian import transform
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import local_graph_from_message
from deworldsg_ros.wire.follow import ChangeLog

ASK_S = 0.5


class Plan(msgspec.Struct):
    """What a robot does: it sees `frames` of the file `locals_path`, in a world of its own."""

    name: str
    endpoint: str
    locals_path: str
    frames: tuple[int, int]
    period_s: float
    T_world_room: list[list[float]]
    result_path: str


class Result(msgspec.Struct):
    """What a robot had at the end, and the bytes that it sent.

    `whole_bytes`: as much as the whole graph at each question would have been.
    """

    graph: wire.SceneGraphMessage
    part: wire.SceneGraphMessage
    sent_bytes: int
    whole_bytes: int


def in_world(local: LocalGraph, T: np.ndarray) -> LocalGraph:
    """A local graph in another world frame."""
    means, covariances = transform(local.means_world, local.covariances_world, T)
    return dataclasses.replace(
        local,
        means_world=means,
        covariances_world=covariances,
        T_world_camera=T @ local.T_world_camera,
        surface_points_world=tuple(
            (points @ T[:3, :3].T + T[:3, 3]).astype(points.dtype)
            for points in local.surface_points_world
        ),
    )


def main(plan: Plan, stop: threading.Event) -> None:
    """Replay, serve until the end, write the result."""
    session = open_session(plan.endpoint)
    log, whole_bytes = ChangeLog(), [0]

    def count() -> None:
        if builder is not None:
            whole_bytes[0] += len(zlib.compress(wire.encode(builder.snapshot()).encode(), 1))

    builder: GraphBuilder | None = None
    feed = Feed(session, robot_key(plan.name), log, count)
    token = session.liveliness().declare_token(robot_key(plan.name))
    follower = Follower(session, part_key(plan.name))
    T = np.array(plan.T_world_room)
    lines = Path(plan.locals_path).read_bytes().splitlines()[slice(*plan.frames)]
    for line in lines:
        local = in_world(local_graph_from_message(wire.decode(line, wire.LocalGraphMessage)), T)
        if builder is None:
            builder = GraphBuilder(Config(), local.vocabulary, local.frame_id)
        builder.integrate(local)
        while builder.update() is not None or builder.waiting:
            pass
        log.set(msgspec.structs.replace(builder.snapshot(), session=plan.name))
        follower.ask(ASK_S)
        if stop.wait(plan.period_s):
            break
    print("replayed", flush=True)
    while not stop.wait(ASK_S):
        follower.ask(ASK_S)
    assert builder is not None
    graph = msgspec.structs.replace(builder.snapshot(), session=plan.name)
    result = Result(graph, follower.replica.message(), feed.sent_bytes, whole_bytes[0])
    Path(plan.result_path).write_bytes(msgspec.json.encode(result))
    token.undeclare()
    session.close()


if __name__ == "__main__":
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    main(msgspec.json.decode(Path(sys.argv[1]).read_bytes(), type=Plan), ended)
