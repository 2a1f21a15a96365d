"""Training clips of a probe: from a folder, or cropped from the frames of annotated scans."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Optional, Union

import cv2
import msgspec
import numpy as np

from deworldsg_ros.base.files import confined, parse_json
from deworldsg_ros.checkpoints.cards import Crop, Window, relative_box_pair
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.recordings.folders.annotations import (
    LAYOUTS,
    SPLIT_FILES,
    Annotations,
    ScanPoints,
)
from deworldsg_ros.recordings.folders.dataset import (
    DatasetOptions,
    decode_image,
    read_file,
)
from deworldsg_ros.recordings.folders.frame_files import read_pose
from deworldsg_ros.recordings.folders.sequence import ReplicaScan, RioScan, SequenceDataset
from deworldsg_ros.relations.clips import (
    BoxPair,
    CropBox,
    Rgb,
    clip_regions,
    crop_clip,
    interval_start,
)
from deworldsg_ros.relations.paper import geometric_costs
from deworldsg_ros.scene.arrays import Float32, Float64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import ConfigurationError, RecordingError, RefusedInput

logger = logging.getLogger(__name__)

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
        key: name, which changes with the content; the same of clips with the same frames.
        group: room; never split between training and test.
        pair: pair of objects in a group; never split between training and validation.
        predicates: of subject to object, each once; a pair may have several.
        boxes: (8,) float32, corners of subject and object as fractions of the clip's width and
            height; None = unknown.
        read: loads the frames, (T, h, w, 3) uint8 RGB, oldest first.
        scan: of a data set; one room may have several.
    """

    key: str
    group: str
    pair: str
    predicates: tuple[str, ...]
    boxes: Optional[Float32]
    read: Callable[[], Rgb]
    scan: str = ""


class _Line(msgspec.Struct, forbid_unknown_fields=True):
    clip: str
    predicate: Union[str, Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]]
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
    names = (line.predicate,) if isinstance(line.predicate, str) else line.predicate
    boxes = None
    if line.subject_box is not None and line.object_box is not None:
        boxes = np.array([*line.subject_box, *line.object_box], np.float32)
    return LabelledClip(
        key=f"{line.clip} {status.st_size} {status.st_mtime_ns}",
        group=line.group,
        pair=f"{line.group} {line.pair or line.clip}",
        predicates=tuple(dict.fromkeys(names)),
        boxes=boxes,
        read=lambda: read_frames(path),
    )


# --- Clips of annotated pairs, cropped from the frames of a scan in the same way as at run time.


class Seen(NamedTuple):
    """A visible object: its box, (4,) float64 xyxy pixels, and its mean depth, metres."""

    box_xyxy: Float64
    depth_m: float


# Image file of a frame, and its visible objects by id; None = not known.
ScanFrame = tuple[Path, Mapping[int, Seen] | None]


@dataclass(frozen=True)
class ClipChoice:
    """Which clips of a data set.

    Attributes:
        clip_length: T, frames of a clip.
        clips_per_pair: maximum number of clips per ordered pair.
        split: ``train``, ``validation`` or ``test``.
        window, crop: frames of a clip and region of them, see `ProbeCard`.
        geo_cost_threshold: of Eq. 8 in the last frame, as at run time.
    """

    clip_length: int
    clips_per_pair: int
    split: str = "train"
    window: Window = "last_frames"
    crop: Crop = "last_frame"
    geo_cost_threshold: float = RelationsConfig().geo_cost_threshold


@dataclass(frozen=True)
class Scan:
    """The frames of an annotated scan.

    Attributes:
        name: its id.
        room: the group of its clips.
        frames: in order of time.
        image_size: width and height of all images.
        rotated: whether boxes and sizes are those of the images rotated by 90 degrees clockwise.
    """

    name: str
    room: str
    frames: Sequence[ScanFrame]
    image_size: tuple[int, int]
    rotated: bool = False


