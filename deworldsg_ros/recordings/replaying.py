"""The messages of a recording go out: when a replay is to publish each, and into a file."""

from __future__ import annotations

import shutil
import signal
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Union

import msgspec
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from deworldsg_ros.base.files import check_writable, together
from deworldsg_ros.recordings.source import COMPRESSED_IMAGE, IMAGE, RawRoleMessage, Role, typestore
from deworldsg_ros.scene.errors import RecordingError

# Asks a replay to publish no more, and to go on as after the last message.
STOP_EARLY = signal.SIGUSR1

# --- Events that a replay reports to the program that started it: one JSON line each, on stdout.


class Waiting(msgspec.Struct, tag=True, frozen=True):
    """The replay waits for the nodes: the missing ones, in words."""

    missing: list[str]


class Started(msgspec.Struct, tag=True, frozen=True):
    """All nodes are ready; `frames` RGB images will be published."""

    frames: int


class Progress(msgspec.Struct, tag=True, frozen=True):
    """Frames published and processed so far, and nodes in the graph."""

    published: int
    processed: int
    nodes: int


class Saved(msgspec.Struct, tag=True, frozen=True):
    """Reply of the graph node to the request to save its graph."""

    success: bool
    message: str


class Finished(msgspec.Struct, tag=True, frozen=True):
    """The end: counts, the /diagnostics of each node, drops and losses of the recording.

    `poses` are T_world_camera of the lifted frames, 16 values each, row by row.
    """

    published: int
    processed: int
    without_result: int
    drained: bool
    diagnostics: dict[str, dict[str, str]]
    drops: dict[str, int]
    losses: list[str]
    poses: list[list[float]]


Event = Union[Waiting, Started, Progress, Saved, Finished]


def encode(event: Event) -> str:
    """One line, without a line break."""
    return msgspec.json.encode(event).decode()


def decode(line: str) -> Event:
    """Event of a line; raises msgspec.MsgspecError for any other line."""
    return msgspec.json.decode(line, type=Event)


# --- Flow control of a replay: the time when a message is due, and the number of frames in
# flight.
#
# Nothing here sleeps or reads a clock; times are arguments.

# Frames that may be published before their poses or depth: half of the nodes' buffers (64 images).
MAX_UNDECIDED = 32


