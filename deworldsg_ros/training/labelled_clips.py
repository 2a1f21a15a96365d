"""Clips of pairs with their predicates, from a folder.

Two layouts (docs/dev/models.md): `FOLDER/PREDICATE/[GROUP__]NAME.npz|mp4|avi`, or
`FOLDER/index.jsonl` with one line per clip.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Optional

import cv2
import msgspec
import numpy as np

from deworldsg_ros.files import confined
from deworldsg_ros.parsing import parse_json
from deworldsg_ros.relations.clips import Rgb
from deworldsg_ros.scene.arrays import Float32
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput

Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]
Box = tuple[Fraction, Fraction, Fraction, Fraction]

INDEX_FILE = "index.jsonl"
VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".webm")
ARRAY_SUFFIX = ".npz"
GROUP_MARK = "__"


@dataclass(frozen=True)
class LabelledClip:
    """A clip of an ordered pair; `read` loads its pixels.

    Attributes:
        key: unique name, which changes with the content.
        group: room or scan; never split between training and test.
        pair: pair of objects in a group; never split between training and validation.
        predicate: of subject to object.
        boxes: (8,) float32, corners of subject and object as fractions of the clip's width and
            height; None = unknown.
        read: loads the frames, (T, h, w, 3) uint8 RGB, oldest first.
    """

    key: str
    group: str
    pair: str
    predicate: str
    boxes: Optional[Float32]
    read: Callable[[], Rgb]


class _Line(msgspec.Struct, forbid_unknown_fields=True):
    clip: str
    predicate: str
    group: str
    pair: str = ""
    subject_box: Optional[Box] = None
    object_box: Optional[Box] = None


def read_clip_folder(folder: Path) -> list[LabelledClip]:
    """The clips of a folder, ordered by path.

    Raises:
        ConfigurationError: no clips, or an invalid line in the index.
    """
    if not folder.is_dir():
        raise ConfigurationError(
            f"'{folder}' is not a folder: expected a folder of clips, or a data set"
        )
    index = folder / INDEX_FILE
    clips = _read_index(index) if index.is_file() else _read_tree(folder)
    if not clips:
        raise ConfigurationError(
            f"'{folder}' contains no clips: expected {INDEX_FILE}, or PREDICATE/[GROUP__]NAME with "
            f"one of {', '.join((ARRAY_SUFFIX, *VIDEO_SUFFIXES))}"
        )
    return clips


def of_length(frames: Rgb, length: int) -> Rgb:
    """The last `length` frames; if there are fewer, the last one is repeated at the end."""
    frames = frames[-length:]
    missing = length - len(frames)
    return np.concatenate([frames, np.repeat(frames[-1:], missing, axis=0)]) if missing else frames


def read_frames(path: Path) -> Rgb:
    """Frames of a video, or of the array `frames` of an .npz file: (T, h, w, 3) uint8 RGB.

    Raises:
        RefusedInput: ``unreadable_clip``.
    """
    if path.suffix == ARRAY_SUFFIX:
        content: Any
        try:
            with np.load(path, allow_pickle=False) as content:
                frames = np.asarray(content["frames"])
        except Exception as error:  # numpy and zipfile raise errors of many types
            raise RefusedInput(
                "unreadable_clip", f"{path}: expected an array 'frames' ({error})"
            ) from error
        if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or not frames.size:
            raise RefusedInput(
                "unreadable_clip",
                f"{path}: frames are {frames.dtype} {frames.shape}: expected uint8 (T, h, w, 3)",
            )
        return frames
    video = cv2.VideoCapture(str(path))
    images = []
    while True:
        decoded, image = video.read()
        if not decoded:
            break
        images.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    video.release()
    if not images:
        raise RefusedInput("unreadable_clip", f"{path}: no frame of this video can be decoded")
    return np.asarray(np.stack(images), np.uint8)


def _read_tree(folder: Path) -> list[LabelledClip]:
    suffixes = (ARRAY_SUFFIX, *VIDEO_SUFFIXES)
    clips = []
    for path in sorted(folder.glob("*/*")):
        if path.suffix not in suffixes:
            continue
        group, mark, _ = path.stem.partition(GROUP_MARK)
        line = _Line(str(path.relative_to(folder)), path.parent.name, group if mark else path.stem)
        clips.append(_clip(folder, line))
    return clips


def _read_index(index: Path) -> list[LabelledClip]:
    clips = []
    for number, text in enumerate(index.read_bytes().splitlines(), 1):
        if not text.strip():
            continue
        try:
            line = parse_json(text, _Line)
        except ValueError as error:
            raise ConfigurationError(f"{index}, line {number}: {error}") from error
        try:
            path = confined(index.parent, line.clip)
        except OSError as error:
            raise ConfigurationError(
                f"{index}, line {number}: clip '{line.clip}': {error.strerror}"
            ) from error
        if not path.is_file():
            raise ConfigurationError(f"{index}, line {number}: there is no clip '{line.clip}'")
        clips.append(_clip(index.parent, line))
    return clips


def _clip(folder: Path, line: _Line) -> LabelledClip:
    path = folder / line.clip
    status = path.stat()
    boxes = None
    if line.subject_box is not None and line.object_box is not None:
        boxes = np.array([*line.subject_box, *line.object_box], np.float32)
    return LabelledClip(
        key=f"{line.clip} {status.st_size} {status.st_mtime_ns}",
        group=line.group,
        pair=f"{line.group} {line.pair or line.clip}",
        predicate=line.predicate,
        boxes=boxes,
        read=lambda: read_frames(path),
    )
