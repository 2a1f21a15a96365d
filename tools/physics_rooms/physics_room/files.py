"""Writes a room in the layout of ReplicaSSG, with instance images and gt.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .labels import CLASSES, coco, visual_genome
from .plane import yaw_of
from .render import CX, CY, FOCAL_PX, HEIGHT, WIDTH, Frame
from .shapes import Item
from .truth import PREDICATES

SEEN_PX = 200
SEEN_SIDE_PX = 10
DETECTABLE_FRAMES = 5
VOXEL_M = 0.02
PLY_NAME = "labels.instances.annotated.v2.ply"
K = {"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": CX, "cy": CY}


class Seen:
    """Counts pixels and frames of each object and collects its visible voxels."""

    def __init__(self) -> None:
        self.frames: dict[int, int] = {}
        self.detectable: dict[int, int] = {}
        self.most_px: dict[int, int] = {}
        self._cells: list[NDArray[np.int32]] = []

    def add(
        self, frame: Frame, T_world_camera: NDArray[np.float64], boxes: NDArray[np.int64]
    ) -> None:
        """Add an exact frame; boxes are those of `visible_boxes`."""
        for number, x1, y1, x2, y2, count in boxes.tolist():
            self.frames[number] = self.frames.get(number, 0) + 1
            self.most_px[number] = max(self.most_px.get(number, 0), count)
            if count >= SEEN_PX and min(x2 - x1, y2 - y1) + 1 >= SEEN_SIDE_PX:
                self.detectable[number] = self.detectable.get(number, 0) + 1
        rows, columns = (a.ravel() for a in np.mgrid[0:HEIGHT:2, 0:WIDTH:2])
        z, owner = frame.depth_m[rows, columns], frame.instances[rows, columns]
        keep = z > 0
        z, rows, columns = z[keep], rows[keep], columns[keep]
        camera = np.column_stack([(columns - CX) * z / FOCAL_PX, (rows - CY) * z / FOCAL_PX, z])
        world = camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        cells = np.floor(world / VOXEL_M).astype(np.int64)
        key = ((owner[keep].astype(np.int64) << 48) | ((cells[:, 0] + 32768) << 32)
               | ((cells[:, 1] + 32768) << 16) | (cells[:, 2] + 32768))  # fmt: skip
        self._cells.append(np.unique(key))

    def centroids(self) -> dict[int, list[float]]:
        """Mean of the visible voxels by object, world, m."""
        keys = np.unique(np.concatenate(self._cells))
        owner = keys >> 48
        cells = np.column_stack([(keys >> s) & 0xFFFF for s in (32, 16, 0)]) - 32768
        return {
            int(n): _rounded((cells[owner == n].mean(0) + 0.5) * VOXEL_M)
            for n in np.unique(owner)
            if n
        }


def visible_boxes(instances: NDArray[np.uint16]) -> NDArray[np.int64]:
    """id, x1, y1, x2, y2 (inclusive) and pixels of each object in view (n, 6)."""
    rows = []
    counts = np.bincount(instances.ravel())
    for number in np.flatnonzero(counts):
        if number:
            mask = instances == number
            ys, xs = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
            rows.append((number, xs[0], ys[0], xs[-1], ys[-1], counts[number]))
    return np.array(rows, np.int64).reshape(-1, 6)


class SceneWriter:
    """Writes the frames of one room into DATA/NAME/sequence."""

    def __init__(self, root: Path, name: str, vocabulary: dict[str, list[str]]) -> None:
        self.folder = root / "data" / name
        self.sequence = self.folder / "sequence"
        self.sequence.mkdir(parents=True, exist_ok=True)
        self.name = name
        self.classes = vocabulary["VisualGenome_list"]

    def info(self, frames: int) -> None:
        """_info.txt with the calibration."""
        matrix = f"{FOCAL_PX} 0 {CX} 0 0 {FOCAL_PX} {CY} 0 0 0 1 0 0 0 0 1"
        unit = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
        lines = [
            "m_versionNumber = 4", "m_sensorName = physics_rooms (rendered)",
            f"m_colorWidth = {WIDTH}", f"m_colorHeight = {HEIGHT}",
            f"m_depthWidth = {WIDTH}", f"m_depthHeight = {HEIGHT}", "m_depthShift = 1000",
            f"m_calibrationColorIntrinsic = {matrix}", f"m_calibrationColorExtrinsic = {unit}",
            f"m_calibrationDepthIntrinsic = {matrix}", f"m_calibrationDepthExtrinsic = {unit}",
            f"m_frames.size = {frames}",
        ]  # fmt: skip
        (self.sequence / "_info.txt").write_text("\n".join(lines) + "\n")

    def frame(
        self,
        index: int,
        frame: Frame,
        depth_mm: NDArray[np.uint16],
        T_world_camera: NDArray[np.float64],
        detections: list[dict[str, Any]],
        boxes: NDArray[np.int64],
    ) -> None:
        """All files of one frame."""
        stem = self.sequence / f"frame-{index:06d}"
        cv2.imwrite(f"{stem}.color.jpg", frame.color_bgr, [cv2.IMWRITE_JPEG_QUALITY, 90])
        header = f"P5\n{WIDTH} {HEIGHT}\n65535\n".encode()
        Path(f"{stem}.depth.pgm").write_bytes(header + depth_mm.astype(">u2").tobytes())
        cv2.imwrite(f"{stem}.instance.png", frame.instances, [cv2.IMWRITE_PNG_COMPRESSION, 3])
        rows = [" ".join(f"{v:.9g}" for v in row) for row in T_world_camera]
        Path(f"{stem}.pose.txt").write_text("\n".join(rows) + "\n")
        lines = [" ".join(map(str, row[:5])) for row in boxes.tolist()]
        Path(f"{stem}.bb.txt").write_text("\n".join(lines) + "\n")
        record = {
            "version": 1,
            "scene": self.name,
            "frame": index,
            "flip_rate": 0.0,
            "width": WIDTH,
            "height": HEIGHT,
            "detections": detections,
            "relations": [],
        }
        Path(f"{stem}.frontend.json").write_text(json.dumps(record))

    def detections(
        self, index: int, boxes: NDArray[np.int64], labels: dict[int, str], rng: np.random.Generator
    ) -> list[dict[str, Any]]:
        """Recorded detections: nine of ten objects with enough pixels, with boxes that tremble."""
        found = []
        for number, x1, y1, x2, y2, count in boxes.tolist():
            name = visual_genome(labels.get(number, ""))
            if name is None or count < SEEN_PX or min(x2 - x1, y2 - y1) + 1 < SEEN_SIDE_PX:
                continue
            jitter = rng.normal(0, 2, 4)
            score = float(rng.uniform(0.7, 0.97))
            if rng.random() > 0.9:
                continue
            top = self.classes.index(name)
            limits = np.array([WIDTH - 1, HEIGHT - 1] * 2)
            box = np.clip(np.array([x1, y1, x2, y2]) + jitter, 0, limits)
            found.append(
                {
                    "box": _rounded(box, 2),
                    "top": top,
                    "name": name,
                    "score": round(score, 4),
                    "probs": [[top, round(score, 4)]],
                    "rest": round(1 - score, 4),
                    "gt_id": number,
                    "gt_class": top,
                    "mask": {"png": f"frame-{index:06d}.instance.png", "value": number},
                }
            )
        return found


def object_record(
    item: Item, spin: NDArray[np.float64], seen: Seen, centroids: dict[int, list[float]]
) -> dict[str, Any]:
    """The entry of an item in gt.json, in the world frame."""
    n = item.number
    shell = item.kind == "shell"
    points = item.vertices() @ spin.T
    rotation = spin @ item.rotation
    low, high = item.bounds()
    frames = seen.detectable.get(n, 0)
    return {
        "id": n,
        "label": item.label,
        "vg": visual_genome(item.label),
        "coco": coco(item.label),
        "aabb": None if shell else [_rounded(points.min(0)), _rounded(points.max(0))],
        "obb": None if shell else {
            "center": _rounded(spin @ item.position + rotation @ ((low + high) / 2)),
            "size": _rounded(high - low), "rotation": [_rounded(row) for row in rotation],
        },
        "surface_centroid": None if shell else _rounded(surface_samples(item).mean(0) @ spin.T),
        "pose": None if shell else _rounded([*(spin @ item.position), yaw_of(rotation)]),
        "kind": item.kind,
        "frames_seen": seen.frames.get(n, 0),
        "max_px": seen.most_px.get(n, 0),
        "frames_detectable": frames,
        "detectable": bool(frames >= DETECTABLE_FRAMES and visual_genome(item.label)),
        "visible_centroid": centroids.get(n),
    }  # fmt: skip


def surface_samples(item: Item, spacing_m: float = 0.015) -> NDArray[np.float64]:
    """Points (n, 3) evenly over the visible surface, frame of the room; the same ones each time."""
    rng = np.random.default_rng(item.number)
    found = []
    for part in item.parts:
        if not part.visible:
            continue
        a, b, c = (part.mesh.vertices[part.mesh.faces[:, k]] for k in range(3))
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        count = max(4, int(areas.sum() / spacing_m**2))
        face = rng.choice(len(areas), count, p=areas / areas.sum())
        u, v = rng.random((2, count, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        found.append(a[face] + u * (b - a)[face] + v * (c - a)[face])
    return np.concatenate(found) @ item.rotation.T + item.position


def write_ply(path: Path, items: list[Item], spin: NDArray[np.float64]) -> None:
    """Surface points of all items with their ids."""
    clouds = [surface_samples(i, 0.06 if i.kind == "shell" else 0.015) @ spin.T for i in items]
    points = np.concatenate(clouds)
    fields = [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("r", "u1"),
        ("g", "u1"),
        ("b", "u1"),
        ("objectId", "<u2"),
    ]
    rows = np.zeros(len(points), np.dtype(fields))
    rows["x"], rows["y"], rows["z"] = points.T
    rows["r"], rows["g"], rows["b"] = 128, 128, 128
    rows["objectId"] = np.repeat([i.number for i in items], [len(c) for c in clouds])
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {color}" for color in ("red", "green", "blue")]
    header += ["property ushort objectId", "end_header\n"]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())


def write_annotations(
    root: Path, vocabulary: dict[str, list[str]], splits: dict[str, list[str]]
) -> None:
    """ReplicaSSG/ for all rooms whose gt.json exists."""
    folder = root / "ReplicaSSG"
    folder.mkdir(parents=True, exist_ok=True)
    scans, relations = [], []
    for path in sorted((root / "data").glob("*/gt.json")):
        truth = json.loads(path.read_text())
        kept = [
            o for o in truth["objects"] if o["detectable"] or (o["vg"] is None and o["frames_seen"])
        ]
        numbers = {o["id"] for o in kept if o["vg"]}
        scans.append(
            {
                "scan": truth["scan"],
                "objects": [{"label": o["label"], "id": str(o["id"])} for o in kept],
            }
        )
        rows = [r for r in truth["relationships"] if r[0] in numbers and r[1] in numbers]
        relations.append({"scan": truth["scan"], "relationships": rows})
    mapping = {label: names[0] for label, names in CLASSES.items()} | dict.fromkeys(
        ("wall", "floor", "ceiling", "rug"), "unknown"
    )
    _write(folder / "objects.json", {"scans": scans})
    _write(folder / "relationships.json", {"scans": relations})
    _write(
        folder / "replica_to_visual_genome.json", {"Replica2VisualGenome": mapping, **vocabulary}
    )
    done = {scan["scan"] for scan in scans}
    for split, names in splits.items():
        (folder / f"{split}_scans.txt").write_text("".join(f"{n}\n" for n in names if n in done))


def check_vocabulary(vocabulary: dict[str, list[str]]) -> None:
    """Raises ValueError if a class or predicate is not in the Visual Genome lists."""
    classes = {names[0] for names in CLASSES.values()} - set(vocabulary["VisualGenome_list"])
    wrong = [p for p, k in PREDICATES.items() if vocabulary["VisualGenome_rel"][k] != p]
    if classes or wrong:
        raise ValueError(f"not in the vocabulary: {sorted(classes)} {wrong}")


def _write(path: Path, content: Any) -> None:
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(content))
    temporary.replace(path)


def _rounded(values: Any, digits: int = 4) -> list[float]:
    return [round(float(v), digits) for v in values]
