"""replay_node: a bag or data set folder on the topics that the pipeline listens to.

Messages of a bag go out as they were recorded, byte for byte. Poses out of TF are computed, and
folders become messages, on the way. The node can wait for the pipeline, and run only so far ahead
of it that nothing is lost on a slow machine.
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

from deworldsg_ros.config import Config, load_config
from deworldsg_ros.nodes.replay_monitor import SETTLE_S, Endpoint, PipelineMonitor
from deworldsg_ros.nodes.replay_options import ReplayParameters
from deworldsg_ros.recordings import events, messages
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.folders.dataset import DatasetOptions, parse_intrinsics
from deworldsg_ros.recordings.messages import Role
from deworldsg_ros.recordings.pacing import Pace
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.source import RawRoleMessage
from deworldsg_ros.recordings.writer import topic_of
from deworldsg_ros.ros.parameters import declare
from deworldsg_ros.ros.process import refuse, run_process
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.scene.errors import ConfigurationError, DeWorldSGError

CLASSES = {
    messages.IMAGE: Image,
    messages.COMPRESSED_IMAGE: CompressedImage,
    messages.CAMERA_INFO: CameraInfo,
    messages.POSE_STAMPED: PoseStamped,
    messages.ODOMETRY: Odometry,
}
PUBLISHER_DEPTH = 10
TELL_PERIOD_S = 0.2
# The longest that a signal waits to be noticed.
SPIN_PERIOD_S = 0.1
EXIT_NOT_READY = 3


class NotReady(DeWorldSGError):
    """The pipeline did not come up."""


class Stopped(Exception):
    """A signal came."""


class ReplayNode(Node):  # type: ignore[misc]
    """Publishes a recording; `replay` runs it from beginning to end.

    Raises:
        ConfigurationError: for an unknown parameter, or without a recording.
        RecordingError: where the recording cannot be used.
    """

    def __init__(self, stop: threading.Event, **options: Any) -> None:
        super().__init__("replay_node", **options)
        self._stop = stop
        self._options = declare(self, ReplayParameters).node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._source = self._open()
        self._outputs = {
            role: self._publisher(role, topic.msgtype)
            for role, topic in self._source.topics.items()
            if role is not Role.POSE or not self._options.odometry
        }
        self._clock_output = (
            self.create_publisher(Clock, "/clock", 10) if self._options.clock else None
        )
        self._monitor = PipelineMonitor(self, self._options.window, odometry=self._options.odometry)
        self._pace = Pace(self._options.rate)
        self._published = 0
        self._told_s = 0.0

    def replay(self) -> None:
        """Wait, publish everything, wait until it is worked off; raises NotReady or Stopped."""
        alone = not self._wait_for_pipeline()
        if alone:
            self._wait_to_be_found()
        self._tell(events.Started(self._source.frame_count))
        for message in self._source.raw_messages():
            if message.role not in self._outputs:
                continue
            self._wait_until_due(message, alone)
            self._outputs[message.role].publish(message.data)
            if self._clock_output is not None:
                sec, nanosec = divmod(message.log_time_ns, 10**9)
                self._clock_output.publish(Clock(clock=Time(sec=sec, nanosec=nanosec)))
            if message.role is Role.RGB:
                self._published += 1
                self._monitor.window.publish(message.stamp_ns)
            else:
                self._monitor.window.passed(message.role, message.stamp_ns)
            self._tell_progress()
        self._monitor.window.close()
        drained = alone or self._drain()
        if self._options.save and not alone:
            self._save()
        self._tell_progress(at_once=True)
        self._finish(drained)

    def close(self) -> None:
        """Close the recording and the executor."""
        self._source.close()
        self._executor.shutdown(timeout_sec=1.0)

    def _open(self) -> Any:
        options = self._options
        if not options.recording:
            raise ConfigurationError(
                "parameter recording is empty: wanted -p recording:=BAG_OR_FOLDER"
            )
        config = load_config(options.config) if options.config else Config()
        return open_source(
            Path(options.recording),
            topics=TopicChoice(
                options.rgb_topic,
                options.depth_topic,
                options.camera_info_topic,
                options.pose_topic,
            ),
            inputs=config.inputs,
            options=DatasetOptions(options.frame_rate, parse_intrinsics(options.intrinsics)),
            need_poses=not options.odometry,
        )

    def _publisher(self, role: Role, msgtype: str) -> Any:
        # TF is replayed as the poses computed from it.
        kind = messages.POSE_STAMPED if msgtype == messages.TF_MESSAGE else msgtype
        topic = topic_of(role, kind).lstrip("/")
        return self.create_publisher(CLASSES[kind], topic, reliable(PUBLISHER_DEPTH))

    def _spin(self, seconds: float) -> None:
        self._executor.spin_once(timeout_sec=max(0.0, min(seconds, SPIN_PERIOD_S)))
        if self._stop.is_set():
            raise Stopped

    def _wait_for_pipeline(self) -> bool:
        """Whether the four nodes are there and connected."""
        wait_s = self._options.wait_s
        end_s = time.monotonic() + wait_s
        endpoints = {
            role: Endpoint(output.topic_name, output) for role, output in self._outputs.items()
        }
        missing: list[str] = ["the pipeline"]
        while wait_s > 0 and time.monotonic() < end_s:
            missing = self._monitor.missing(endpoints, time.monotonic())
            if not missing:
                return True
            if time.monotonic() - self._told_s > 1.0:
                self._told_s = time.monotonic()
                self._tell(events.Waiting(missing))
            self._spin(SPIN_PERIOD_S)
        if self._options.required:
            raise NotReady(f"after {wait_s:g} s still waiting for: {'; '.join(missing)}")
        if wait_s > 0:
            self.get_logger().warning(
                f"replaying at its own pace, after {wait_s:g} s without: {'; '.join(missing)}"
            )
        return False

    def _wait_to_be_found(self) -> None:
        """Give whoever listens the time to discover the topics."""
        end_s = time.monotonic() + self._options.listener_s
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
        # The messages of a frame come around its RGB image: it alone has to wait.
        while message.role is Role.RGB and not alone and self._monitor.window.is_full:
            self._monitor.give_up_after(self._options.stall_s, time.monotonic())
            self._spin(SPIN_PERIOD_S)
            self._tell_progress()
        self._pace.late(time.monotonic() - now_s)

    def _drain(self) -> bool:
        """Wait until all is worked off; False where nobody answers any more."""
        stall_s = self._options.stall_s
        while not self._monitor.drained(time.monotonic()):
            if self._monitor.silent_for(time.monotonic()) > stall_s:
                self._monitor.window.give_up()
                return False
            self._spin(SPIN_PERIOD_S)
            self._tell_progress()
        return True

    def _save(self) -> None:
        future = self._monitor.request_save()
        end_s = time.monotonic() + self._options.stall_s
        while not future.done() and time.monotonic() < end_s:
            self._spin(SPIN_PERIOD_S)
        if future.done():
            answer = future.result()
            self._tell(events.Saved(answer.success, answer.message))
        else:
            self._tell(events.Saved(False, "graph_node does not answer"))

    def _finish(self, drained: bool) -> None:
        window = self._monitor.window
        self._tell(
            events.Finished(
                published=self._published,
                answered=window.answered,
                unanswered=window.given_up,
                drained=drained,
                diagnostics=self._monitor.diagnostics,
                drops=dict(self._source.drops),
                losses=list(dict.fromkeys(self._source.losses)),
                poses=self._monitor.poses,
            )
        )
        self.get_logger().info(f"done: {self._published} frames published")

    def _tell_progress(self, *, at_once: bool = False) -> None:
        now_s = time.monotonic()
        if at_once or now_s - self._told_s > TELL_PERIOD_S:
            self._told_s = now_s
            monitor = self._monitor
            self._tell(events.Progress(self._published, monitor.window.answered, monitor.nodes))

    def _tell(self, event: events.Event) -> None:
        if self._options.events:
            print(events.encode(event), flush=True)


def main(args: list[str] | None = None) -> int:
    """Run the node; 0 at the end or after a signal, 2 for what cannot be used, 3 if not ready."""

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
