"""A recording with its ground truth beside it, as a data set of one scan.

The recording ``NAME`` (a bag) has ``NAME.gt.json`` and ``NAME.instances.npz`` beside it, as
bags/README.md describes them. Classes are COCO's words; what counts are the objects that can be
detected, and the relations between those.
"""

from __future__ import annotations

import functools
import io
import json
import lzma
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.annotations import (
    Annotations,
    Layout,
    ScanAnnotation,
    ScanPoints,
)
from deworldsg_ros.recordings.folders.dataset import read_file
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.arrays import UInt8, UInt16
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.vocabularies import COCO_CLASSES, REPLICA_SSG_PREDICATES

LAYOUT = Layout("recording", "", "", "", "", "", "", "", "bags/README.md says what belongs to it")
# Older spellings of COCO's words, which ground truth may have.
SPELLINGS = {
    "aeroplane": "airplane",
    "diningtable": "dining table",
    "motorbike": "motorcycle",
    "pottedplant": "potted plant",
    "sofa": "couch",
    "tvmonitor": "tv",
}
# Annotated surface: cells of the seen surface, hit by so many of the pixels looked at.
CELL_M = 0.02
PIXEL_STRIDE = 4
LEAST_HITS = 3
MARGIN_M = 0.05


class RecordedRoom(Annotations):
    """Ground truth of one recording; its only scan is the recording's name.

    Args:
        root: the recording.

    Attributes:
        frame_numbers: place of each frame by its stamp in nanoseconds.
        boxes: lowest and highest corner of every object by id, metres, world.

    Raises:
        RecordingError: for ground truth that is missing or lacks something.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.layout = LAYOUT
        self.class_of_label = {}
        self.vocabulary = Vocabulary(COCO_CLASSES, REPLICA_SSG_PREDICATES)
        self._truth_path = _beside(root, ".gt.json")
        self._instances_path = _beside(root, ".instances.npz")
        try:
            content = json.loads(read_file(self._truth_path))
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
            if not rate_hz > 0:
                raise ValueError(f"rate_hz is {rate_hz}: wanted more than 0")
            self.frame_numbers = {
                first_ns + round(number * 1e9 / rate_hz): number
                for number in range(int(content["frames"]))
            }
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(f"{self._truth_path}: {type(error).__name__}: {error}") from error
        related = frozenset(end for line in relations for end in line[:2])
        self._annotation = ScanAnnotation(root.resolve().stem, known, relations, related)

    def scans(self, split: str = "test") -> list[str]:
        """The recording's name, whatever the split."""
        return [self._annotation.scan]

    def scan(self, scan: str) -> ScanAnnotation:
        """What is annotated; raises RecordingError for the name of another recording."""
        if scan != self._annotation.scan:
            raise RecordingError(f"scan {scan}: {self.root} is {self._annotation.scan}")
        return self._annotation

    def points(self, scan: str, *, aligned: bool = False) -> ScanPoints:
        """The surfaces that the frames show with their own poses, once a cell of 2 cm."""
        self.scan(scan)
        return _seen_surface(self.root.resolve())

    def scan_folder(self, scan: str) -> Path:
        """The recording itself."""
        return self.root

    def ground_truth(self, scan: str) -> dict[str, Any]:
        """Objects and relations in the form of a rendered room's gt.json."""
        return {
            "objects": self._detectable,
            "relationships": [(s, o, 0, name) for s, o, name in self._named],
        }

    def instances(self, stamp_ns: int) -> UInt16 | None:
        """Object ids of a frame's pixels, (H, W); None for a stamp that is no frame's."""
        number = self.frame_numbers.get(stamp_ns)
        if number is None:
            return None
        return _read_instances(self._instances_path)[number].astype(np.uint16)


def open_annotations(root: Path, layout: str) -> Annotations:
    """Annotations of a data set, or of a recording (layout ``recording``); see there."""
    return RecordedRoom(root) if layout == LAYOUT.name else Annotations(root, layout)


def _beside(recording: Path, suffix: str) -> Path:
    """File of the same name beside a recording; raises RecordingError."""
    whole = recording.resolve()
    path = whole.with_name(f"{whole.stem}{suffix}")
    if not path.exists():
        raise RecordingError(f"recording {recording}: {path} is missing: it has no ground truth")
    return path


@functools.lru_cache(maxsize=1)
def _read_instances(path: Path) -> UInt8:
    """Instance images (frames, H, W) uint8; raises RecordingError."""
    try:
        with np.load(io.BytesIO(read_file(path))) as packed:
            pixels = np.frombuffer(lzma.decompress(packed["lzma"].tobytes()), np.uint8)
            return pixels.reshape(packed["shape"])
    except (KeyError, ValueError, lzma.LZMAError, zipfile.BadZipFile) as error:
        raise RecordingError(
            f"{path}: {type(error).__name__}: {error}; wanted lzma and shape"
        ) from error


@functools.lru_cache(maxsize=1)
def _seen_surface(recording: Path) -> ScanPoints:
    """Centres of the cells of each object's surface; a cell belongs to whom it was seen of most."""
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
            z = depth_m[rows, columns].astype(np.float64)
            camera, T = frame.intrinsics, frame.T_world_camera
            x = (columns * PIXEL_STRIDE - camera.cx) / camera.fx * z
            y = (rows * PIXEL_STRIDE - camera.cy) / camera.fy * z
            world = np.stack([x, y, z], axis=1) @ T[:3, :3].T + T[:3, 3]
            cells = np.floor(world / CELL_M).astype(np.int64)
            hits.append(np.column_stack([cells, ids[rows, columns]]))
    finally:
        source.close()
    if not hits:
        raise RecordingError(f"recording {recording}: no frame has the stamp of an instance image")
    found, counts = np.unique(np.concatenate(hits), axis=0, return_counts=True)
    # The most often hit id of each cell comes first.
    order = np.lexsort((-counts, found[:, 2], found[:, 1], found[:, 0]))
    found, counts = found[order], counts[order]
    first = np.ones(len(found), bool)
    first[1:] = (found[1:, :3] != found[:-1, :3]).any(axis=1)
    kept = found[first & (counts >= LEAST_HITS)]
    points, object_ids = (kept[:, :3] + 0.5) * CELL_M, np.asarray(kept[:, 3], np.int64)
    # Depth at an edge may lie anywhere between two surfaces; an object is in its box.
    inside = np.zeros(len(object_ids), bool)
    for number, (low, high) in room.boxes.items():
        within = (points > np.subtract(low, MARGIN_M)) & (points < np.add(high, MARGIN_M))
        inside |= (object_ids == number) & within.all(axis=1)
    return ScanPoints(points[inside], object_ids[inside])
