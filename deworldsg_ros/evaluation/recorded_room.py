"""A recording with ground truth, as a data set of one scan.

The files ``NAME.gt.json`` and ``NAME.instances.npz`` are beside the bag ``NAME`` (bags/README.md).
Classes are those of COCO. Only objects that can be detected, and relations between them, count.
"""

from __future__ import annotations

import functools
import lzma
import math
from pathlib import Path
from typing import Any

import numpy as np

from deworldsg_ros.base.array_file import read_arrays
from deworldsg_ros.recordings.folders.annotations import (
    Annotations,
    Layout,
    ScanAnnotation,
    ScanPoints,
)
from deworldsg_ros.recordings.folders.dataset import read_json
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.arrays import UInt8, UInt16
from deworldsg_ros.scene.errors import RecordingError
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.vocabulary import COCO_CLASSES, REPLICA_SSG_PREDICATES

LAYOUT = Layout("recording", "", "", "", "", "", "", "", "bags/README.md describes the files")
# Older names of COCO classes, which ground truth may contain.
SPELLINGS = {
    "aeroplane": "airplane",
    "diningtable": "dining table",
    "motorbike": "motorcycle",
    "pottedplant": "potted plant",
    "sofa": "couch",
    "tvmonitor": "tv",
}
# Annotated surface: one point per cell, from every fourth row and column of the images. Cells with
# fewer pixels are noise of the depth at edges.
CELL_M = 0.02
PIXEL_STRIDE = 4
MIN_PIXELS = 3
# Ten hours at 30 Hz, and an hour of small images at 10 Hz.
MAX_FRAMES = 1_000_000
MAX_INSTANCE_BYTES = 4 << 30
# Surface this far outside the box of its object is noise.
BOX_MARGIN_M = 0.05


