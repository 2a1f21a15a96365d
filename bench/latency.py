"""Time from the stamp of an image to its change on /scene_graph/updates, over DDS.

    python -m bench.latency [--seconds 60] [--rate 30] [--front-end embedded] [--one-process]
                            [--steps]

Starts the real node processes on this machine and publishes the shipped recording to them: raw
640x480 images at a fixed rate, forwards and backwards, with the present time as stamps. With the
front end `recorded`, segmentation_node returns the results that its perception gave before. With
`sent`, 20 boxes an image arrive as JSON at the time of the image, as from a detector elsewhere
(`perception.detector: topic`); those that are not objects stand for a detector that finds more.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import os
import pickle
import struct
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bench.figures import Figure, Setup
from bench.steps import Marker, mark_node, read_marks, step_lines, write_marks
from deworldsg_ros.cli.demo import LoggedProcess, end_all
from deworldsg_ros.cli.terminal import dds_environment
from deworldsg_ros.config import Config
from deworldsg_ros.nodes import keep_freed_memory
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.ros.health import DROPPED, LOST_PREFIX, UNMATCHED_PREFIX, counts_in
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.wire import messages as wire

RECORDING = Path(__file__).resolve().parents[1] / "bags" / "demo_room"
NODES = ("segmentation_node", "lifting_node", "relation_node", "graph_node")
START_LIMIT_S = 120.0
# The first seconds, in which nodes find each other and caches fill, are not measured.
WARM_UP_S = 3.0
SENT_BOXES = 20
# After the last image: longer than the latency of any frame.
DRAIN_S = 2.0
# A message of these streams that is lost is a frame that is lost.
LOST_FRAMES = {f"{LOST_PREFIX}{name}" for name in ("rgb", "frame_graph", "local_graph")}
# Drops of relation evidence in the graph: its frame is in the graph.
OF_EVIDENCE = {"evidence_overrun", "unknown_frame"}
USUAL_RATE_HZ = 30.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass
class Result:
    """One run.

    Attributes:
        latencies_ms: of the frames that reached the graph, from their stamp to their update.
        published: number of measured frames.
        updates_per_s: rate of updates while frames were published.
        diagnostics: last values of each node, by its name.
        cpu_ms: processor time of each process per published frame.
        steps: a line for each step between the stamp and the update, if asked for.
        uncounted: frames that never reached the graph and that no node counted, warm-up included.
    """

    latencies_ms: np.ndarray
    published: int
    updates_per_s: float
    diagnostics: dict[str, dict[str, str]]
    cpu_ms: dict[str, float]
    steps: list[str] = field(default_factory=list)
    uncounted: int = 0

    @property
    def lost(self) -> int:
        """Frames that never reached the graph."""
        return self.published - len(self.latencies_ms)

    @property
    def counted(self) -> int:
        """Frames that the nodes counted as dropped, warm-up included."""
        return counted_frames(self.diagnostics)

    def percentile_ms(self, percent: float) -> float:
        """Percentile of the latencies; infinite without any."""
        return (
            float(np.percentile(self.latencies_ms, percent)) if self.latencies_ms.size else np.inf
        )


def counted_frames(diagnostics: Mapping[str, Mapping[str, str]]) -> int:
    """Frames that the nodes counted as dropped.

    A lost depth image, pose or camera_info is no frame: the frame that misses it is counted. An
    image is lost in the first node; without evidence, a frame is in the graph.
    """
    return sum(
        count
        for name, values in diagnostics.items()
        if name != "relation_node"
        for reason, count in counts_in(values, DROPPED).items()
        if reason not in OF_EVIDENCE
        and (not reason.startswith((UNMATCHED_PREFIX, LOST_PREFIX)) or reason in LOST_FRAMES)
    )


class RecordedPerceiver:
    """Returns what perception gave for an image before; knows images by their pixels."""

    def __init__(self, perceived: dict[int, Perceived]) -> None:
        self._perceived = perceived

    def watch(self, wrap: Any) -> None:
        """There is no model to watch."""

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The results of the image, with the stamp of this frame."""
        known = self._perceived[fingerprint(frame.rgb)]
        graph = replace(known.frame_graph, stamp_ns=frame.stamp_ns)
        return replace(known, frame_graph=graph)


def fingerprint(rgb: np.ndarray) -> int:
    """A number that differs between images of a recording."""
    return zlib.crc32(np.ascontiguousarray(rgb[::16]))


