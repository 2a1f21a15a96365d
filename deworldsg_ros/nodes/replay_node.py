"""replay_node: publishes a bag or data set folder on the topics of the pipeline.

Messages of a bag are published byte for byte. Poses are computed from TF, and messages from
folders, during the replay. The node waits for the pipeline and limits the frames in flight, so that
a slow machine loses no frame.
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from deworldsg_ros.nodes.replay_monitor import SETTLE_S, Endpoint, PipelineMonitor
from deworldsg_ros.recordings import events, messages
from deworldsg_ros.recordings.bags.topics import parse_topics
from deworldsg_ros.recordings.folders.dataset import DatasetOptions, parse_intrinsics
from deworldsg_ros.recordings.messages import Role
from deworldsg_ros.recordings.pacing import Pace
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.source import RawRoleMessage, Source
from deworldsg_ros.recordings.writer import topic_of
from deworldsg_ros.ros.options import ReplayParameters
from deworldsg_ros.ros.parameters import declare
from deworldsg_ros.ros.process import refuse, run_process
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.errors import ConfigurationError, DeWorldSGError
from deworldsg_ros.words import counted

CLASSES = {
    messages.IMAGE: Image,
    messages.COMPRESSED_IMAGE: CompressedImage,
    messages.CAMERA_INFO: CameraInfo,
    messages.POSE_STAMPED: PoseStamped,
    messages.ODOMETRY: Odometry,
}
# Messages that DDS keeps for a subscriber: more than the window of a replay, and small in memory.
PUBLISHER_DEPTH = 10
# Without the four nodes: a viewer or a recorder subscribes within this time.
LISTENER_WAIT_S = 4.0
# Without a result for this time, a node has failed or hangs: the slowest step, a large model on a
# CPU, takes seconds per frame.
STALL_S = 30.0
# Longest delay until a signal is noticed.
SPIN_PERIOD_S = 0.1
EXIT_NOT_READY = 3


class NotReady(DeWorldSGError):
    """The four nodes did not start in time."""


class Stopped(Exception):
    """SIGINT or SIGTERM arrived."""


class ReplayNode(Node):
    """Publishes a recording; `replay` runs from the first message to the last.

    Args:
        stop: set by a signal.
        options: arguments of rclpy's Node.

    Raises:
        ConfigurationError: for an unknown parameter, or without a recording.
        RecordingError: for a recording that cannot be read.
    """

    def __init__(self, stop: threading.Event, **options: Any) -> None:
        super().__init__("replay_node", **options)
        self._stop = stop
        parameters = declare(self, ReplayParameters)
        self._options = parameters.node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._source = _open_recording(parameters)
        self._outputs = {
            role: self._publisher(role, topic.msgtype)
            for role, topic in self._source.topics.items()
            if role is not Role.POSE or not self._options.odometry
        }
        self._clock_output = (
            self.create_publisher(Clock, "/clock", 10) if self._options.clock else None
        )
        self._monitor = PipelineMonitor(self, odometry=self._options.odometry)
        self._pace = Pace(self._options.rate)
        self._published = 0
        self._reported_s = 0.0

    def replay(self) -> None:
        """Wait for the nodes, publish everything, wait until it is processed.

        Raises:
            NotReady: if the nodes are required and do not start in time.
            Stopped: after a signal.
        """
        alone = not self._wait_for_pipeline()
        if alone:
            self._wait_for_listeners()
        self._emit(events.Started(self._source.frame_count))
        for message in self._source.raw_messages():
            if message.role in self._outputs:
                self._wait_until_due(message, alone)
                self._publish(message)
                self._emit_progress()
        self._monitor.window.close()
        drained = alone or self._drain()
        if self._options.save and not alone:
            self._save()
        self._emit_progress(at_once=True)
        self._finish(drained)

    def close(self) -> None:
        """Close the recording and the executor."""
        self._source.close()
        self._executor.shutdown(timeout_sec=1.0)

    def _publisher(self, role: Role, msgtype: str) -> Any:
        # TF is replayed as the poses computed from it.
        kind = messages.POSE_STAMPED if msgtype == messages.TF_MESSAGE else msgtype
        topic = topic_of(role, kind).lstrip("/")
        return self.create_publisher(CLASSES[kind], topic, reliable(PUBLISHER_DEPTH))

    def _publish(self, message: RawRoleMessage) -> None:
        self._outputs[message.role].publish(message.data)
        if self._clock_output is not None:
            sec, nanosec = divmod(message.log_time_ns, 10**9)
            self._clock_output.publish(Clock(clock=Time(sec=sec, nanosec=nanosec)))
        if message.role is Role.RGB:
            self._published += 1
            self._monitor.window.publish(message.stamp_ns)
        else:
            self._monitor.window.passed(message.role, message.stamp_ns)

    def _spin(self, seconds: float) -> None:
        self._executor.spin_once(timeout_sec=max(0.0, min(seconds, SPIN_PERIOD_S)))
        if self._stop.is_set():
            raise Stopped

    def _wait_for_pipeline(self) -> bool:
        """Whether the four nodes are connected within `wait_s`."""
        wait_s = self._options.wait_s
        end_s = time.monotonic() + wait_s
        endpoints = {
            role: Endpoint(output.topic_name, output) for role, output in self._outputs.items()
        }
        missing = ["the four nodes"]
        while wait_s > 0 and time.monotonic() < end_s:
            missing = self._monitor.connections.missing(endpoints, time.monotonic())
            if not missing:
                return True
            if time.monotonic() - self._reported_s > 1.0:
                self._reported_s = time.monotonic()
                self._emit(events.Waiting(missing))
            self._spin(SPIN_PERIOD_S)
        if self._options.save:
            raise NotReady(
                f"after {wait_s:g} s still waiting for: {'; '.join(missing)}. Start the four nodes "
                "first, or raise wait_s; save:=true requires them"
            )
        if wait_s > 0:
            self.get_logger().warning(
                f"no pipeline after {wait_s:g} s (missing: {'; '.join(missing)}): replaying "
                "without waiting for results"
            )
        return False

    def _wait_for_listeners(self) -> None:
        """Wait until a subscriber has discovered the topics, at most LISTENER_WAIT_S."""
        end_s = time.monotonic() + LISTENER_WAIT_S
        while time.monotonic() < end_s and not self._has_listener():
            self._spin(SPIN_PERIOD_S)
        end_s = time.monotonic() + SETTLE_S
        while time.monotonic() < end_s:
            self._spin(SPIN_PERIOD_S)

    def _has_listener(self) -> bool:
        return any(output.get_subscription_count() for output in self._outputs.values())

    def _wait_until_due(self, message: RawRoleMessage, alone: bool) -> None:
        now_s = time.monotonic()
        due_s = self._pace.due_s(message.log_time_ns, now_s)
        while now_s < due_s:
            self._spin(due_s - now_s)
            now_s = time.monotonic()
        self._spin(0.0)
        # The other messages of a frame surround its RGB image, so only the image has to wait.
        while (
            message.role is Role.RGB
            and not alone
            and self._monitor.has_to_wait(STALL_S, time.monotonic())
        ):
            self._spin(SPIN_PERIOD_S)
            self._emit_progress()
        self._pace.late(time.monotonic() - now_s)

    def _drain(self) -> bool:
        """Wait until all frames are processed; False if no result comes for STALL_S."""
        while not self._monitor.drained(time.monotonic()):
            if self._monitor.silent_for(time.monotonic()) > STALL_S:
                self._monitor.window.give_up()
                return False
            self._spin(SPIN_PERIOD_S)
            self._emit_progress()
        return True

    def _save(self) -> None:
        future = self._monitor.request_save()
        end_s = time.monotonic() + STALL_S
        while not future.done() and time.monotonic() < end_s:
            self._spin(SPIN_PERIOD_S)
        if future.done():
            response = future.result()
            self._emit(events.Saved(response.success, response.message))
        else:
            self._emit(events.Saved(False, f"no response from graph_node for {STALL_S:g} s"))

    def _finish(self, drained: bool) -> None:
        window = self._monitor.window
        self._emit(
            events.Finished(
                published=self._published,
                processed=window.results,
                without_result=window.given_up,
                drained=drained,
                diagnostics=self._monitor.diagnostics,
                drops=dict(self._source.drops),
                losses=list(dict.fromkeys(self._source.losses)),
                poses=self._monitor.poses,
            )
        )
        self.get_logger().info(f"done: {counted(self._published, 'frame')} published")

    def _emit_progress(self, *, at_once: bool = False) -> None:
        now_s = time.monotonic()
        if at_once or now_s - self._reported_s > 0.2:
            self._reported_s = now_s
            monitor = self._monitor
            self._emit(events.Progress(self._published, monitor.window.results, monitor.nodes))

    def _emit(self, event: events.Event) -> None:
        if self._options.events:
            print(events.encode(event), flush=True)


def _open_recording(parameters: ReplayParameters) -> Source:
    options = parameters.node
    if not options.recording:
        raise ConfigurationError(
            "parameter recording is empty, expected the path of a bag or a data set folder: add "
            "-p recording:=PATH"
        )
    return open_source(
        Path(options.recording),
        topics=parse_topics(options.topics),
        inputs=parameters.inputs,
        options=DatasetOptions(intrinsics=parse_intrinsics(options.intrinsics)),
        need_poses=not options.odometry,
    )


def main(args: list[str] | None = None) -> int:
    """Run the node; 0 at the end or after a signal, 2 for unusable input, 3 without the nodes."""

    def body(stop: threading.Event) -> int:
        node = ReplayNode(stop)
        try:
            node.replay()
        except NotReady as error:
            return refuse(error, EXIT_NOT_READY)
        except Stopped:
            pass
        finally:
            node.close()
            node.destroy_node()
        return 0

    return run_process(body, args)


if __name__ == "__main__":
    sys.exit(main())
