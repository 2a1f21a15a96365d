"""Clips of annotated pairs, cropped from the frames of a scan in the same way as at run time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from deworldsg_ros.checkpoints.probe_card import Window, relative_box_pair
from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.dataset import decode_image, read_file
from deworldsg_ros.relations.clips import CropBox, Rgb, crop_clip, interval_start, union_box
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.training.labelled_clips import LabelledClip

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