def cut_clips(
    scan: Scan, relations: Sequence[tuple[int, int, str]], choice: ClipChoice
) -> list[LabelledClip]:
    """Clips of each related pair, spread evenly over the frames in which it satisfies Eq. 8.

    Args:
        scan: its frames.
        relations: subject id, object id, predicate; one clip has all predicates of its pair.
        choice: of the clips.
    """
    predicates: dict[tuple[int, int], dict[str, None]] = {}
    for subject, object_, predicate in relations:
        predicates.setdefault((subject, object_), {})[predicate] = None
    clips = []
    for pair, names in predicates.items():
        shown = [_boxes_of(seen, pair) for _, seen in scan.frames]
        near = [
            index
            for index, (_, seen) in enumerate(scan.frames)
            if _both(shown[index]) and _geo_cost(seen, pair, scan) < choice.geo_cost_threshold
        ]
        clips += [
            _clip_at(scan, pair, tuple(names), shown[: index + 1], choice)
            for index in _spread(near, choice.clips_per_pair)
        ]
    return clips


def _clip_at(
    scan: Scan,
    pair: tuple[int, int],
    predicates: tuple[str, ...],
    shown: Sequence[BoxPair],
    choice: ClipChoice,
) -> LabelledClip:
    """The clip of a pair that ends with the last frame of `shown`, its boxes."""
    last = len(shown) - 1
    first = max(0, last - choice.clip_length + 1)
    if choice.window == "valid_interval":
        both = [
            None if scan.frames[index][1] is None else _both(shown[index])
            for index in range(first, last + 1)
        ]
        first += interval_start(both)
    paths = [path for path, _ in scan.frames[first : last + 1]]
    regions = clip_regions(shown[first:], choice.crop, *scan.image_size)
    x1, y1, x2, y2 = regions[-1]
    corner = np.array([x1, y1, x1, y1], np.float64)
    subject_box, object_box = (box - corner for box in shown[last] if box is not None)
    modified = paths[-1].stat().st_mtime_ns
    frames = f"{scan.name} {paths[0].name} {paths[-1].name} {modified}"
    return LabelledClip(
        key=f"{frames} {sorted(set(regions))} {choice.crop} {choice.clip_length}",
        group=scan.room,
        pair=f"{scan.room} {min(pair)} {max(pair)}",
        predicates=predicates,
        boxes=relative_box_pair(subject_box, object_box, x2 - x1, y2 - y1),
        read=_reader(paths, regions, choice.clip_length, scan.rotated),
        scan=scan.name,
    )


def _both(boxes: BoxPair) -> bool:
    return all(box is not None for box in boxes)


def _geo_cost(seen: Mapping[int, Seen] | None, pair: tuple[int, int], scan: Scan) -> float:
    """The geometric cost of a visible pair (Eq. 8)."""
    objects = [(seen or {})[end] for end in pair]
    boxes = np.stack([item.box_xyxy for item in objects])
    depths_m = np.array([item.depth_m for item in objects])
    return float(geometric_costs(boxes, depths_m, *scan.image_size)[0, 1])


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


def _boxes_of(seen: Mapping[int, Seen] | None, pair: tuple[int, int]) -> BoxPair:
    """The boxes of a pair in a frame; None = not known, or less than 10 pixels wide or high."""
    objects = [(seen or {}).get(end) for end in pair]
    a, b = (
        item.box_xyxy if item and (item.box_xyxy[2:] - item.box_xyxy[:2]).min() >= 10.0 else None
        for item in objects
    )
    return a, b


def _spread(indices: list[int], count: int) -> list[int]:
    """At most `count` of the indices, evenly spread, without the first and last of many."""
    if len(indices) <= count:
        return indices
    steps = (np.arange(count) + 0.5) * len(indices) / count
    return [indices[int(step)] for step in steps]


