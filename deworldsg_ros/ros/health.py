"""The state of a node for /diagnostics: rates, latencies, drops by reason, and their remedies."""

from __future__ import annotations

import re
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from deworldsg_ros.doctor import Observations

# --- The state of a node for /diagnostics: rates, latencies, drops by reason, missing inputs.

OK, WARN, ERROR = 0, 1, 2

# The reason of an unexpected exception.
INTERNAL_ERROR = "internal_error"
# Reasons with this prefix raise no warning: one camera stream is faster than the other, or than the
# node.
UNMATCHED_PREFIX = "unmatched_"
# Reasons with this prefix count messages that the node never had.
LOST_PREFIX = "lost_"
DROPPED, LEFT_OUT, RECEIVED = "dropped ", "objects left out ", "received "
# Connected subscriptions of a topic that the node publishes.
LISTENERS = "listeners of "
# Nodes of the graph that are not published.
HIDDEN = "hidden, "
# /diagnostics is shared with other programs. A count of a node has no more digits than 64 bits.
COUNT = re.compile(r"[0-9]{1,18}")
TOTAL = re.compile(r"(?<![0-9-])([0-9]{1,18}) in total")


@dataclass(frozen=True)
class Report:
    """One status of /diagnostics.

    Attributes:
        level: OK, WARN or ERROR.
        message: one sentence.
        values: all values, by name.
    """

    level: int
    message: str
    values: dict[str, str]


class Health:
    """Counts between two reports, and since the start; safe to use from several threads.

    Args:
        product: output of the node in the message, e.g. "frame graphs".
    """

    def __init__(self, product: str) -> None:
        self._product = product
        self._lock = threading.Lock()
        self._reported_s: float | None = None
        self._received: Counter[str] = Counter()
        self._received_before: Counter[str] = Counter()
        self._published = 0
        self._published_before = 0
        self._latencies_ms: list[float] = []
        self._drops: Counter[str] = Counter()
        self._drops_before: Counter[str] = Counter()
        self._left_out: Counter[str] = Counter()
        self._examples: dict[str, str] = {}

    def received(self, topic: str) -> None:
        """Count a message."""
        with self._lock:
            self._received[topic] += 1

    def published(self, latency_s: float | None = None) -> None:
        """Count a product, and the time since its inputs were complete."""
        with self._lock:
            self._published += 1
            if latency_s is not None:
                self._latencies_ms.append(1e3 * latency_s)

    def dropped(self, reason: str, number: int = 1, example: str = "") -> None:
        """Count a drop; the report contains the newest example of each reason."""
        with self._lock:
            self._drops[reason] += number
            if example:
                self._examples[reason] = example.splitlines()[0]

    def left_out(self, reasons: Mapping[str, int]) -> None:
        """Count objects that a processed frame lacks; they raise no warning."""
        with self._lock:
            self._left_out.update(reasons)

    @property
    def drops(self) -> dict[str, int]:
        """Number of drops since the start, by reason."""
        with self._lock:
            return dict(self._drops)

    @property
    def products(self) -> int:
        """Number of products since the start."""
        with self._lock:
            return self._published

    def report(
        self,
        now_s: float,
        waiting_for: Sequence[str] = (),
        values: Mapping[str, str] | None = None,
        *,
        in_turn: bool = True,
    ) -> Report:
        """Summarise the time since the last report.

        Args:
            now_s: monotonic clock, seconds.
            waiting_for: missing inputs, in words.
            values: further values, by name.
            in_turn: False: the next report counts from the same time on as this one.
        """
        with self._lock:
            elapsed_s = max(now_s - self._reported_s, 1e-9) if self._reported_s is not None else 0.0
            rate = _rate(self._published - self._published_before, elapsed_s)
            drops = {
                reason: count
                for reason, count in sorted((self._drops - self._drops_before).items())
                if not reason.startswith(UNMATCHED_PREFIX)
            }
            counted = self._counted(rate, elapsed_s)
            message = "; ".join(waiting_for) or f"{rate:.1f} {self._product} per second"
            for reason, count in drops.items():
                example = self._examples.get(reason, "no example")
                message += f"; dropped {count} {reason}: {example}"
            if in_turn:
                self._begin_period(now_s)
        missing = {f"waiting for {at}": text for at, text in enumerate(waiting_for, 1)}
        level = WARN if waiting_for or drops else OK
        return Report(
            ERROR if INTERNAL_ERROR in drops else level,
            message,
            {**counted, **missing, **(values or {})},
        )

    def _counted(self, rate: float, elapsed_s: float) -> dict[str, str]:
        values = {f"{self._product} per second": f"{rate:.1f}", "total": str(self._published)}
        for topic, count in sorted(self._received.items()):
            received = _rate(count - self._received_before[topic], elapsed_s)
            values[f"{RECEIVED}{topic}"] = f"{received:.1f} per second, {count} in total"
        if self._latencies_ms:
            values["latency mean ms"] = f"{np.mean(self._latencies_ms):.1f}"
            values["latency p95 ms"] = f"{np.percentile(self._latencies_ms, 95):.1f}"
        for reason, count in sorted(self._drops.items()):
            values[f"{DROPPED}{reason}"] = str(count)
            if reason in self._examples:
                values[f"example {reason}"] = self._examples[reason]
        for reason, count in sorted(self._left_out.items()):
            values[f"{LEFT_OUT}{reason}"] = str(count)
        return values

    def _begin_period(self, now_s: float) -> None:
        self._reported_s = now_s
        self._latencies_ms = []
        self._received_before = self._received.copy()
        self._published_before = self._published
        self._drops_before = self._drops.copy()


