"""Time of each part of perception on one 640x480 frame, and of cv2.grabCut.

    python bench/perception.py [IMAGE DEPTH_PNG_MM] [--rounds 15]

The default image is a drawn table with twelve objects. It prints wall-clock times and, in brackets,
processor times of all threads. Other work on the machine changes processor times little.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from segmenter_iou import Frame, grab_cut

from deworldsg_ros.perception.backends.embedded import NanoDetDetector
from deworldsg_ros.perception.backends.geometric import GeometricRelationHead
from deworldsg_ros.perception.backends.rgbd import RgbdSegmenter
from deworldsg_ros.perception.protocols import SegmentedObjects
from deworldsg_ros.perception.stage import instance_image
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.vocabulary import REPLICA_SSG_PREDICATES

WIDTH, HEIGHT, OBJECTS = 640, 480, 12
INTRINSICS = Intrinsics(525.0, 525.0, 319.5, 239.5, WIDTH, HEIGHT)
UP_CAMERA = np.array([0.0, -0.9, -0.436])


def drawn_scene() -> Frame:
    """Twelve objects of 50 to 130 pixels on a slanted table with a texture."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    depth = 2.6 - 1.4 * v / HEIGHT
    rgb = np.zeros((HEIGHT, WIDTH, 3))
    rgb[:] = (140, 100, 70)
    rgb += (12 * np.sin(u / 9 + 3 * np.sin(v / 40)))[..., None]
    boxes, masks = [], []
    for k in range(OBJECTS):
        row, column = divmod(k, 4)
        x, y = 80 + 160 * column + rng.uniform(-15, 15), 80 + 160 * row + rng.uniform(-15, 15)
        a, b = rng.uniform(25, 65, 2)
        mask = ((u - x) / a) ** 2 + ((v - y) / b) ** 2 < 1
        depth[mask] = (2.6 - 1.4 * (y + b) / HEIGHT) - 0.05 * (1 - ((u - x) / a)[mask] ** 2)
        rgb[mask] = rng.uniform(20, 230, 3)
        boxes.append([x - a, y - b, x + a, y + b])
        masks.append(mask)
    rgb += rng.normal(0, 4, rgb.shape)
    depth += rng.normal(0, 0.002, depth.shape)
    return Frame(
        "drawn",
        np.clip(rgb, 0, 255).astype(np.uint8),
        depth.astype(np.float32),
        np.array(boxes),
        ["cup"] * OBJECTS,
        masks,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("image", type=Path, nargs="?", help="640x480 image")
    parser.add_argument("depth", type=Path, nargs="?", help="16-bit PNG in millimetres")
    parser.add_argument("--rounds", type=int, default=15, help="number of measurements")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    frame = drawn_scene()
    detector = NanoDetDetector(threads=2)
    if arguments.image and arguments.depth:
        frame.rgb = cv2.cvtColor(cv2.imread(str(arguments.image)), cv2.COLOR_BGR2RGB)
        depth_mm = cv2.imread(str(arguments.depth), cv2.IMREAD_UNCHANGED)
        frame.depth_m = depth_mm.astype(np.float32) / 1000.0
        found = detector.detect(frame.rgb, 0.2)
        frame.boxes_xyxy = found.boxes_xyxy[:OBJECTS]
    segmenter, head = RgbdSegmenter(), GeometricRelationHead(REPLICA_SSG_PREDICATES)
    count = len(frame.boxes_xyxy)
    scores, classes = np.linspace(0.9, 0.5, count), np.arange(count)
    names = ["cup"] * count

    def segment() -> list:
        return segmenter.segment(frame.rgb, frame.depth_m, INTRINSICS, frame.boxes_xyxy)

    masks = segment()  # compiles the kernels
    instances = instance_image(masks, classes, scores, (HEIGHT, WIDTH))
    objects = SegmentedObjects(names, scores, None, instances, frame.depth_m, INTRINSICS, UP_CAMERA)
    parts: dict[str, Callable[[], object]] = {
        "detector, 2 threads": lambda: detector.detect(frame.rgb, 0.4),
        "segmenter, 1 thread": segment,
        "grabCut, 1 thread": lambda: grab_cut(frame),
        "instance image": lambda: instance_image(masks, classes, scores, (HEIGHT, WIDTH)),
        "relation head": lambda: head.relate(objects, max_relations=10),
    }
    wall: dict[str, list[float]] = {name: [] for name in parts}
    processor: dict[str, list[float]] = {name: [] for name in parts}
    for _ in range(arguments.rounds):
        for name, part in parts.items():
            start = time.perf_counter(), time.process_time()
            part()
            wall[name].append(time.perf_counter() - start[0])
            processor[name].append(time.process_time() - start[1])
    print(f"{count} boxes, {int((instances > 0).sum())} mask pixels, {arguments.rounds} rounds")
    for name in parts:
        print(
            f"  {name}: {statistics.median(wall[name]) * 1e3:.2f} ms "
            f"({statistics.median(processor[name]) * 1e3:.2f}), "
            f"minimum {min(wall[name]) * 1e3:.2f}"
        )
    ratio = statistics.median(
        slow / fast for slow, fast in zip(wall["grabCut, 1 thread"], wall["segmenter, 1 thread"])
    )
    print(f"  grabCut / segmenter, paired: {ratio:.0f}")


if __name__ == "__main__":
    main()
