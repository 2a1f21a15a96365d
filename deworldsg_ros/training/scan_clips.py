"""Clips of annotated pairs, cut out of the frames of a scan as the stage cuts them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from deworldsg_ros.checkpoints.probe_card import relative_box_pair
from deworldsg_ros.relations.clips import CropBox, Rgb, crop_clip, union_box
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.training.labelled_clips import LabelledClip

# Boxes of the objects in a frame by object id, (4,) float64 xyxy pixels.
Boxes = Mapping[int, Float64]


def cut_clips(
    scan: str,
    frames: Sequence[tuple[Path, Boxes]],
    image_size: tuple[int, int],
    relations: Sequence[tuple[int, int, str]],
    *,
    clip_length: int,
    clips_per_pair: int,
    min_side_px: float = 10.0,
    turned: bool = False,
) -> list[LabelledClip]:
    """Clips of each related pair, at frames spread evenly over those in which both are seen.

    Args:
        scan: its id; the clips' group.
        frames: image file and boxes by object id, in order of time.
        image_size: width and height of all images.
        relations: subject id, object id, predicate.
        clip_length: T.
        clips_per_pair: at most so many of each.
        min_side_px: shortest side of a box that counts as seen.
        turned: whether boxes and sizes are of the images turned by 90 degrees clockwise.
    """
    width, height = image_size
    clips = []
    for subject, object_, predicate in relations:
        seen = [
            place
            for place, (_, boxes) in enumerate(frames)
            if all(_is_seen(boxes.get(end), min_side_px) for end in (subject, object_))
        ]
        for place in _spread(seen, clips_per_pair):
            boxes = frames[place][1]
            crop = union_box(boxes[subject], boxes[object_], width, height)
            x1, y1, x2, y2 = crop
            corner = np.array([x1, y1, x1, y1], np.float64)
            paths = [path for path, _ in frames[max(0, place - clip_length + 1) : place + 1]]
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
                    read=_reader(paths, crop, clip_length, turned),
                )
            )
    return clips


def read_boxes(path: Path) -> dict[int, Float64]:
    """Boxes by object id out of a `bb.txt`: id x1 y1 x2 y2 a line; empty where there is no file.

    Raises:
        RefusedInput: ``unreadable_boxes``.
    """
    boxes: dict[int, Float64] = {}
    if not path.exists():
        return boxes
    for number, line in enumerate(path.read_text().splitlines(), 1):
        words = line.split()
        try:
            if words:
                identity, *corners = words
                x1, y1, x2, y2 = (float(word) for word in corners)
                boxes[int(identity)] = np.array([x1, y1, x2, y2])
        except ValueError as error:
            raise RefusedInput(
                "unreadable_boxes", f"{path}, line {number}: wanted id x1 y1 x2 y2, saw '{line}'"
            ) from error
    return boxes


def _is_seen(box_xyxy: Float64 | None, min_side_px: float) -> bool:
    return box_xyxy is not None and bool((box_xyxy[2:] - box_xyxy[:2]).min() >= min_side_px)


def _spread(places: list[int], count: int) -> list[int]:
    """At most `count` of them, evenly spread, never the very ends of a long run."""
    if len(places) <= count:
        return places
    steps = (np.arange(count) + 0.5) * len(places) / count
    return [places[int(step)] for step in steps]


def _reader(
    paths: Sequence[Path], crop: CropBox, clip_length: int, turned: bool
) -> Callable[[], Rgb]:
    def read() -> Rgb:
        images = []
        for path in paths:
            image = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if image is None:
                raise RefusedInput("unreadable_clip", f"{path} cannot be decoded")
            if turned:
                image = cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)
            images.append(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8))
        return crop_clip(images, crop, clip_length)

    return read
