"""Common base of the data set folders: options, interface, file and image helpers."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import cv2
from numpy.typing import NDArray

from deworldsg_ros.files import confined, read_regular
from deworldsg_ros.parsing import parse_any_json
from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.messages import Role, RoleMessage
from deworldsg_ros.recordings.source import RawRoleMessage, UsedTopic, serialize
from deworldsg_ros.scene.arrays import UInt8, UInt16
from deworldsg_ros.streams.encoded import decode, encoded_size

CAMERA_FRAME = "camera_rgb_optical_frame"
WORLD_FRAME = "world"
# Each file is read whole. The largest is the annotated surface of a scan, some hundred MB.
MAX_FILE_BYTES = 2 << 30
DEPTH_SOURCES = ("auto", "rendered", "sensor")


@dataclass(frozen=True)
class DatasetOptions:
    """Information that a folder may not contain.

    Attributes:
        rate_hz: frames per second; 0 = the rate of the data set.
        intrinsics: fx, fy, cx, cy of the RGB image in pixels; None = those of the recording.
        depth_source: ``rendered`` from the mesh or from the ``sensor``, if a data set has both;
            ``auto`` = the depth of published results.
        poses_needed: whether a frame without a valid pose file is left out; if not, it has no
            pose.

    Raises:
        RecordingError: for another depth source.
    """

    rate_hz: float = 0.0
    intrinsics: tuple[float, float, float, float] | None = None
    depth_source: str = "auto"
    poses_needed: bool = True

    def __post_init__(self) -> None:
        if self.depth_source not in DEPTH_SOURCES:
            raise RecordingError(
                f"depth source '{self.depth_source}': expected {', '.join(DEPTH_SOURCES)}"
            )


def parse_intrinsics(text: str) -> tuple[float, float, float, float] | None:
    """fx, fy, cx, cy of ``FX,FY,CX,CY``; None for an empty text; raises RecordingError."""
    if not text:
        return None
    try:
        fx, fy, cx, cy = map(float, text.split(","))
        if not (0 < fx < math.inf and 0 < fy < math.inf and math.isfinite(cx + cy)):
            raise ValueError
    except ValueError as error:
        raise RecordingError(
            f"intrinsics '{text}': expected FX,FY,CX,CY, four numbers in pixels, FX and FY above 0"
        ) from error
    return fx, fy, cx, cy


class Dataset(ABC):
    """A folder as a `Source` of messages.

    Attributes:
        kind: name of the data set, for the command line.
        expects: files of such a folder, in words.
    """

    kind: ClassVar[str]
    expects: ClassVar[str]
    topics: dict[Role, UsedTopic]
    frame_count: int

    def __init__(self, path: Path, options: DatasetOptions) -> None:
        self.path = path
        self.name = path.resolve().name
        self.options = options
        self.drops: Counter[str] = Counter()
        self.losses: list[str] = []

    @staticmethod
    @abstractmethod
    def looks_like(path: Path) -> bool:
        """Whether a folder is of this data set, by a few file names."""

    @abstractmethod
    def messages(self) -> Iterator[RoleMessage]:
        """Messages in order of time."""

    def raw_messages(self) -> Iterator[RawRoleMessage]:
        """The same messages, serialized."""
        return map(serialize, self.messages())

    def close(self) -> None:  # noqa: B027
        """Nothing to close: files are open only while they are read."""


def read_file(path: Path, folder: Path | None = None) -> bytes:
    """Content of a file of a data set.

    Args:
        path: of the file.
        folder: folder in which it has to lie, with all links followed; None = its own.

    Raises:
        RecordingError: if it cannot be read, or lies elsewhere.
    """
    try:
        return read_regular(confined(folder or path.parent, path.absolute()), MAX_FILE_BYTES)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error


def read_text(path: Path) -> str:
    """Content of a text file; raises RecordingError if it cannot be read or is not UTF-8."""
    try:
        return read_file(path).decode()
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path} is no UTF-8 text: {error}") from error


def read_json(path: Path) -> Any:
    """Content of a JSON file; raises RecordingError."""
    try:
        return parse_any_json(read_file(path))
    except ValueError as error:
        raise RecordingError(f"{path}: {error}; expected JSON") from error


def image_size(path: Path, folder: Path | None = None) -> tuple[int, int]:
    """Width and height of an image file; arguments and errors as `read_file`."""
    try:
        return encoded_size(read_file(path, folder))
    except ValueError as error:
        raise RecordingError(f"{path} cannot be decoded: {error}") from error


def decode_image(content: bytes, flags: int, path: Path) -> NDArray[Any]:
    """Pixels of an image file's content; raises RecordingError if it cannot be decoded."""
    try:
        return decode(content, flags)
    except ValueError as error:
        raise RecordingError(
            f"{path} cannot be decoded: {error}; expected a JPEG or PNG image"
        ) from error


def encode_png(pixels: UInt8 | UInt16, *, stored: bool = False) -> bytes:
    """PNG file of BGR or grey pixels, fast rather than small; `stored` = without compression."""
    if not stored:
        return bytes(cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])
    parameters = [cv2.IMWRITE_PNG_COMPRESSION, 0]
    # The filters take most of the time and gain nothing without compression; OpenCV 4 has no
    # option for them.
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):
        parameters += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
    return bytes(cv2.imencode(".png", pixels, parameters)[1])


def image_format(path: Path) -> str:
    """Format of a CompressedImage, from the suffix of its file: png or jpeg."""
    return "png" if path.suffix.lower() == ".png" else "jpeg"