def counts_in(values: Mapping[str, str], prefix: str) -> dict[str, int]:
    """Counts by reason in a report's values; `prefix` is DROPPED, LEFT_OUT or HIDDEN.

    A value that is no count is left out.
    """
    return {
        key[len(prefix) :]: int(value)
        for key, value in values.items()
        if key.startswith(prefix) and COUNT.fullmatch(value)
    }


def count_in(values: Mapping[str, str], key: str) -> int:
    """A count in a report's values; 0 if it is not there, or no count."""
    value = values.get(key, "")
    return int(value) if COUNT.fullmatch(value) else 0


def received_in(values: Mapping[str, str], topic: str) -> int:
    """Number of messages received on a topic since the start, in a report's values."""
    match = TOTAL.search(values.get(f"{RECEIVED}{topic}", ""))
    return int(match[1]) if match else 0


def _rate(count: int, elapsed_s: float) -> float:
    return count / elapsed_s if elapsed_s else 0.0


# --- The reasons of refused input and dropped frames in /diagnostics: the cause, and the remedy.

REASONS: dict[str, str] = {
    # Images
    "unknown_encoding": "The encoding of an image is not supported. Convert it to one that the log "
    "line lists; for compressed depth publish PNG.",
    "empty_image": "An image has no pixels. Check the camera driver.",
    "bad_step": "The row length (step) of an image does not fit its width and encoding. Check the "
    "camera driver.",
    "short_buffer": "An image contains fewer bytes than its size requires. Check the camera "
    "driver.",
    "decode_failed": "A compressed image is damaged, or is neither JPEG nor PNG. Check the camera "
    "driver and the network.",
    "not_depth": "The depth topic carries pictures: colour images, or depth drawn for people. Name "
    "the topic of the depth images, with 16UC1 or 32FC1, also as compressedDepth.",
    "grid_mismatch": "RGB, depth and camera_info differ in size. Publish depth that is registered "
    "to RGB.",
    "invalid_intrinsics": "camera_info contains zeros, NaN or absurd values. Calibrate the camera.",
    "invalid_frame_id": "A frame_id contains control characters or more than 256 characters. "
    "Correct it in the node that publishes it.",
    # Poses
    "invalid_pose": "A pose contains NaN or infinity, its quaternion is not of length 1, or it is "
    "more than 10 km from the origin. Check the source of the poses; publish them in a frame that "
    "begins near the robot.",
    "invalid_region": "The parameter center of region_node cannot be read; the region stays as it "
    "was. Write X,Y,Z in metres.",
    "invalid_request": "A request to a service cannot be fulfilled, and "
    "changed nothing. Its answer says why.",
    "wrong_frame": "The frame_id of a pose or local graph differs from the world frame of this "
    "session. Publish all of them in one world frame, and set `inputs.world_frame` to it.",
    "pose_jump": "The camera moved more than 1 m between two frames, or rotated faster than 360 "
    "degrees per second, and its depth does not show the same surfaces from there. Check the "
    "poses; a new position is accepted after five consistent frames.",
    "no_pose": "No pose is within `inputs.pose_slop_s` of the image. Check the rate and the clock "
    "of the poses.",
    "no_transform": "The odometry describes another frame than the camera's, and TF does not "
    "connect the two. Publish that transform; if the poses are the camera's, set "
    "`inputs.pose_source` to odometry.",
    "too_many_frames": "TF has more than 1000 frames, and the new ones are ignored. Look for a "
    "node that gives its frames ever new names.",
    "odometry_lost": "The odometry could not align a frame. The frame gets no pose. Move the "
    "camera more slowly, and keep it unobstructed.",
    # Models
    "detector_error": "The detector failed on an image. The image gives no frame graph. Read the "
    "traceback in the log; if memory is short, choose a smaller checkpoint or another device.",
    "segmenter_error": "The segmenter failed on an image. Its frame graph is empty. Read the "
    "traceback in the log; if memory is short, choose a smaller checkpoint or another device.",
    "relation_head_error": "The relation head failed on an image. Its frame graph has no "
    "relations. Read the traceback in the log; if memory is short, choose a smaller checkpoint or "
    "another device.",
    "embedder_error": "The embedder failed on an image. Its objects get no embeddings. Read the "
    "traceback in the log; if memory is short, choose a smaller checkpoint or another device.",
    "world_model_error": "The world model failed on a clip. The clip gives no prediction. Read the "
    "message in the log; if memory is short, choose another device.",
    "nan_features": "The world model computed NaN or infinity for a clip. The clip gives no "
    "prediction. Run it on the CPU (`perception.device: cpu`), and report it with "
    "`deworldsg models inspect`.",
    "embedding_model_mismatch": "A frame has embeddings of another model than the graph. It is "
    "merged without them. Use one model, or begin a new graph (the service `clear`).",
    # Files
    "map_not_written": "A checkpoint of the map could not be written; the file holds the one "
    "before. It is tried again every 10 s. Make room on the disk, or take another `map_path`.",
    "ids_not_reserved": "`FILE.ids`, beside the map, could not be written. After a kill, ids that "
    "were published may be given to other nodes. Make room on the disk.",
    "no_ids_left": "The graph has given out two billion ids. Clear it.",
    "other_session": "Two nodes publish a graph on the same topics, or a request names the session "
    "of a graph that is no more. End one of the two nodes, or give it a namespace; read the graph "
    "again.",
    # Joining
    "no_depth": "No depth image is within `inputs.slop_s` of the RGB image. Check the rate and "
    "the stamps of the depth images.",
    "no_camera_info": "No valid camera_info arrived within five seconds of the image. Publish it "
    "on `rgb/camera_info`.",
    "no_instances": "A frame graph arrived without its instance image. Use `config/fastdds.xml` "
    "in every process.",
    "no_detections": "The detector that sends `deworldsg/detections` has sent none with the stamp "
    "of this image. This is harmless if it is slower than the camera.",
    "no_detection_instances": "The detections of this image came without their instance image.",
    "no_rgb": "A local graph arrived without its RGB image. Use `config/fastdds.xml` in every "
    "process.",
    "stale": "A message is not newer than the last one on its topic. Look for a second publisher.",
    "time_jump": "Stamps jumped back by more than a second, or forward by more than a minute "
    "(odometry_node: a second). A jump of one message costs this message. If the next message "
    "confirms it, the node continues at the new time: a recording was restarted, or a clock was "
    "set.",
    "busy": "Eight service calls wait for their answers, or the graph has more work than it can "
    "do. A further call is refused at once; it may be tried again.",
    "overrun": "Frames arrive faster than a node processes them. It dropped the oldest in its "
    "queue. Lower the camera's frame rate, or choose a faster model.",
    "evidence_overrun": "As `overrun`, for relation evidence. The graph has its frame without it.",
    "lost_rgb": "RGB images were overwritten by newer ones before the node took them, or lost on "
    "the way. If the node is as fast as the camera, use `config/fastdds.xml` in every process.",
    "lost_depth": "As `lost_rgb`, for depth images.",
    "lost_instances": "As `lost_rgb`, for instance images.",
    "lost_detections": "As `lost_rgb`, for detections.",
    "lost_detection_instances": "As `lost_rgb`, for instance images of detections.",
    "lost_camera_info": "As `lost_rgb`, for camera_info.",
    "lost_pose": "As `lost_rgb`, for poses.",
    "lost_frame_graph": "As `lost_rgb`, for frame graphs.",
    "lost_local_graph": "As `lost_rgb`, for local graphs.",
    "lost_relation_evidence": "As `lost_rgb`, for relation evidence.",
    "lost_updates": "As `lost_rgb`, for updates of the graph. The next snapshot replaces them.",
    "unmatched_rgb": "An RGB image belongs to no local graph, because its frame was dropped "
    "before. See the other reasons.",
    "unmatched_depth": "A depth image belongs to no RGB image or frame graph. This is harmless if "
    "depth has the higher rate.",
    "unmatched_instances": "An instance image arrived without its frame graph. Use "
    "`config/fastdds.xml` in every process.",
    "unmatched_detections": "Detections belong to no RGB image. Give them the stamp of the image; "
    "if the node is busy, it takes fewer images than the detector.",
    "unmatched_detection_instances": "As `unmatched_detections`, for instance images.",
    "unmatched_local_graph": "Too many local graphs waited for their images, and the oldest was "
    "dropped. Use `config/fastdds.xml` in every process.",
    "unmatched_frame_graph": "Too many frame graphs waited for depth or pose, and the oldest was "
    "dropped. Check the rates of depth and pose.",
    "unmatched_evidence": "The local graph of relation evidence did not arrive. See the reasons of "
    "lifting_node.",
    # Messages between the nodes
    "invalid_message": "A JSON message does not fit its schema. The log line names the field; run "
    "all nodes in one version.",
    "invalid_robot": "A robot of the fleet has a name that is none. Look for another program with "
    "keys of `deworldsg/robots` on the Zenoh network.",
    "too_many_robots": "256 robots are in the fleet, and a new one is ignored. Look for a robot "
    "that has several names at once.",
    "same_name": "Two robots of the fleet have one name, or two fleet_nodes answer; the first one "
    "is followed. Give each fleet_link_node another `robot`, and run one fleet_node.",
    "message_too_large": "A JSON message is larger than 16 MiB, or 256 MiB for the global graph, "
    "or 64 MiB for that of a robot of a fleet. "
    "Look for a second publisher on its topic.",
    "invalid_stamp": "The stamp of a message is negative. Check the clock of its publisher.",
    "unknown_schema": "A JSON message has another schema, or a later version of it. Run all nodes "
    "in one version.",
    "unknown_instance": "The instance image contains an id without an object in the frame graph. "
    "Run one segmentation_node only.",
    "vocabulary_mismatch": "A message has other predicates than the graph. Run all nodes with one "
    "configuration.",
    "over_max_names": "The detector of `deworldsg/detections` has used more than 2048 names. Let "
    "it name classes, not instances.",
    "too_many_names": "The detector has brought more than 8192 names of classes. Let it name "
    "classes, not instances.",
    "out_of_order": "A local graph is up to a second older than one that is already merged. Look "
    "for a second lifting_node.",
    "no_graph": "A pose correction arrived before the first local graph, and is ignored. Nothing "
    "has to be done.",
    "invalid_trajectory": "The poses of a trajectory have no ascending stamps of their own. "
    "Publish a stamp with each pose; of RTAB-Map, use its `mapGraph` and not its `mapPath`.",
    "unknown_frame": "The graph no longer remembers the frame of relation evidence. Choose a "
    "faster world model or device.",
    "invalid_prediction": "The prediction of a world model is not a probability distribution. "
    "Check its probe.",
    # The program
    "internal_error": "An unexpected exception occurred, and the node continued. Report the "
    "traceback in the log.",
}