class Camera:
    """Publishes frames with new stamps, as serialized messages."""

    def __init__(self, node: Any, frames: Sequence[RgbdFrame], *, sends: bool = False) -> None:
        from geometry_msgs.msg import PoseStamped
        from rclpy.serialization import serialize_message
        from sensor_msgs.msg import CameraInfo, Image
        from std_msgs.msg import String

        from deworldsg_ros.nodes.odometry_node import put_pose
        from deworldsg_ros.ros.qos import reliable
        from deworldsg_ros.streams.images import fill_image

        kinds = {
            "camera/pose": PoseStamped,
            "rgb/camera_info": CameraInfo,
            "depth/image_raw": Image,
            "rgb/image_raw": Image,
        }
        self._outputs = [
            node.create_publisher(kind, topic, reliable(10)) for topic, kind in kinds.items()
        ]
        self._frames: list[list[bytes]] = []
        for frame in frames:
            pose, info, depth, rgb = (kind() for kind in kinds.values())
            put_pose(frame.T_world_camera, pose.pose.position, pose.pose.orientation)
            pose.header.frame_id = frame.frame_id
            k = frame.intrinsics
            info.width, info.height = k.width, k.height
            info.k = [k.fx, 0.0, k.cx, 0.0, k.fy, k.cy, 0.0, 0.0, 1.0]
            for message in (info, depth, rgb):
                message.header.frame_id = "camera"
            fill_image(depth, np.round(1e3 * frame.depth_m).astype(np.uint16), "16UC1")
            fill_image(rgb, np.ascontiguousarray(frame.rgb), "rgb8")
            self._frames.append([serialize_message(item) for item in (pose, info, depth, rgb)])
        self._sent = boxes_of(frames) if sends else []
        self._text = String
        if sends:
            topic = "deworldsg/detections"
            self._detections = node.create_publisher(String, topic, reliable(10))

    @property
    def listeners(self) -> int:
        """The smallest number of subscribers of depth and RGB."""
        return min(output.get_subscription_count() for output in self._outputs)

    def publish(self, number: int, stamp_ns: int) -> None:
        """Publish a frame; numbers beyond the end go back and forth."""
        period = 2 * len(self._frames) - 2
        at = number % period
        # After the CDR header of four bytes, each message begins with its stamp.
        stamp = struct.pack("<iI", *divmod(stamp_ns, 10**9))
        for output, data in zip(self._outputs, self._frames[min(at, period - at)]):
            output.publish(data[:4] + stamp + data[12:])
        if self._sent:
            message = self._sent[min(at, period - at)]
            message.stamp = wire.stamp_from_ns(stamp_ns)
            self._detections.publish(self._text(data=wire.encode(message)))


def boxes_of(frames: Sequence[RgbdFrame]) -> list[wire.DetectionsMessage]:
    """The `SENT_BOXES` best boxes of each frame, with names and scores above the threshold."""
    perception = build_perception(msgspec.structs.replace(Config().perception, score_threshold=0.0))
    messages = []
    for frame in frames:
        found = perception.detect(perception.turn_upright(frame).upright).take(slice(SENT_BOXES))
        best = found.class_probabilities.argmax(axis=1)
        items = [
            wire.SentDetection(
                box, [wire.NameScore(perception.vocabulary.classes[label], max(0.5, score))]
            )
            for box, label, score in zip(found.boxes_xyxy.tolist(), best, found.scores.tolist())
        ]
        head = wire.schema_of(wire.DetectionsMessage), wire.Stamp(0, 0), "camera"
        fields = dict(zip(("schema", "stamp", "frame_id"), head))
        messages.append(wire.DetectionsMessage(**fields, detections=items))
    return messages


class Listener:
    """Notes when each message arrives; it is decoded after the run."""

    def __init__(self, node: Any) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from std_msgs.msg import String

        from deworldsg_ros.ros.qos import reliable

        self.updates: list[tuple[int, str]] = []
        self.diagnostics: dict[str, dict[str, str]] = {}
        node.create_subscription(
            String,
            "/scene_graph/updates",
            lambda message: self.updates.append((time.time_ns(), message.data)),
            reliable(1000),
        )
        node.create_subscription(DiagnosticArray, "/diagnostics", self._note, 100)

    def _note(self, message: Any) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            self.diagnostics[status.name.split(":")[0]] = values

    def arrived_ns(self, stamps_ns: Sequence[int]) -> dict[int, int]:
        """When the update of each of these frames arrived, by its stamp."""
        arrived: dict[int, int] = {}
        for at_ns, text in self.updates:
            update = wire.decode(text, wire.SceneGraphUpdateMessage)
            for item in update.associations:
                arrived.setdefault(wire.ns_from_stamp(item.stamp), at_ns)
        return {stamp_ns: arrived[stamp_ns] for stamp_ns in stamps_ns if stamp_ns in arrived}


