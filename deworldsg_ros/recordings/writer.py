"""Write the messages of a recording to one MCAP file, for rosbag2 and Foxglove."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

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
