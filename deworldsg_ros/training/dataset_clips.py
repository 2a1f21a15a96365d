"""Training clips of a probe, from a folder or from an annotated data set."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from deworldsg_ros.checkpoints.probe_card import Window
from deworldsg_ros.recordings.errors import RecordingError
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
from deworldsg_ros.recordings.folders.rio import RioScan
from deworldsg_ros.recordings.folders.sequence import sequence_folder
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import ConfigurationError, RefusedInput
from deworldsg_ros.training.labelled_clips import LabelledClip, read_clip_folder
from deworldsg_ros.training.scan_clips import Boxes, ScanFrame, cut_clips, read_boxes

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
