"""viewer_node: /scene_graph, its updates and the camera → a page on this machine."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec
import numpy as np
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import Image
from std_msgs.msg import String

from deworldsg_ros.graph.provenance import Trail
from deworldsg_ros.ros.inputs import listen_rgb
from deworldsg_ros.ros.node import StageNode, run
from deworldsg_ros.ros.options import ViewerOptions, ViewerParameters
from deworldsg_ros.ros.qos import reliable, source
from deworldsg_ros.ros.transforms import Correct, Corrections
from deworldsg_ros.scene.camera import invert_pose
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.streams.images import instances_from_message, rgb_from_message
from deworldsg_ros.streams.poses import pose_from_transform, stamp_ns_of
from deworldsg_ros.view.live.camera import FrameJoiner
from deworldsg_ros.view.live.sources import Sink, open_sink
from deworldsg_ros.view.live.state import OnError
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import local_graph_from_message
from deworldsg_ros.wire.follow import GraphFollower

# Frames of the camera are shown at most so often; the others are not decoded.
VIEW_PERIOD_S = 0.15


class _Stamped(msgspec.Struct):
    """The field of a local graph by which it is joined."""

    stamp: wire.Stamp


class ViewerNode(StageNode):
    """Follows the graph and shows it.

    Raises:
        ConfigurationError: for an address that this machine cannot listen on, or without the
            package for Foxglove.
    """

    PARAMETERS = ViewerParameters

    def __init__(self, **options: Any) -> None:
        super().__init__("viewer_node", "views", **options)
        topic = self.resolve_topic_name("scene_graph")
        self._viewer = make_viewer(
            self.parameters.node,
            f"waiting for {topic}: is graph_node running, and is ROS_DOMAIN_ID the same?",
            self._failed,
        )
        self._follower = GraphFollower(self._viewer)
        self._frames = FrameJoiner(VIEW_PERIOD_S)
        self.listen_json("scene_graph/updates", wire.SceneGraphUpdateMessage, self._update, 50)
        self.create_subscription(
            String, "scene_graph", self.guarded(self._snapshot), reliable(1, latched=True)
        )
        self.create_subscription(
            String, "deworldsg/local_graph", self.guarded(self._local), reliable(10)
        )
        self._trail, self._world_frame = Trail(), ""
        Corrections(self, lambda: self._world_frame, self._correct)
        self._T_map_world, self._placed_frame = np.eye(4), ""
        self.create_subscription(
            TransformStamped,
            "deworldsg/map_transform",
            self.guarded(self._place),
            reliable(1, latched=True),
        )
        self.listen(
            "instances",
            [source("deworldsg/instances", Image)],
            lambda message: self._add(
                "instances", stamp_ns_of(message), lambda: instances_from_message(message)
            ),
            "reliable",
        )
        listen_rgb(
            self,
            lambda message, stamp_ns: self._add("rgb", stamp_ns, lambda: rgb_from_message(message)),
            lambda: True,
        )

    def waiting_for(self, now_ns: int) -> list[str]:
        """The topic of the graph, until it has come."""
        topic = self.resolve_topic_name("scene_graph")
        return [] if self._follower.has_graph else [f"no graph on {topic}"]

    def more_values(self) -> dict[str, str]:
        """Gaps in the updates."""
        return {"gaps": str(self._follower.gaps)}

    def close(self) -> None:
        """End the page."""
        self._viewer.close()
        super().close()

    def _failed(self, error: Exception) -> None:
        """Count an exception of the page's thread, and log it."""
        with self.refusing():
            raise error

    def _snapshot(self, message: Any) -> None:
        self._follower.snapshot(wire.decode(message.data, wire.SceneGraphMessage))
        if not self._viewer.sequence:
            self._viewer.say("the graph is empty: no object was seen often enough yet")

    def _update(self, update: wire.SceneGraphUpdateMessage) -> None:
        self._follower.update(update)
        for seen in update.associations:
            self._add("node_ids", wire.ns_from_stamp(seen.stamp), partial(list, seen.nodes))

    def _local(self, message: Any) -> None:
        text = message.data
        try:
            stamp = msgspec.json.decode(text, type=_Stamped).stamp
        except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            raise RefusedInput("invalid_message", f"local graph: {error}") from error
        self._add("local", wire.ns_from_stamp(stamp), lambda: self._decoded(text))

    def _decoded(self, text: str) -> LocalGraph:
        """A local graph in the frame of the graph."""
        local = local_graph_from_message(wire.decode(text, wire.LocalGraphMessage))
        if local.frame_id != self._placed_frame:
            return local
        from deworldsg_ros.poses.drift import moved  # its kernels are slow to load, and rarely used

        return moved(local, self._T_map_world)

    def _place(self, message: Any) -> None:
        """The graph was found in a map: what was seen so far moves there, and what comes."""
        before, self._T_map_world = self._T_map_world, pose_from_transform(message.transform)
        self._placed_frame = message.child_frame_id
        # What was placed before, as by a graph_node that has ended, moves by the difference.
        if not np.array_equal(before, self._T_map_world):
            change = self._trail.since(invert_pose(before) @ self._T_map_world, 0)
            self._viewer.correct(change)
            self._trail.place(self._T_map_world)

    def _correct(self, correct: Correct) -> None:
        change = correct(self._trail)
        if change is not None:
            self._viewer.correct(change)

    def _add(self, part: str, stamp_ns: int, decode: Callable[[], Any]) -> None:
        view = self._frames.add(part, stamp_ns, decode, time.monotonic())
        if view is not None:
            self._trail.note(view.stamp_ns, view.T_world_camera, view.T_world_camera)
            if view.local is not None:
                self._world_frame = view.local.frame_id
            self._viewer.look(view)
            self.health.published()


def make_viewer(options: ViewerOptions, why_empty: str, on_error: OnError) -> Sink:
    """The page, with its address in the log; raises ConfigurationError without the package."""
    try:
        viewer = open_sink(
            options.host,
            options.port,
            why_empty,
            foxglove=options.foxglove,
            on_error=on_error,
        )
    except ImportError as error:
        raise ConfigurationError(
            f"viewer_node: {error}: pip install 'deworldsg_ros[foxglove]'"
        ) from error
    print(f"view: {viewer.url}", flush=True)
    return viewer


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(ViewerNode, args)


if __name__ == "__main__":
    sys.exit(main())