def record(frames: Sequence[RgbdFrame], path: Path) -> None:
    """Write what perception gives for frames, for `RecordedPerceiver`."""
    perception = build_perception(Config().perception)
    perceived = {fingerprint(frame.rgb): perception.perceive(frame) for frame in frames}
    path.write_bytes(pickle.dumps(perceived))


def run_node(name: str, recorded: str, marks: str, *arguments: str) -> int:
    """In the process of a node: run it, with recorded perception and marks of its steps if given.

    Args:
        name: of the node.
        recorded: file of `record`; "" = the perception of the node.
        marks: file for the marks of the steps; "" = none.
        arguments: of the node.
    """
    module = importlib.import_module(f"deworldsg_ros.nodes.{name}")
    if recorded:
        from deworldsg_ros.ros import models

        perceived = pickle.loads(Path(recorded).read_bytes())
        models.build_perception = lambda *_, **__: RecordedPerceiver(perceived)
    marker = Marker()
    if marks:
        mark_node(marker)
    code = module.main([name, *arguments])
    if marks:
        write_marks(marker, Path(marks))
    return int(code)


@contextmanager
def _running(
    nodes: Sequence[str],
    recorded: Path | None,
    folder: Path,
    steps: bool,
    arguments: Sequence[str] = (),
) -> Iterator[list[LoggedProcess]]:
    """The processes of the nodes, once all are ready."""
    processes: list[LoggedProcess] = []
    root = str(Path(__file__).resolve().parents[1])
    paths = [root, str(Path(root) / "test"), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    try:
        for name in nodes:
            command = [sys.executable, "-m", f"deworldsg_ros.nodes.{name}", *arguments]
            perceives = name in ("segmentation_node", "deworldsg_node")
            if steps or (recorded and perceives):
                replayed = str(recorded) if recorded and perceives else ""
                marks = str(folder / f"{name}.marks") if steps else ""
                command = [sys.executable, "-m", "bench.latency", "--node", name, replayed, marks]
                command += arguments
            log = folder / f"{name}.log"
            processes.append(LoggedProcess(name, command, environment, log))
        end_s = time.monotonic() + START_LIMIT_S
        while not all("ready" in process.log.read_text() for process in processes):
            ended = [process for process in processes if process.exit_code is not None]
            if ended or time.monotonic() > end_s:
                failed = (ended or processes)[0]
                raise RuntimeError(f"{failed.name} did not start:\n{failed.last_lines()}")
            time.sleep(0.1)
        yield processes
    finally:
        end_all(processes)


def _cpu_s(process: LoggedProcess) -> float:
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def _play(camera: Camera, rate_hz: float, seconds: float, first: int = 0) -> list[int]:
    """Publish frames at a rate; returns their stamps."""
    stamps_ns = []
    start_s = time.monotonic()
    for number in range(round(rate_hz * seconds)):
        due_s = start_s + number / rate_hz
        while (wait_s := due_s - time.monotonic()) > 0:
            time.sleep(wait_s)
        stamps_ns.append(time.time_ns())
        # The camera moves as fast at each rate.
        camera.publish(int((first + number) * USUAL_RATE_HZ / rate_hz), stamps_ns[-1])
    return stamps_ns


def measure(
    seconds: float = 60.0,
    rate_hz: float = 30.0,
    *,
    front_end: str = "recorded",
    one_process: bool = False,
    steps: bool = False,
    max_frames: int | None = None,
) -> Result:
    """Run the nodes for some seconds.

    Args:
        seconds: of measured frames, after `WARM_UP_S` of others.
        rate_hz: of the camera.
        front_end: recorded, embedded or sent.
        one_process: deworldsg_node in place of the four nodes.
        steps: also measure each step between the stamp and the update.
        max_frames: distinct frames of the recording; None = all.
    """
    os.environ.update(dds_environment())
    keep_freed_memory()
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    frames = list(itertools.islice(open_recording(RECORDING).frames(), max_frames))
    nodes = ("deworldsg_node",) if one_process else NODES
    context = rclpy.Context()
    with tempfile.TemporaryDirectory() as folder:
        recorded = Path(folder) / "perceived.pickle" if front_end == "recorded" else None
        if recorded is not None:
            record(frames, recorded)
        rclpy.init(context=context)
        node = rclpy.create_node("latency_bench", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        camera = Camera(node, frames, sends=front_end == "sent")
        listener = Listener(node)
        arguments = (
            ["--ros-args", "-p", "perception.detector:=topic"] if front_end == "sent" else []
        )
        stop = threading.Event()

        def spin() -> None:
            while not stop.is_set():
                executor.spin_once(timeout_sec=0.1)

        thread = threading.Thread(target=spin)
        try:
            with _running(nodes, recorded, Path(folder), steps, arguments) as processes:
                thread.start()
                _wait_for_listeners(camera, 1 if one_process else 2)
                warm = _play(camera, rate_hz, WARM_UP_S)
                before_s = {process.name: _cpu_s(process) for process in processes}
                stamps_ns = _play(camera, rate_hz, seconds, first=len(warm))
                cpu_s = {
                    process.name: _cpu_s(process) - before_s[process.name] for process in processes
                }
                time.sleep(DRAIN_S)
        finally:
            stop.set()
            if thread.ident is not None:
                thread.join()
            executor.shutdown(timeout_sec=1.0)
            node.destroy_node()
            rclpy.try_shutdown(context=context)
        marks = read_marks(Path(folder))
    everything = [*warm, *stamps_ns]
    lost = len(everything) - len(listener.arrived_ns(everything))
    arrived_ns = listener.arrived_ns(stamps_ns)
    in_time = sum(stamps_ns[0] <= at_ns <= stamps_ns[-1] for at_ns, _ in listener.updates)
    return Result(
        latencies_ms=1e-6 * np.array([at_ns - s for s, at_ns in arrived_ns.items()], float),
        published=len(stamps_ns),
        updates_per_s=in_time / seconds,
        diagnostics=listener.diagnostics,
        cpu_ms={name: 1e3 * value / len(stamps_ns) for name, value in cpu_s.items()},
        steps=step_lines(marks, arrived_ns) if steps else [],
        uncounted=lost - counted_frames(listener.diagnostics),
    )


def _wait_for_listeners(camera: Camera, number: int) -> None:
    end_s = time.monotonic() + 20.0
    while camera.listeners < number and time.monotonic() < end_s:
        time.sleep(0.1)
    time.sleep(1.0)


def figures(setup: Setup) -> list[Figure]:
    """Latency and losses of the four nodes and of the one process."""
    found: list[Figure] = []
    cases = (
        ("recorded", False, 25.0, 60.0),
        ("sent", False, 50.0, None),
        ("embedded", False, 90.0, None),
        ("embedded", True, None, None),
    )
    for front_end, one_process, p50_ms, p95_ms in cases:
        # The targets are those of four processes; a minute is asked of recorded detections.
        seconds = 5.0 if setup.quick else 60.0 if front_end == "recorded" else 30.0
        result = measure(seconds, front_end=front_end, one_process=one_process)
        name = f"latency_{front_end}_{'one_process' if one_process else 'four_processes'}"
        note = f"stamp of an image to its update, 30 Hz, {seconds:g} s, raw images over DDS"
        found += [
            Figure(f"{name}_p50", result.percentile_ms(50), "ms", target=p50_ms, note=note),
            Figure(f"{name}_p95", result.percentile_ms(95), "ms", target=p95_ms, note=note),
            Figure(
                f"{name}_updates",
                result.updates_per_s,
                "updates/s",
                target=25.0,
                more_is_better=True,
                note=f"{len(result.latencies_ms) / seconds:.1f} frames/s are in the graph; the "
                "other updates bring edges",
            ),
            Figure(
                f"{name}_lost",
                result.lost,
                "frames",
                target=0 if front_end == "recorded" else None,
                note=f"of {result.published}; the nodes counted {result.counted} drops",
            ),
        ]
    return found


def show(result: Result) -> None:
    """Print a result."""
    percentiles = ", ".join(f"p{p} {result.percentile_ms(p):.1f}" for p in (5, 50, 95, 99, 100))
    print(f"latency ms: {percentiles}")
    print(f"frames {result.published}, lost {result.lost}, uncounted {result.uncounted}")
    print(f"updates per second {result.updates_per_s:.1f}")
    print("processor ms per frame:", {k: round(v, 1) for k, v in result.cpu_ms.items()})
    print(*result.steps, sep="\n")
    for name, values in sorted(result.diagnostics.items()):
        chosen = {
            key: value
            for key, value in values.items()
            if key.startswith(("dropped", "latency", "lost", "total"))
        }
        print(f"  {name}: {chosen}")


def main() -> None:
    if sys.argv[1:2] == ["--node"]:
        sys.exit(run_node(*sys.argv[2:]))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=30.0, help="of the camera, Hz")
    parser.add_argument("--front-end", choices=("recorded", "embedded", "sent"), default="recorded")
    parser.add_argument("--one-process", action="store_true", help="deworldsg_node")
    parser.add_argument("--steps", action="store_true", help="also each step in between")
    options = parser.parse_args()
    show(
        measure(
            options.seconds,
            options.rate,
            front_end=options.front_end,
            one_process=options.one_process,
            steps=options.steps,
        )
    )


if __name__ == "__main__":
    main()
