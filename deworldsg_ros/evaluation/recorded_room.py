"""A recording with ground truth, as a data set of one scan; and objects as boxes.

The files ``NAME.gt.json`` and ``NAME.instances.npz`` are beside the bag ``NAME`` (bags/README.md).
Classes are those of COCO. Only objects that can be detected, and relations between them, count.
"""

from __future__ import annotations

import functools
import lzma
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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
from deworldsg_ros.scene.arrays import Bool, Float64, UInt8, UInt16
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose
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


# --- The annotated objects of a scan, and what a frame shows of them.

# Boxes that people mark are good to about 10 cm, and the mean of a visible surface lies at one side
# of them: a node supports an object if its mean is in the box grown by this on every side.
MARKED_MARGIN_M = 0.3
MAX_MARKED = 10_000
# A surface point this far outside its object's box still is a point of the object.
SURFACE_MARGIN_M = 0.02
# Points along each side of a box: the part of them in the image is the part of the object there.
GRID = 5
NEAREST_M = 0.1
# Depth pixels of a box that are looked at, about.
MAX_SAMPLES = 10_000


@dataclass(frozen=True)
class TrueObject:
    """An annotated object.

    Attributes:
        id: of the annotation.
        names: classes that are right, the first for people.
        low, high: corners (3,) of its box, metres, world.
    """

    id: str
    names: tuple[str, ...]
    low: Float64
    high: Float64

    @property
    def title(self) -> str:
        """Its first name and its id, for people."""
        name = self.names[0]
        return name if self.id == name else f"{name} {self.id}"

    def contains(self, points_world: Float64, margin_m: float) -> Bool:
        """Which points (..., 3) are in the box, grown by a margin on every side."""
        inside = (points_world >= self.low - margin_m) & (points_world <= self.high + margin_m)
        return np.asarray(inside.all(axis=-1))


@dataclass(frozen=True)
class Sight:
    """What a frame shows of an object.

    Attributes:
        part: of its box in the image, 0 to 1.
        pixels: with its surface, about.
        box_xyxy: (4,) around these pixels; of no size without any.
        depth_m: their median depth; inf without any.
    """

    part: float
    pixels: float = 0.0
    box_xyxy: Float64 = field(default_factory=lambda: np.zeros(4))
    depth_m: float = np.inf

    @property
    def side_px(self) -> float:
        """The shorter side of the box around the pixels."""
        return float((self.box_xyxy[2:] - self.box_xyxy[:2]).min())


@dataclass(frozen=True)
class Truth:
    """The annotated objects of a scan.

    Attributes:
        objects: all that count.
        margin_m: a node is at an object if its mean is in the box grown by this.
        class_of: classes of the annotation by those labels of the detector that differ.
        instances: instance image (H, W) of a frame with the ids of the objects; None = there is
            none: a depth pixel in the box of an object shows the object.
    """

    objects: tuple[TrueObject, ...]
    margin_m: float
    class_of: Mapping[str, str] = field(default_factory=dict)
    instances: Callable[[RgbdFrame], UInt16] | None = None

    def is_right(self, row: int, label: str) -> bool:
        """Whether a label of the detector is a name of an object."""
        return self.class_of.get(label, label) in self.objects[row].names

    def sights(self, frame: RgbdFrame) -> dict[int, Sight]:
        """What a frame shows of each object that it has a part of, by row of `objects`."""
        if not self.objects:
            return {}
        steps = np.linspace(0.0, 1.0, GRID)
        grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
        low = np.array([item.low for item in self.objects])[:, None]
        high = np.array([item.high for item in self.objects])[:, None]
        T = invert_pose(frame.T_world_camera)
        points = (low + grid * (high - low)) @ T[:3, :3].T + T[:3, 3]
        in_front = points[..., 2] > NEAREST_M
        points[~in_front] = 1.0
        pixels = frame.intrinsics.project(points)
        size = np.array([frame.intrinsics.width, frame.intrinsics.height])
        shown = in_front & ((pixels >= 0) & (pixels <= size - 1)).all(axis=-1)
        image = None if self.instances is None else self.instances(frame)
        found = {}
        for row in np.flatnonzero(shown.any(axis=1)).tolist():
            window = pixels[row][in_front[row]]
            found[row] = self._sight(frame, row, float(shown[row].mean()), window, image)
        return found

    def _sight(
        self, frame: RgbdFrame, row: int, part: float, window: Float64, image: UInt16 | None
    ) -> Sight:
        """The pixels of an object in the window of the image around some pixels (n, 2)."""
        height, width = frame.depth_m.shape
        left, top = np.clip(np.floor(window.min(axis=0)), 0, [width - 1, height - 1]).astype(int)
        right, bottom = np.clip(np.ceil(window.max(axis=0)), 0, [width - 1, height - 1]).astype(int)
        area = (right - left + 1) * (bottom - top + 1)
        step = max(1, int(np.sqrt(area / MAX_SAMPLES)))
        v, u = np.mgrid[top : bottom + 1 : step, left : right + 1 : step]
        depths = frame.depth_m[v, u].astype(np.float64)
        if image is not None:
            mine = image[v, u] == int(self.objects[row].id)
        else:
            T = frame.T_world_camera
            points = frame.intrinsics.back_project(u, v, depths) @ T[:3, :3].T + T[:3, 3]
            mine = self.objects[row].contains(points, SURFACE_MARGIN_M) & (depths > 0)
        if not mine.any():
            return Sight(part)
        columns, rows = u[mine], v[mine]
        box = np.array([columns.min(), rows.min(), columns.max(), rows.max()], np.float64)
        measured = depths[mine & (depths > 0)]
        depth_m = float(np.median(measured)) if len(measured) else np.inf
        return Sight(part, float(len(columns) * step**2), box, depth_m)


