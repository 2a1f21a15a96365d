"""Rendered rooms: the layout of ReplicaSSG with instance images, recorded detections, gt.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.dataset import read_json
from deworldsg_ros.recordings.folders.sequence import (
    SequenceDataset,
    has_frames,
    looks_like_scan,
    sequence_folder,
)

GROUND_TRUTH_NAME = "gt.json"


def belongs_to_rooms(path: Path) -> bool:
    """Whether a scan has instance images and recorded detections."""
    return has_frames(path, ".instance.png") and has_frames(path, ".frontend.json")


class RoomsScan(SequenceDataset):
    """One rendered room."""

    kind = "rooms"
    expects = (
        "sequence/_info.txt and sequence/frame-NNNNNN.{color.jpg,depth.pgm,pose.txt,instance.png,"
        "frontend.json}"
    )
    default_rate_hz = 10.0
    how_to_get = "run unpack.py of the rendered rooms, which writes all files"

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether it is a scan with instance images and recorded detections."""
        return looks_like_scan(path) and belongs_to_rooms(path)


def read_ground_truth(scan_folder: Path) -> dict[str, Any] | None:
    """Content of a room's gt.json; None if there is none. Raises RecordingError."""
    path = sequence_folder(scan_folder).parent / GROUND_TRUTH_NAME
    if not path.exists():
        return None
    content = read_json(path)
    if not isinstance(content, dict) or "objects" not in content:
        raise RecordingError(f"{path}: there is no key objects; expected one")
    return content
