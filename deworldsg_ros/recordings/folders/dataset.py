"""The base of data set folders; each class that derives from `Dataset` is found automatically.

A new data set is one new module; no other file changes.
"""

from __future__ import annotations

import functools
import importlib
import math
import pkgutil
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from inspect import isabstract
from pathlib import Path
from types import GenericAlias
from typing import Any, ClassVar, TypeGuard

import cv2
from numpy.typing import NDArray

from deworldsg_ros.base.files import confined, parse_any_json, read_regular
from deworldsg_ros.base.plugins import PluginError, load_plugin, plugins
from deworldsg_ros.recordings.source import RawRoleMessage, Role, RoleMessage, UsedTopic, serialize
from deworldsg_ros.scene.arrays import UInt8, UInt16
from deworldsg_ros.scene.errors import RecordingError
from deworldsg_ros.streams.images import decode, encoded_size

# --- Common base of the data set folders: options, interface, file and image helpers.

CAMERA_FRAME = "camera_rgb_optical_frame"
WORLD_FRAME = "world"
# Each file is read whole. The largest is the annotated surface of a scan, some hundred MB.
MAX_FILE_BYTES = 2 << 30
DEPTH_SOURCES = ("auto", "rendered", "sensor")


# Frames a second of a camera.
LEAST_HZ, MOST_HZ = 1e-3, 1e4


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
        RecordingError: for another depth source, or a rate that no camera has.
    """

    rate_hz: float = 0.0
    intrinsics: tuple[float, float, float, float] | None = None
    depth_source: str = "auto"
    poses_needed: bool = True

    def __post_init__(self) -> None:
        if self.rate_hz and not LEAST_HZ <= self.rate_hz <= MOST_HZ:
            raise RecordingError(
                f"rate is {self.rate_hz:g} frames a second: expected 0, or {LEAST_HZ:g} to "
                f"{MOST_HZ:g}"
            )
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


def read_file(path: Path, folder: Path | None = None, most_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Content of a file of a data set.

    Args:
        path: of the file.
        folder: folder in which it has to lie, with all links followed; None = its own.
        most_bytes: that it may have.

    Raises:
        RecordingError: if it cannot be read, is larger, or lies elsewhere.
    """
    try:
        return read_regular(confined(folder or path.parent, path.absolute()), most_bytes)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from error


def read_text(path: Path, most_bytes: int = MAX_FILE_BYTES) -> str:
    """Content of a text file; errors as `read_file`, and RecordingError if it is not UTF-8."""
    try:
        return read_file(path, most_bytes=most_bytes).decode()
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


# --- The data sets of this folder: each class that derives from `Dataset` is found automatically.
#
# A new data set is one new module, or the entry point of another package (`base/plugins.py`); no
# other file changes.


def _is_dataset(item: Any) -> TypeGuard[type[Dataset]]:
    # In Python 3.10, an alias such as list[int] is a type, but issubclass() refuses it.
    is_class = isinstance(item, type) and not isinstance(item, GenericAlias)
    return is_class and issubclass(item, Dataset) and not isabstract(item)


@functools.lru_cache(maxsize=1)
def _datasets() -> dict[str, type[Dataset]]:
    package = importlib.import_module(__package__ or "deworldsg_ros.recordings.folders")
    found: dict[str, type[Dataset]] = {}
    for module in pkgutil.iter_modules(package.__path__):
        content = vars(importlib.import_module(f"{package.__name__}.{module.name}"))
        for item in content.values():
            if _is_dataset(item):
                found[item.kind] = item
    return dict(sorted(found.items()))


def detect_dataset(path: Path) -> str | None:
    """Name of the data set of a folder; None if it is of none of them.

    Raises:
        RecordingError: for the root of a data set of many scans.
    """
    scans = sorted(folder.parent.name for folder in path.glob("data/*/sequence"))
    if scans:
        shown = ", ".join(scans[:3]) + (", …" if len(scans) > 3 else "")
        raise RecordingError(
            f"recording {path}: it is a data set with the scans {shown}; expected one of them, "
            f"e.g. {path / 'data' / scans[0]}"
        )
    kinds = {**_datasets(), **{name: _of_plugin(name) for name in plugins("format")}}
    return next((name for name, kind in kinds.items() if kind.looks_like(path)), None)


def open_dataset(name: str, path: Path, options: DatasetOptions | None = None) -> Dataset:
    """Open a folder as a data set.

    Raises:
        RecordingError: for an unknown name, a missing folder or a missing file.
    """
    kind = _datasets().get(name) or _of_plugin(name)
    if not path.is_dir():
        raise RecordingError(f"recording {path}: there is no such folder")
    return kind(path, options or DatasetOptions())


def _of_plugin(name: str) -> type[Dataset]:
    try:
        kind = load_plugin("format", name, [*_datasets(), "rosbag2", "auto"])
    except PluginError as error:
        raise RecordingError(str(error)) from error
    if not _is_dataset(kind):
        raise RecordingError(f"format '{name}': expected a class that derives from Dataset")
    return kind


def expectations() -> str:
    """Files of a folder of each data set, in words."""
    kinds = [*_datasets().items(), *((name, _of_plugin(name)) for name in plugins("format"))]
    return "; ".join(f"{name}: {kind.expects}" for name, kind in kinds)