# --- The statuses in /diagnostics of all nodes as observations for the doctor.

EXAMPLE, WAITING = "example ", "waiting for "
TURNED = re.compile(r"frames turned by ([0-9]{1,3})\b.*")


def observations_of(
    statuses: Mapping[str, Mapping[str, str]], classes: tuple[str, ...] = ()
) -> Observations:
    """Observations from the values of each node's newest status, by the node's name.

    Args:
        statuses: values by name, of each node.
        classes: classes that the detector knows, if they are known.
    """
    from deworldsg_ros.doctor import Observations  # it reads images: slow to import for a node

    drops: Counter[str] = Counter()
    examples: dict[str, str] = {}
    turns: Counter[int] = Counter()
    missing: list[str] = []
    hidden: Counter[str] = Counter()
    for values in statuses.values():
        drops.update(counts_in(values, DROPPED))
        hidden.update(counts_in(values, HIDDEN))
        for key, value in values.items():
            if key.startswith(EXAMPLE):
                examples[key[len(EXAMPLE) :]] = value
            elif key.startswith(WAITING):
                missing.append(value)
            elif turned := TURNED.fullmatch(key):
                turns[int(turned[1]) // 90] += count_in(values, key)
    nodes = [int(of["nodes"]) for of in statuses.values() if COUNT.fullmatch(of.get("nodes", ""))]
    images = [received_in(values, "rgb") for values in statuses.values()]
    return Observations(
        images=max(images, default=0) or None,
        frames=max(images, default=0) or None,
        nodes=max(nodes, default=None),
        drops=drops,
        hidden=hidden,
        examples=examples,
        remedies=REASONS,
        classes=classes,
        turns=turns,
        missing=tuple(dict.fromkeys(missing)),
        found_nodes=bool(statuses),
    )


def listened(statuses: Mapping[str, Mapping[str, str]]) -> list[tuple[str, str, bool]]:
    """Topic, type and reliability of each subscription that nodes report."""
    pattern = re.compile(r"(\S+) \[(\S+)\] (reliable|best effort)")
    matches = [
        match
        for values in statuses.values()
        for key, value in values.items()
        if key.startswith("listening to ") and (match := pattern.fullmatch(value))
    ]
    return list(dict.fromkeys((m[1], m[2], m[3] == "reliable") for m in matches))