class RecordedRoom(Annotations):
    """Ground truth of one recording. The id of its only scan is the name of the recording.

    Args:
        root: path of the recording.

    Attributes:
        frame_numbers: number of each frame by its stamp in nanoseconds.
        boxes: minimum and maximum corner of each object by id, metres, world.

    Raises:
        RecordingError: ground truth is missing or invalid.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.layout = LAYOUT
        self.class_of_label = {}
        self.vocabulary = Vocabulary(COCO_CLASSES, REPLICA_SSG_PREDICATES)
        self._truth_path = _beside(root, ".gt.json")
        self._instances_path = _beside(root, ".instances.npz")
        try:
            content = read_json(self._truth_path)
            self.boxes = {int(item["id"]): item["aabb"] for item in content["objects"]}
            self._detectable: list[dict[str, Any]] = [
                {**item, "vg": SPELLINGS.get(item["class"], item["class"])}
                for item in content["objects"]
                if item["detectable"]
            ]
            known = {int(item["id"]): COCO_CLASSES.index(item["vg"]) for item in self._detectable}
            lines = [
                (int(item["subject"]), int(item["object"]), str(item["predicate"]))
                for item in content["relations"]
            ]
            self._named = [line for line in lines if {*line[:2]} <= known.keys()]
            relations = [(s, o, REPLICA_SSG_PREDICATES.index(name)) for s, o, name in self._named]
            first_ns, rate_hz = int(content["first_stamp_ns"]), float(content["rate_hz"])
            count = int(content["frames"])
            if not (1e-3 <= rate_hz <= 1e6 and 0 <= count <= MAX_FRAMES):
                raise ValueError(
                    f"{count} frames at {rate_hz} Hz: expected at most {MAX_FRAMES}, at 1e-3 to 1e6"
                )
            self.frame_numbers = {
                first_ns + round(number * 1e9 / rate_hz): number for number in range(count)
            }
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise RecordingError(f"{self._truth_path}: {type(error).__name__}: {error}") from error
        related = frozenset(end for line in relations for end in line[:2])
        self._annotation = ScanAnnotation(root.resolve().stem, known, relations, related)

    def scans(self, split: str = "test") -> list[str]:
        """The name of the recording, for every split."""
        return [self._annotation.scan]

    def scan(self, scan: str) -> ScanAnnotation:
        """The annotation; raises RecordingError if `scan` is not the name of the recording."""
        if scan != self._annotation.scan:
            raise RecordingError(
                f"scan {scan} is not in {self.root}: expected {self._annotation.scan}"
            )
        return self._annotation

    def points(self, scan: str, *, aligned: bool = False) -> ScanPoints:
        """Points on the surfaces that the frames show, one per cell of 2 cm."""
        self.scan(scan)
        return _seen_surface(self.root.resolve())

    def scan_folder(self, scan: str) -> Path:
        """Path of the recording."""
        return self.root

    def ground_truth(self, scan: str) -> dict[str, Any]:
        """Objects and relations in the format of gt.json of a rendered room."""
        return {
            "objects": self._detectable,
            "relationships": [(s, o, 0, name) for s, o, name in self._named],
        }

    def instances(self, stamp_ns: int) -> UInt16 | None:
        """Instance image (H, W) of a frame: object ids; None if no frame has this stamp."""
        number = self.frame_numbers.get(stamp_ns)
        if number is None:
            return None
        return _read_instances(self._instances_path)[number].astype(np.uint16)


def open_annotations(root: Path, layout: str) -> Annotations:
    """Annotations of a data set; of a recording if `layout` is ``recording``."""
    return RecordedRoom(root) if layout == LAYOUT.name else Annotations(root, layout)


def has_ground_truth(recording: Path) -> bool:
    """Whether there is a file of ground truth beside a recording."""
    whole = recording.resolve()
    return whole.with_name(f"{whole.stem}.gt.json").exists()


def _beside(recording: Path, suffix: str) -> Path:
    """The file of the same name beside a recording; raises RecordingError if it is missing."""
    whole = recording.resolve()
    path = whole.with_name(f"{whole.stem}{suffix}")
    if not path.exists():
        raise RecordingError(f"recording {recording} has no ground truth: {path} is missing")
    return path


@functools.lru_cache(maxsize=1)
def _read_instances(path: Path) -> UInt8:
    """Instance images (frames, H, W) uint8; raises RecordingError."""
    try:
        packed = read_arrays(path)
        shape = tuple(packed["shape"].tolist())
        size = math.prod(shape)
        if len(shape) != 3 or min(shape) < 0 or size > MAX_INSTANCE_BYTES:
            raise ValueError(f"images of shape {shape}")
        content = lzma.LZMADecompressor().decompress(packed["lzma"].tobytes(), max_length=size)
        return np.frombuffer(content, np.uint8).reshape(shape)
    except (OSError, KeyError, ValueError, lzma.LZMAError) as error:
        raise RecordingError(
            f"{path}: {type(error).__name__}: {error}; expected lzma and shape"
        ) from error


@functools.lru_cache(maxsize=1)
def _seen_surface(recording: Path) -> ScanPoints:
    """Centres of the surface cells; a cell belongs to the object with most pixels in it."""
    room = RecordedRoom(recording)
    source = open_source(recording)
    hits = []
    try:
        for frame in Recording(source).frames():
            image = room.instances(frame.stamp_ns)
            if image is None:
                continue
            step = slice(None, None, PIXEL_STRIDE)
            depth_m, ids = frame.depth_m[step, step], image[step, step]
            rows, columns = np.nonzero((depth_m > 0) & (ids > 0))
            camera_points = frame.intrinsics.back_project(
                columns * PIXEL_STRIDE,
                rows * PIXEL_STRIDE,
                depth_m[rows, columns].astype(np.float64),
            )
            T = frame.T_world_camera
            world = camera_points @ T[:3, :3].T + T[:3, 3]
            cells = np.floor(world / CELL_M).astype(np.int64)
            hits.append(np.column_stack([cells, ids[rows, columns]]))
    finally:
        source.close()
    if not hits:
        raise RecordingError(f"recording {recording}: no frame has the stamp of an instance image")
    found, counts = np.unique(np.concatenate(hits), axis=0, return_counts=True)
    # The id with most pixels comes first in each cell.
    order = np.lexsort((-counts, found[:, 2], found[:, 1], found[:, 0]))
    found, counts = found[order], counts[order]
    first = np.ones(len(found), bool)
    first[1:] = (found[1:, :3] != found[:-1, :3]).any(axis=1)
    kept = found[first & (counts >= MIN_PIXELS)]
    points, object_ids = (kept[:, :3] + 0.5) * CELL_M, np.asarray(kept[:, 3], np.int64)
    # Depth at an edge may lie anywhere between two surfaces: keep points in the box of the object.
    inside = np.zeros(len(object_ids), bool)
    for number, (low, high) in room.boxes.items():
        within = (points > np.subtract(low, BOX_MARGIN_M)) & (points < np.add(high, BOX_MARGIN_M))
        inside |= (object_ids == number) & within.all(axis=1)
    return ScanPoints(points[inside], object_ids[inside])