class Pace:
    """Converts times of recording to due times.

    Args:
        rate: replay speed: 1 = as recorded, 2 = twice as fast, 0 = without waiting.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._log_zero_ns: int | None = None
        self._zero_s = 0.0

    def due_s(self, log_time_ns: int, now_s: float) -> float:
        """Time when a message is due, seconds; the first is due now."""
        if self._rate <= 0:
            return now_s
        if self._log_zero_ns is None:
            self._log_zero_ns, self._zero_s = log_time_ns, now_s
        return self._zero_s + (log_time_ns - self._log_zero_ns) / 10**9 / self._rate

    def late(self, by_s: float) -> None:
        """Delay all later messages: after a pause the replay keeps its rate."""
        self._zero_s += by_s


class Window:
    """Frames in flight: published, without a result yet; at most `size` of them.

    The result of a frame also ends all frames before it, because the nodes process frames in
    order. A refused frame never has a result: `excuse` takes the number of refused frames, which
    may be reported before or after the result of a later frame.

    A frame can have a result once each stream that it needs has passed its stamp: its pose may have
    been recorded later. Until then it is undecided, and not in flight.

    Args:
        size: maximum number of frames in flight; 0 = no limit.
        needs: the streams that a frame needs.

    Attributes:
        results: number of results.
        given_up: number of frames whose result is no longer expected.
    """

    def __init__(self, size: int, needs: Collection[Role] = ()) -> None:
        self._size = size
        self._newest_ns = dict.fromkeys(needs, -1)
        self._undecided: deque[int] = deque()
        self._in_flight: deque[int] = deque()
        # Refused frames that no later result has ended yet. Negative: a result has ended frames
        # whose refusal is not reported yet.
        self._excused = 0
        self.results = 0
        self.given_up = 0

    @property
    def in_flight(self) -> int:
        """Number of frames that may still have a result."""
        return max(0, len(self._in_flight) - max(0, self._excused))

    @property
    def is_full(self) -> bool:
        """Whether the next frame must wait."""
        return self._size > 0 and self.in_flight >= self._size

    def publish(self, stamp_ns: int) -> None:
        """Note that a frame is published."""
        self._undecided.append(stamp_ns)
        self._decide()

    def passed(self, role: Role, stamp_ns: int) -> None:
        """Note that a message of another stream is published."""
        if role in self._newest_ns:
            self._newest_ns[role] = stamp_ns
            self._decide()

    def close(self) -> None:
        """Note the end of the recording: all undecided frames are now in flight."""
        self._in_flight += self._undecided
        self._undecided.clear()

    def add_result(self, stamp_ns: int) -> None:
        """Note the result of a frame, which ends the frames before it, too."""
        self.results += 1
        behind = 0
        for frames in (self._in_flight, self._undecided):
            while frames and frames[0] <= stamp_ns:
                frames.popleft()
                behind += 1
        self._excused -= max(0, behind - 1)
        self._settle()

    def excuse(self, number: int) -> None:
        """Note a number of refused frames: they will have no result."""
        self._excused += number
        self._settle()

    def give_up(self) -> None:
        """Stop waiting for the frames in flight."""
        self.given_up += self.in_flight
        self._in_flight.clear()
        self._settle()

    def _settle(self) -> None:
        # Refused messages that are no frames, and lost frames that no node reported, must not count
        # for later frames.
        if not self._in_flight and not self._undecided:
            self._excused = 0

    def _decide(self) -> None:
        passed_ns = min(self._newest_ns.values(), default=None)
        while self._undecided and (
            passed_ns is None
            or self._undecided[0] <= passed_ns
            or len(self._undecided) > MAX_UNDECIDED
        ):
            self._in_flight.append(self._undecided.popleft())


# --- One MCAP file, for rosbag2 and Foxglove.

# Foxglove and RViz expect the CameraInfo beside the image, and the transport as the last word.
TOPICS = {
    (Role.RGB, IMAGE): "/rgb/image_raw",
    (Role.RGB, COMPRESSED_IMAGE): "/rgb/image_raw/compressed",
    (Role.DEPTH, IMAGE): "/depth/image_raw",
    (Role.DEPTH, COMPRESSED_IMAGE): "/depth/image_raw/compressedDepth",
}
OTHER_TOPICS = {
    Role.CAMERA_INFO: "/rgb/camera_info",
    Role.POSE: "/camera/pose",
    Role.DETECTIONS: "/deworldsg/detections",
    Role.DETECTION_INSTANCES: "/deworldsg/detections/instances",
}
NO_LIMIT = QosTime(2**31 - 1, 10**9 - 1)


def topic_of(role: Role, msgtype: str) -> str:
    """Topic of the messages of a role and type."""
    if role in OTHER_TOPICS:
        return OTHER_TOPICS[role]
    return TOPICS[role, msgtype]


def write_mcap(messages: Iterable[RawRoleMessage], path: Path) -> int:
    """Write messages into one new MCAP file (profile ros2, with schemas); returns their number.

    The file appears when it is complete: a conversion that is interrupted leaves nothing.

    Raises:
        RecordingError: as `check_output`, or if there are no messages.
    """
    check_output(path)
    try:
        with together(path.parent, ()) as staged:
            count = _write(iter(messages), staged / "bag")
            if not count:
                raise RecordingError(
                    f"output {path}: the recording has no messages; expected at least one"
                )
            check_output(path)  # another one may have been written meanwhile
            (staged / "bag" / "bag.mcap").rename(staged / path.name)
            shutil.rmtree(staged / "bag")
    except OSError as error:
        raise RecordingError(f"output {path}: cannot be written ({error.strerror})") from error
    return count


def check_output(path: Path) -> None:
    """Raise RecordingError if the file cannot be created."""
    if path.suffix != ".mcap":
        raise RecordingError(f"output {path}: expected a file name that ends in .mcap")
    if path.exists():
        raise RecordingError(f"output {path} exists already: remove it or take another name")
    if not path.parent.is_dir():
        raise RecordingError(
            f"output {path}: the folder {path.parent} does not exist; create it first"
        )
    try:
        check_writable(path)
    except OSError as error:
        raise RecordingError(f"output {path}: cannot be written ({error.strerror})") from error


def _write(messages: Iterator[RawRoleMessage], bag: Path) -> int:
    connections: dict[tuple[Role, str], Connection] = {}
    count = 0
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for raw in messages:
            key = raw.role, raw.msgtype
            if key not in connections:
                connections[key] = writer.add_connection(
                    topic_of(*key),
                    raw.msgtype,
                    typestore=typestore(),
                    offered_qos_profiles=[_reliable()],
                )
            writer.write(connections[key], raw.log_time_ns, raw.data)
            count += 1
    return count


def _reliable() -> Qos:
    return Qos(
        QosHistory.KEEP_LAST,
        10,
        QosReliability.RELIABLE,
        QosDurability.VOLATILE,
        NO_LIMIT,
        NO_LIMIT,
        QosLiveliness.AUTOMATIC,
        NO_LIMIT,
        False,
    )