def _reader(
    paths: Sequence[Path], regions: Sequence[CropBox], clip_length: int, rotated: bool
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
        return crop_clip(images, regions, clip_length)

    return read


# --- Training clips of a probe, from a folder or from an annotated data set.

# Depths, and in 3RScan boxes, are computed from the annotated surface points. In 3RScan in every
# 8th frame, if the region of a clip is that of its last frame, ...
BOXES_EVERY_FRAMES = 8
# ... from points whose depth is within 5 cm of the depth image (others are hidden), ...
MAX_DEPTH_GAP_M = 0.05
# ... for objects with at least 20 such points.
MIN_POINTS = 20


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
    for name in _scans(annotations, choice.split):
        relations = [
            (subject, object_, names[index])
            for subject, object_, index in annotations.scan(name).relations
            if index >= 0
        ]
        clips += cut_clips(_read_scan(annotations, name, choice), relations, choice)
    if not clips:
        raise ConfigurationError(
            f"data set '{source}': no frame of the split '{choice.split}' shows a related pair "
            f"with a geometric cost below {choice.geo_cost_threshold} (Eq. 8); expected "
            "data/SCAN/sequence/frame-NNNNNN.color.jpg with .depth.pgm and .pose.txt, in "
            "ReplicaSSG also .bb.txt"
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
    rooms = {annotations.room(scan) for scan in scans}
    shared = set()
    for scan in _listed(annotations, "test"):
        with contextlib.suppress(RecordingError):  # a scan that is in no list of rooms
            shared |= rooms & {annotations.room(scan)}
    if shared and split != "test":
        logger.warning(
            "%d rooms of the split '%s' of data set '%s' have test scans, too, first '%s': the "
            "accuracy on those scans says nothing about other rooms",
            len(shared),
            split,
            annotations.root,
            min(shared),
        )
    return scans


def _listed(annotations: Annotations, split: str) -> list[str]:
    with contextlib.suppress(RecordingError):  # a data set need not have every list
        return annotations.scans(split)
    return []


def _read_scan(annotations: Annotations, name: str, choice: ClipChoice) -> Scan:
    """A scan, its boxes in pixels of the upright (in 3RScan rotated) image."""
    rotated = annotations.layout.name == "3rscan"
    folder = annotations.scan_folder(name)
    source = (RioScan if rotated else ReplicaScan)(folder, DatasetOptions())
    points = annotations.points(name)
    every = BOXES_EVERY_FRAMES if rotated and choice.crop == "last_frame" else 1
    frames: list[ScanFrame] = []
    for index, number in enumerate(source.frame_numbers.values()):
        seen: Mapping[int, Seen] | None = None if index % every else {}
        # A frame with missing or damaged files shows nothing.
        with contextlib.suppress(RecordingError, RefusedInput):
            if seen is not None:
                seen = _seen_in_frame(source, number, points)
        if not rotated:
            own, seen = read_boxes(source.file(number, ".bb.txt")), seen or {}
            seen = {end: Seen(own[end], seen[end].depth_m) for end in own.keys() & seen.keys()}
        frames.append((source.file(number, ".color.jpg"), seen))
    camera = source.intrinsics
    return Scan(name, annotations.room(name), frames, (camera.width, camera.height), rotated)


def _seen_in_frame(source: SequenceDataset, number: int, points: ScanPoints) -> Mapping[int, Seen]:
    path = source.file(number, source.depth_suffix)
    depth = decode_image(read_file(path), cv2.IMREAD_UNCHANGED, path)
    T_world_camera = read_pose(source.file(number, source.pose_suffix))
    color = source.info.color
    same = depth.shape == (color.height, color.width)
    camera = color if same else source.info.depth
    depth_m = depth / source.info.depth_units_per_m
    seen = visible_objects(points, T_world_camera, depth_m, camera, color)
    if not source.rotated:
        return seen
    # Rotated by 90 degrees clockwise, like the images.
    last = color.height - 1
    rotated: dict[int, Seen] = {}
    for end, ((x1, y1, x2, y2), depth_of_m) in seen.items():
        rotated[end] = Seen(np.array([last - y2, x1, last - y1, x2]), depth_of_m)
    return rotated


def visible_objects(
    points: ScanPoints,
    T_world_camera: Float64,
    depth_m: Float64,
    depth_camera: Intrinsics,
    color_camera: Intrinsics,
) -> Mapping[int, Seen]:
    """The visible annotated objects by id: boxes in pixels of the colour image, and mean depths.

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
    u, v, z, ids = u[visible], v[visible], z[visible], ids[visible]
    seen: dict[int, Seen] = {}
    for object_id in np.unique(ids).tolist():
        own = ids == object_id
        if np.count_nonzero(own) >= MIN_POINTS:
            box = np.array([u[own].min(), v[own].min(), u[own].max(), v[own].max()])
            seen[object_id] = Seen(box, float(z[own].mean()))
    return seen
