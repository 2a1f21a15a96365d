"""Training clips of a probe: from a folder, or cropped from the frames of annotated scans."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Optional

import cv2
import msgspec
import numpy as np

from deworldsg_ros.base.files import confined, parse_json
from deworldsg_ros.checkpoints.cards import Window, relative_box_pair
from deworldsg_ros.recordings.folders.annotations import (
    LAYOUTS,
    SPLIT_FILES,
    Annotations,
    ScanPoints,
)
from deworldsg_ros.recordings.folders.dataset import (
    DatasetOptions,
    decode_image,
    image_size,
    read_file,
)
from deworldsg_ros.recordings.folders.frame_files import read_pose
from deworldsg_ros.recordings.folders.sequence import RioScan, sequence_folder
from deworldsg_ros.relations.clips import CropBox, Rgb, crop_clip, interval_start, union_box
from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import ConfigurationError, RecordingError, RefusedInput

# --- Clips of pairs with their predicates, from a folder.
#
# Two layouts (docs/dev/models.md): `FOLDER/PREDICATE/[GROUP__]NAME.npz|mp4|avi`, or
# `FOLDER/index.jsonl` with one line per clip.

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


# --- Clips of annotated pairs, cropped from the frames of a scan in the same way as at run time.

# Boxes of the objects in a frame by object id, (4,) float64 xyxy pixels.
Boxes = Mapping[int, Float64]
# Image file of a frame, and its boxes; None = not known.
ScanFrame = tuple[Path, Boxes | None]


def cut_clips(
    scan: str,
    frames: Sequence[ScanFrame],
    image_size: tuple[int, int],
    relations: Sequence[tuple[int, int, str]],
    *,
    clip_length: int,
    clips_per_pair: int,
    window: Window = "last_frames",
    rotated: bool = False,
) -> list[LabelledClip]:
    """Clips of each related pair, spread evenly over the frames in which both are visible.

    Args:
        scan: id of the scan, the group of its clips.
        frames: in order of time.
        image_size: width and height of all images.
        relations: subject id, object id, predicate.
        clip_length: T.
        clips_per_pair: maximum number of clips per pair.
        window: frames of a clip, see `ProbeCard`.
        rotated: whether boxes and sizes are those of the images rotated by 90 degrees clockwise.
    """
    width, height = image_size
    clips = []
    for subject, object_, predicate in relations:
        seen = [_shows(boxes, subject, object_) for _, boxes in frames]
        visible = [index for index, shown in enumerate(seen) if shown]
        for index in _spread(visible, clips_per_pair):
            boxes = frames[index][1] or {}
            crop = union_box(boxes[subject], boxes[object_], width, height)
            x1, y1, x2, y2 = crop
            corner = np.array([x1, y1, x1, y1], np.float64)
            first = max(0, index - clip_length + 1)
            if window == "valid_interval":
                first += interval_start(seen[first : index + 1])
            paths = [path for path, _ in frames[first : index + 1]]
            modified = paths[-1].stat().st_mtime_ns
            clips.append(
                LabelledClip(
                    key=f"{scan} {paths[0].name} {paths[-1].name} {modified} {crop} {clip_length}",
                    group=scan,
                    pair=f"{scan} {min(subject, object_)} {max(subject, object_)}",
                    predicate=predicate,
                    boxes=relative_box_pair(
                        boxes[subject] - corner, boxes[object_] - corner, x2 - x1, y2 - y1
                    ),
                    read=_reader(paths, crop, clip_length, rotated),
                )
            )
    return clips


def read_boxes(path: Path) -> dict[int, Float64]:
    """Boxes by object id from a `bb.txt` with lines `id x1 y1 x2 y2`; empty without the file.

    Raises:
        RefusedInput: ``unreadable_boxes``.
    """
    boxes: dict[int, Float64] = {}
    if not path.exists():
        return boxes
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        words = line.split()
        try:
            if words:
                identity, *corners = words
                x1, y1, x2, y2 = (float(word) for word in corners)
                boxes[int(identity)] = np.array([x1, y1, x2, y2])
        except ValueError as error:
            raise RefusedInput(
                "unreadable_boxes", f"{path}, line {number}: '{line}', expected id x1 y1 x2 y2"
            ) from error
    return boxes


def _shows(boxes: Boxes | None, subject: int, object_: int) -> bool | None:
    """Whether a frame shows both objects; None = not known."""
    if boxes is None:
        return None
    return _is_visible(boxes.get(subject)) and _is_visible(boxes.get(object_))


def _is_visible(box_xyxy: Float64 | None) -> bool:
    """Whether an object has a box of at least 10 pixels a side."""
    return box_xyxy is not None and bool((box_xyxy[2:] - box_xyxy[:2]).min() >= 10.0)


def _spread(indices: list[int], count: int) -> list[int]:
    """At most `count` of the indices, evenly spread, without the first and last of many."""
    if len(indices) <= count:
        return indices
    steps = (np.arange(count) + 0.5) * len(indices) / count
    return [indices[int(step)] for step in steps]


def _reader(
    paths: Sequence[Path], crop: CropBox, clip_length: int, rotated: bool
) -> Callable[[], Rgb]:
    def read() -> Rgb:
        images = []
        for path in paths:
            try:
                image = decode_image(read_file(path), cv2.IMREAD_COLOR, path)
            except RecordingError as error:
                raise RefusedInput("unreadable_clip", str(error)) from error
            if rotated:
                image = cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)
            images.append(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8))
        return crop_clip(images, crop, clip_length)

    return read


# --- Training clips of a probe, from a folder or from an annotated data set.

# 3RScan has no boxes. They are computed from the annotated surface points in every 8th frame, ...
BOXES_EVERY_FRAMES = 8
# ... from points whose depth is within 5 cm of the depth image (others are hidden), ...
MAX_DEPTH_GAP_M = 0.05
# ... for objects with at least 20 such points.
MIN_POINTS = 20


@dataclass(frozen=True)
class ClipChoice:
    """Which clips of a data set.

    Attributes:
        clip_length: T, frames of a clip.
        clips_per_pair: maximum number of clips per pair.
        split: ``train``, ``validation`` or ``test``.
        window: frames of a clip, see `ProbeCard`.
    """

    clip_length: int
    clips_per_pair: int
    split: str = "train"
    window: Window = "last_frames"


def read_clips(source: Path, choice: ClipChoice) -> list[LabelledClip]:
    """The clips of a folder, or of a split of a data set.

    Raises:
        DeWorldSGError: there are no clips, or scans of the split are test scans.
    """
    found = _layouts(source)
    if not found:
        return read_clip_folder(source)
    annotations = Annotations(source, found[0])
    names = annotations.vocabulary.predicates
    clips: list[LabelledClip] = []
    for scan in _scans(annotations, choice.split):
        folder = annotations.scan_folder(scan)
        rotated = found[0] == "3rscan"
        frames = list(_rio_frames(annotations, scan) if rotated else _replica_frames(folder))
        if not frames:
            continue
        width, height = image_size(frames[0][0])
        clips += cut_clips(
            scan,
            frames,
            (height, width) if rotated else (width, height),
            [
                (subject, object_, names[index])
                for subject, object_, index in annotations.scan(scan).relations
                if index >= 0
            ],
            clip_length=choice.clip_length,
            clips_per_pair=choice.clips_per_pair,
            window=choice.window,
            rotated=rotated,
        )
    if not clips:
        raise ConfigurationError(
            f"data set '{source}': no frame of the split '{choice.split}' shows a related pair; "
            "expected "
            "data/SCAN/sequence/frame-NNNNNN.color.jpg with .bb.txt (ReplicaSSG) or with depth and "
            "pose (3RScan)"
        )
    return clips


def is_data_set(source: Path) -> bool:
    """Whether a folder is a data set, and not a folder of clips."""
    return bool(_layouts(source))


def _layouts(source: Path) -> list[str]:
    return [name for name, layout in LAYOUTS.items() if (source / layout.relations).is_file()]


def _scans(annotations: Annotations, split: str) -> list[str]:
    """The scans of a split that are on disk, each once.

    Raises:
        ConfigurationError: none, or the split shares scans with the test split.
    """
    listed = sorted(set(_listed(annotations, split)))
    scans = [scan for scan in listed if annotations.scan_folder(scan).is_dir()]
    if not scans:
        raise ConfigurationError(
            f"data set '{annotations.root}' has no scans of the split '{split}' "
            f"({annotations.layout.lists}/{SPLIT_FILES[split]} lists {len(listed)}): choose "
            "another one with --split; a probe cannot be measured on scans that it has seen"
        )
    tested = set() if split == "test" else set(scans) & set(_listed(annotations, "test"))
    if tested:
        raise ConfigurationError(
            f"{len(tested)} scans of the split '{split}' of data set '{annotations.root}' are test "
            f"scans, too, first '{min(tested)}': give --split test to train on them nevertheless"
        )
    return scans


def _listed(annotations: Annotations, split: str) -> list[str]:
    with contextlib.suppress(RecordingError):  # a data set need not have every list
        return annotations.scans(split)
    return []


def _replica_frames(folder: Path) -> Iterator[ScanFrame]:
    for image in sorted(sequence_folder(folder).glob("frame-*.color.jpg")):
        yield image, read_boxes(image.with_name(image.name.split(".")[0] + ".bb.txt"))


def _rio_frames(annotations: Annotations, scan: str) -> Iterator[ScanFrame]:
    """Each image, with boxes in the upright (rotated) image in every 8th frame."""
    source = RioScan(annotations.scan_folder(scan), DatasetOptions())
    points = annotations.points(scan)
    height = source.info.color.height
    for index, number in enumerate(source.frame_numbers.values()):
        path = source.file(number, ".color.jpg")
        if index % BOXES_EVERY_FRAMES:
            yield path, None
            continue
        boxes: Boxes = {}
        # A frame with missing or damaged files has no boxes.
        with contextlib.suppress(RecordingError, RefusedInput):
            boxes = _boxes_of_frame(source, number, points)
        # Rotated by 90 degrees clockwise, like the images of RioScan.
        yield (
            path,
            {
                object_id: np.array([height - 1 - y2, x1, height - 1 - y1, x2])
                for object_id, (x1, y1, x2, y2) in boxes.items()
            },
        )


def _boxes_of_frame(source: RioScan, number: int, points: ScanPoints) -> Boxes:
    path = source.file(number, source.depth_suffix)
    depth = decode_image(read_file(path), cv2.IMREAD_UNCHANGED, path)
    T_world_camera = read_pose(source.file(number, source.pose_suffix))
    color = source.info.color
    same = depth.shape == (color.height, color.width)
    camera = color if same else source.info.depth
    return visible_boxes(
        points, T_world_camera, depth / source.info.depth_units_per_m, camera, color
    )


def visible_boxes(
    points: ScanPoints,
    T_world_camera: Float64,
    depth_m: Float64,
    depth_camera: Intrinsics,
    color_camera: Intrinsics,
) -> Mapping[int, Float64]:
    """Boxes (4,) xyxy of the visible annotated objects, pixels of the colour image.

    Args:
        points: annotated surface points, world frame.
        T_world_camera: (4, 4), of both cameras.
        depth_m: (H, W), metres; 0 = invalid.
        depth_camera: intrinsics of the depth image.
        color_camera: intrinsics of the colour image.
    """
    points_camera = (points.points_world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    in_front = points_camera[:, 2] > 0
    points_in_front = points_camera[in_front]
    z = points_in_front[:, 2]
    ids = points.object_ids[in_front]
    column, row = np.rint(depth_camera.project(points_in_front)).astype(np.int64).T
    inside = (column >= 0) & (column < depth_m.shape[1]) & (row >= 0) & (row < depth_m.shape[0])
    visible = np.zeros(len(z), np.bool_)
    gaps_m = np.abs(depth_m[row[inside], column[inside]] - z[inside])
    visible[inside] = gaps_m < MAX_DEPTH_GAP_M
    u, v = color_camera.project(points_in_front).T
    visible &= (u >= 0) & (u <= color_camera.width - 1)
    visible &= (v >= 0) & (v <= color_camera.height - 1)
    boxes: dict[int, Float64] = {}
    for object_id in np.unique(ids[visible]).tolist():
        own = visible & (ids == object_id)
        if np.count_nonzero(own) >= MIN_POINTS:
            boxes[object_id] = np.array([u[own].min(), v[own].min(), u[own].max(), v[own].max()])
    return boxes
