"""TUM RGB-D: rgb.txt, depth.txt, groundtruth.txt; depth in 1/5000 m, registered to colour.

Images and poses keep their stamps; they are joined like those of a bag. The images of fr1 and fr2
stay distorted, as in most dense systems.
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from deworldsg_ros.base.words import stamp_ns_from_text
from deworldsg_ros.recordings import source as ros
from deworldsg_ros.recordings.folders.dataset import (
    CAMERA_FRAME,
    WORLD_FRAME,
    Dataset,
    DatasetOptions,
    decode_image,
    encode_png,
    image_format,
    image_size,
    read_file,
)
from deworldsg_ros.recordings.source import Role, RoleMessage, UsedTopic
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RecordingError

# Factory-calibrated colour cameras, from the data set's documentation.
INTRINSICS = {
    1: (517.3, 516.5, 318.6, 255.3),
    2: (520.9, 521.0, 325.1, 249.7),
    3: (535.4, 539.2, 320.1, 247.6),
}
# The longest sequence has 15 000 lines of poses, in 1.5 MB.
MAX_INDEX_BYTES = 32_000_000
SEQUENCE_NAME = re.compile(r"(?:freiburg|fr)([123])(?:\D|$)")


class Entry(NamedTuple):
    """One line of an index file."""

    stamp_ns: int
    values: tuple[str, ...]


class TumRgbd(Dataset):
    """One sequence folder of TUM RGB-D.

    Raises:
        RecordingError: names the missing file, or asks for the intrinsics.
    """

    kind = "tum"
    expects = "rgb.txt, depth.txt and groundtruth.txt"

    def __init__(self, path: Path, options: DatasetOptions) -> None:
        super().__init__(path, options)
        if options.rate_hz:
            raise RecordingError("--rate: TUM RGB-D has stamps; expected no --rate")
        self._rgb = _read_index(path / "rgb.txt", 1)
        self._depth = _read_index(path / "depth.txt", 1)
        poses = path / "groundtruth.txt"
        is_posed = options.poses_needed or poses.exists()
        self._poses = _read_index(poses, 7) if is_posed else []
        size = image_size(path / self._rgb[0].values[0], path)
        self.intrinsics = Intrinsics(*(options.intrinsics or self._known_intrinsics()), *size)
        self.frame_count = len(self._rgb)
        self.topics = {
            Role.RGB: UsedTopic("rgb.txt", ros.COMPRESSED_IMAGE, len(self._rgb)),
            Role.DEPTH: UsedTopic("depth.txt", ros.COMPRESSED_IMAGE, len(self._depth)),
            Role.CAMERA_INFO: UsedTopic("(by name)", ros.CAMERA_INFO, len(self._rgb)),
        }
        if is_posed:
            self.topics[Role.POSE] = UsedTopic(poses.name, ros.POSE_STAMPED, len(self._poses))

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether rgb.txt or depth.txt exists."""
        return (path / "rgb.txt").exists() or (path / "depth.txt").exists()

    def messages(self) -> Iterator[RoleMessage]:
        """Poses, depth and RGB images by their stamps; a camera_info with each RGB image."""
        return heapq.merge(
            self._each(self._poses, self._pose_message),
            self._each(self._depth, self._depth_messages),
            self._each(self._rgb, self._rgb_messages),
            key=lambda item: item.stamp_ns,
        )

    def _each(
        self, entries: list[Entry], convert: Callable[[Entry], list[RoleMessage]]
    ) -> Iterator[RoleMessage]:
        for entry in entries:
            try:
                yield from convert(entry)
            except RecordingError as error:
                self.drops["unreadable_file"] += 1
                self.losses.append(f"{error}: left out")

    def _pose_message(self, entry: Entry) -> list[RoleMessage]:
        values = np.array(entry.values[:7], np.float64)
        return [ros.pose_stamped(entry.stamp_ns, WORLD_FRAME, values[:3], values[3:])]

    def _rgb_messages(self, entry: Entry) -> list[RoleMessage]:
        path = self.path / entry.values[0]
        return [
            ros.camera_info(entry.stamp_ns, CAMERA_FRAME, self.intrinsics),
            ros.compressed_image(
                entry.stamp_ns, CAMERA_FRAME, read_file(path, self.path), image_format(path)
            ),
        ]

    def _depth_messages(self, entry: Entry) -> list[RoleMessage]:
        path = self.path / entry.values[0]
        units = decode_image(read_file(path, self.path), cv2.IMREAD_UNCHANGED, path)
        if units.dtype != np.uint16 or units.ndim != 2:
            raise RecordingError(f"{path} is {units.dtype}: expected 16-bit grey")
        # 5000 units are one metre. Rounding to millimetres is far below the noise of the sensor.
        depth_mm = np.rint(units * (1000.0 / 5000.0)).astype(np.uint16)
        return [ros.compressed_depth(entry.stamp_ns, CAMERA_FRAME, encode_png(depth_mm))]

    def _known_intrinsics(self) -> tuple[float, float, float, float]:
        match = SEQUENCE_NAME.search(self.name)
        if match is None:
            raise RecordingError(
                f"TUM RGB-D folder {self.path}: its name does not contain the camera; expected "
                "freiburg1, freiburg2 or freiburg3 in it, or --intrinsics FX,FY,CX,CY"
            )
        return INTRINSICS[int(match[1])]


def _read_index(path: Path, value_count: int) -> list[Entry]:
    """Lines 'stamp value …' in order of time, each with that many values; # starts a comment."""
    entries: list[Entry] = []
    text = read_file(path, most_bytes=MAX_INDEX_BYTES).decode(errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        where = f"{path}, line {number}: '{line[:80]}'"
        try:
            stamp_ns = stamp_ns_from_text(words[0])
            if value_count > 1:
                [float(word) for word in words[1:]]
        except ValueError as error:
            raise RecordingError(f"{where}: expected numbers") from error
        if len(words) <= value_count:
            raise RecordingError(
                f"{where} has {len(words) - 1} values after the stamp: expected {value_count}"
            )
        entries.append(Entry(stamp_ns, tuple(words[1:])))
    if not entries:
        raise RecordingError(
            f"{path} has no entry: expected lines of a stamp and {value_count} value(s)"
        )
    return sorted(entries)
