"""IoU of the RGB-D segmenter with perfect masks, and its time per frame.

    python bench/segmenter_iou.py DATASET [--step 8] [--time]

DATASET is a folder in the layout of the rendered rooms: data/<scene>/sequence/frame-*.{color.jpg,
depth.pgm,instance.png,frontend.json}. Boxes are recorded detections. Each edge is off by 2 px. The
perfect masks cover the visible parts. Objects with more than 1000 visible pixels count. A pixel of
a mask is far outside if its point lies more than 10 cm from the surface of its object, whole and
without noise (labels.instances.annotated.v2.ply).

Two references: the box itself, and cv2.grabCut (colour only, three rounds, initialised with the
box). Times are processor times of one thread. Other work on the machine changes them little.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from deworldsg_ros.perception.backends.rgbd import RgbdSegmenter
from deworldsg_ros.scene.camera import Intrinsics, MaskPatch

INTRINSICS = Intrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
MIN_PIXELS = 1000
GRABCUT_ROUNDS = 3
FAR_M = 0.1


@dataclass
class Frame:
    """One frame, its boxes and their perfect masks."""

    scene: str
    rgb: np.ndarray
    depth_m: np.ndarray
    boxes_xyxy: np.ndarray
    names: list[str]
    masks: list[np.ndarray]
    objects: list[int]
    camera_to_world: np.ndarray


def load(path: Path) -> Frame:
    """The frame of a `color.jpg`."""

    def beside(suffix: str) -> Path:
        return path.with_name(path.name.replace("color.jpg", suffix))

    detections = json.loads(beside("frontend.json").read_text())["detections"]
    instances = cv2.imread(str(beside("instance.png")), cv2.IMREAD_UNCHANGED)
    depth_mm = cv2.imread(str(beside("depth.pgm")), cv2.IMREAD_UNCHANGED)
    return Frame(
        scene=path.parents[1].name,
        rgb=cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB),
        depth_m=depth_mm.astype(np.float32) / 1000.0,
        boxes_xyxy=np.array([d["box"] for d in detections], dtype=np.float64).reshape(-1, 4),
        names=[d["name"] for d in detections],
        masks=[instances == d["mask"]["value"] for d in detections],
        objects=[d["gt_id"] for d in detections],
        camera_to_world=np.loadtxt(beside("pose.txt")),
    )


def whole_boxes(frame: Frame) -> list[MaskPatch]:
    """Each box as a mask."""
    patches = []
    height, width = frame.depth_m.shape
    for box in frame.boxes_xyxy:
        x1, y1, x2, y2 = np.clip(np.round(box), 0, [width - 1, height - 1] * 2).astype(int)
        patches.append(MaskPatch(y1, x1, np.ones((y2 - y1 + 1, x2 - x1 + 1), dtype=bool)))
    return patches


def grab_cut(frame: Frame) -> list[MaskPatch]:
    """cv2.grabCut in a window of twice the box size, one box at a time."""
    patches = []
    height, width = frame.depth_m.shape
    bgr = np.ascontiguousarray(frame.rgb[..., ::-1])
    for box, whole in zip(frame.boxes_xyxy, whole_boxes(frame)):
        half = (box[2:] - box[:2]) / 2
        x1, y1 = np.clip(box[:2] - half, 0, None).astype(int)
        x2, y2 = np.minimum(box[2:] + half + 1, [width, height]).astype(int)
        labels = np.full((y2 - y1, x2 - x1), cv2.GC_BGD, np.uint8)
        rows, columns = whole.window
        inner = labels[rows.start - y1 : rows.stop - y1, columns.start - x1 : columns.stop - x1]
        inner[:] = cv2.GC_PR_FGD
        if (labels == cv2.GC_BGD).any():
            cv2.setRNGSeed(0)
            models = np.zeros((1, 65)), np.zeros((1, 65))
            cv2.grabCut(
                np.ascontiguousarray(bgr[y1:y2, x1:x2]),
                labels,
                None,
                *models,
                GRABCUT_ROUNDS,
                cv2.GC_INIT_WITH_MASK,
            )
        patches.append(
            MaskPatch(whole.top, whole.left, (inner == cv2.GC_PR_FGD) | (inner == cv2.GC_FGD))
        )
    return patches


def overlap(patch: MaskPatch, truth: np.ndarray) -> float:
    shared = int((patch.pixels & truth[patch.window]).sum())
    return shared / (int(patch.pixels.sum()) + int(truth.sum()) - shared)


def surfaces(scene: Path) -> dict[int, cKDTree]:
    """Samples of the surface of each object, metres, world frame."""
    content = (scene / "labels.instances.annotated.v2.ply").read_bytes()
    header, samples = content.split(b"end_header\n", 1)
    count = int(header.split(b"element vertex ")[1].split()[0])
    fields = [("xyz", "<f4", 3), ("rgb", "u1", 3), ("object", "<u2")]
    vertices = np.frombuffer(samples, fields, count)
    return {
        int(k): cKDTree(vertices["xyz"][vertices["object"] == k])
        for k in np.unique(vertices["object"])
    }


def far_outside(frame: Frame, patch: MaskPatch, truth: np.ndarray, surface: cKDTree) -> int:
    """The pixels of a mask beyond the truth that lie far from the surface of the object."""
    rows, columns = np.nonzero(patch.pixels & ~truth[patch.window])
    rows, columns = rows + patch.top, columns + patch.left
    z = frame.depth_m[rows, columns]
    x = (columns - INTRINSICS.cx) / INTRINSICS.fx * z
    y = (rows - INTRINSICS.cy) / INTRINSICS.fy * z
    camera = np.column_stack((x, y, z, np.ones_like(z)))[z > 0]
    world = (camera @ frame.camera_to_world.T)[:, :3]
    distances, _ = surface.query(world, distance_upper_bound=FAR_M)
    return int(np.isinf(distances).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--step", type=int, default=8, help="use every N-th frame")
    parser.add_argument("--time", action="store_true", help="also run and time grabCut, paired")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    segmenter = RgbdSegmenter()

    def ours(frame: Frame) -> list[MaskPatch]:
        return segmenter.segment(frame.rgb, frame.depth_m, INTRINSICS, frame.boxes_xyxy)

    methods: dict[str, Callable[[Frame], list[MaskPatch]]] = {
        "segmenter": ours,
        "box": whole_boxes,
    }
    if arguments.time:
        methods["grabCut"] = grab_cut
    results: dict[str, list[tuple[str, str, float]]] = {name: [] for name in methods}
    times: dict[str, list[float]] = {name: [] for name in methods}
    boxes: list[int] = []
    far, pixels = dict.fromkeys(methods, 0), dict.fromkeys(methods, 0)
    for scene in sorted(arguments.dataset.glob("data/*/sequence")):
        of_object = surfaces(scene.parent)
        for path in sorted(scene.glob("frame-*.color.jpg"))[:: arguments.step]:
            frame = load(path)
            if not len(frame.boxes_xyxy):
                continue
            if not boxes:
                ours(frame)  # compiles the kernels
            boxes.append(len(frame.boxes_xyxy))
            for name, method in methods.items():
                start = time.thread_time()
                patches = method(frame)
                times[name].append(time.thread_time() - start)
                for k, (patch, truth) in enumerate(zip(patches, frame.masks)):
                    if truth.sum() > MIN_PIXELS:
                        label, surface = frame.names[k], of_object[frame.objects[k]]
                        far[name] += far_outside(frame, patch, truth, surface)
                        pixels[name] += int(patch.pixels.sum())
                        results[name].append((frame.scene, label, overlap(patch, truth)))
    for name, rows in results.items():
        print(f"{name}: mean IoU {np.mean([iou for *_, iou in rows]):.3f} over {len(rows)} objects")
        print(
            f"  pixels far outside: {far[name]} of {pixels[name]}, {far[name] / pixels[name]:.2%}"
        )
        for scene in sorted({scene for scene, *_ in rows}):
            print(f"  {scene} {np.mean([iou for s, _, iou in rows if s == scene]):.3f}")
    by_class = defaultdict(list)
    for _, label, iou in results["segmenter"]:
        by_class[label].append(iou)
    ranked = sorted(by_class.items(), key=lambda item: -len(item[1]))
    print("  " + ", ".join(f"{label} {np.mean(v):.2f} ({len(v)})" for label, v in ranked))
    print(
        f"processor time, one thread: median {statistics.median(times['segmenter']) * 1e3:.1f} "
        f"ms per frame of {statistics.mean(boxes):.1f} boxes"
    )
    dozen = [t * 1e3 for t, n in zip(times["segmenter"], boxes) if 11 <= n <= 13]
    if dozen:
        print(f"  {statistics.median(dozen):.1f} ms at 11 to 13 boxes ({len(dozen)} frames)")
    if arguments.time:
        ratio = statistics.median(
            slow / fast for fast, slow in zip(times["segmenter"], times["grabCut"])
        )
        print(f"grabCut / segmenter, paired: {ratio:.0f}")


if __name__ == "__main__":
    main()
