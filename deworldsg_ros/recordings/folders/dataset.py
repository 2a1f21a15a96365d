"""What data set folders have in common."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.messages import Role, RoleMessage, encode
from deworldsg_ros.recordings.source import RawRoleMessage, UsedTopic
from deworldsg_ros.scene.arrays import UInt8, UInt16

CAMERA_FRAME = "camera_rgb_optical_frame"
WORLD_FRAME = "world"
DEPTH_SOURCES = ("auto", "rendered", "sensor")


@dataclass(frozen=True)
class DatasetOptions:
    """What a folder may not say itself.

    Attributes:
        rate_hz: frames a second; 0 = as the data set has it.
        intrinsics: fx, fy, cx, cy of the RGB image in pixels; None = as the data set has them.
        depth_source: ``rendered`` from the mesh or from the ``sensor``, where a data set has both;
            ``auto`` = what the compared numbers use.
        poses_needed: whether a frame without a valid pose file is left out; otherwise it comes
            without a pose.

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
                f"depth source '{self.depth_source}': wanted {', '.join(DEPTH_SOURCES)}"
            )


def parse_intrinsics(text: str) -> tuple[float, float, float, float] | None:
    """fx, fy, cx, cy of ``FX,FY,CX,CY``, None of an empty text; raises RecordingError."""
    if not text:
        return None
    try:
        fx, fy, cx, cy = map(float, text.split(","))
        if not (0 < fx < math.inf and 0 < fy < math.inf and math.isfinite(cx + cy)):
            raise ValueError
    except ValueError as error:
        raise RecordingError(
            f"intrinsics '{text}': wanted FX,FY,CX,CY, four numbers in pixels, FX and FY above 0"
        ) from error
    return fx, fy, cx, cy


class Dataset(ABC):
    """A folder as a `Source` of messages.

    Attributes:
        kind: name of the data set, as the command line takes it.
        expects: what such a folder holds, in words.
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
        """Whether a folder is of this data set, judged by a few file names."""

    @abstractmethod
    def messages(self) -> Iterator[RoleMessage]:
        """Messages in order of time."""

    def raw_messages(self) -> Iterator[RawRoleMessage]:
        """The same, serialized."""
        return serialized(self.messages())

    def close(self) -> None:  # noqa: B027
        """Nothing is held open."""


def serialized(messages: Iterable[RoleMessage]) -> Iterator[RawRoleMessage]:
    """Messages as CDR bytes, recorded when they were stamped."""
    for item in messages:
        yield RawRoleMessage(
            item.role,
            item.msgtype,
            item.stamp_ns,
            item.stamp_ns,
            encode(item.message, item.msgtype),
        )


def read_file(path: Path) -> bytes:
    """Content of a file that must be there; raises RecordingError."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}): expected it there") from (
            error
        )


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file; raises RecordingError."""
    return decode_image(read_file(path), cv2.IMREAD_COLOR, path).shape[1::-1]


def decode_image(content: bytes, flags: int, path: Path) -> NDArray[Any]:
    """Pixels of an image file's content; raises RecordingError where they cannot be decoded."""
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), flags) if content else None
    if pixels is None:
        raise RecordingError(f"{path} cannot be decoded: wanted a JPEG or PNG image")
    return pixels


def encode_png(pixels: UInt8 | UInt16, *, stored: bool = False) -> bytes:
    """PNG file of BGR or grey pixels; fast rather than small, `stored` = not compressed at all."""
    if not stored:
        return bytes(cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])
    parameters = [cv2.IMWRITE_PNG_COMPRESSION, 0]
    # OpenCV 4 cannot choose: its filters cost more than the rest and gain nothing here.
    if hasattr(cv2, "IMWRITE_PNG_FILTER"):
        parameters += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
    return bytes(cv2.imencode(".png", pixels, parameters)[1])


def image_format(path: Path) -> str:
    """Format of a CompressedImage by the suffix of its file."""
    return "png" if path.suffix.lower() == ".png" else "jpeg"