def middle_of(frame: RgbdFrame, box_xyxy: Float64) -> Float64:
    """The point (3,), world, in the middle of a box (4,) of the image; NaN without depth there.

    Its depth is the median of the middle third of the box.
    """
    centre, half = (box_xyxy[:2] + box_xyxy[2:]) / 2, (box_xyxy[2:] - box_xyxy[:2]) / 6
    left, top = np.maximum(centre - half, 0.0).astype(int).tolist()
    right, bottom = np.maximum(centre + half, 0.0).astype(int).tolist()
    depths = frame.depth_m[top : bottom + 1, left : right + 1]
    depths = depths[depths > 0].astype(np.float64)
    if not len(depths):
        return np.full(3, np.nan)
    point = frame.intrinsics.back_project(centre[:1], centre[1:], np.median(depths, keepdims=True))
    T = frame.T_world_camera
    return np.asarray(point[0] @ T[:3, :3].T + T[:3, 3])


def read_marked(path: Path) -> Truth:
    """Objects of a file of boxes that somebody has marked.

    The file is JSON: ``{"objects": [...]}``. Each object has ``names``, ``coco`` or ``label``, its
    box as ``aabb`` (two corners) or as ``centroid_m`` and ``extent_m``, metres, world, and may have
    an ``id``. Those with ``optional`` true are left out.

    Raises:
        RecordingError: the file cannot be read; the text says what is wrong with which object.
    """
    content = read_json(path)
    found, number = [], 0
    try:
        listed = content["objects"]
        if not 0 < len(listed) <= MAX_MARKED:
            raise ValueError(f"{len(listed)} objects: expected 1 to {MAX_MARKED}")
        for number, item in enumerate(listed):
            if not item.get("optional"):
                found.append(_marked(number, item))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        where = f"{path}: object {number}"
        raise RecordingError(
            f"{where}: {type(error).__name__}: {error}; expected names and a box for each object"
        ) from error
    return Truth(tuple(found), MARKED_MARGIN_M)


def _marked(number: int, item: Mapping[str, Any]) -> TrueObject:
    names = item.get("names") or [item.get("coco") or item["label"]]
    if not (isinstance(names, list) and all(isinstance(name, str) and name for name in names)):
        raise ValueError(f"names {names}: expected a list of words")
    if "aabb" in item:
        box = np.array(item["aabb"], np.float64)
    else:
        half = np.array(item["extent_m"], np.float64) / 2
        box = np.array([-half, half]) + np.array(item["centroid_m"], np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] > box[1]).any():
        raise ValueError(f"box {box.tolist()}: expected two corners, the lower one first")
    return TrueObject(str(item.get("id", number)), tuple(names), box[0], box[1])
