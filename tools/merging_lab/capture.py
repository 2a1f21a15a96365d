"""Lift recordings once under each kind of fault, so that replay.py can try merging rules on them.

    python tools/merging_lab/capture.py ROOMS bags/demo_room KITCHEN --out CAPTURES

The detections, faults and poses are those of `deworldsg evaluate`. A capture that exists is kept.
`--marked FILE` lifts true boxes of a recording whose objects are marked as boxes in the world.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path

import numpy as np
from captures import SUFFIX, Capture, write_capture

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.front_ends import (
    TRUE_PROBABILITY,
    AnnotatedBoxes,
    FrontEndChoice,
    Kind,
    PoseSource,
    build_front_end,
    repose,
)
from deworldsg_ros.evaluation.injection import Detection, spread
from deworldsg_ros.evaluation.recorded_room import (
    NEAREST_M,
    RecordedRoom,
    TrueObject,
    open_annotations,
    read_marked,
)
from deworldsg_ros.evaluation.rows import HARD, Condition
from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.pipeline import Perceiver
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.sequence import read_instances
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.recordings.source import Source
from deworldsg_ros.scene.arrays import Float64, Int64, UInt16
from deworldsg_ros.scene.camera import AXES, RgbdFrame, invert_pose
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.scene.vocabulary import COCO_CLASSES, TABLES

BACKEND = "backend"
MARKED = "boxes"
# The conditions of `deworldsg evaluate table hard`, and those of its tables main and pose.
CONDITIONS = {
    **{"clean" if item.name == "plain" else item.name: item for item in HARD},
    "flip": Condition("flip", flip=0.1),
    "drift": Condition("drift", poses=PoseSource("perturbed")),
    "odometry": Condition("odometry", poses=PoseSource("odometry")),
}
KINDS = (*CONDITIONS, BACKEND)
KINDS_BY_LAYOUT = {"replica": KINDS, "recording": ("clean", BACKEND), "": (BACKEND,)}
# A data set with this file of a frame has recorded detections.
RECORDED = "sequence/frame-000000.frontend.json"


def main(arguments: Sequence[str] | None = None) -> None:
    """Capture every kind of every data set."""
    options = _parser().parse_args(arguments)
    settings = list(options.settings)
    if options.min_score is not None:
        settings.append(f"perception.score_threshold={options.min_score}")
    config = effective_config(options.config, settings)
    options.out.mkdir(parents=True, exist_ok=True)
    for root in options.data:
        layout = layout_of(root)
        kinds = options.kinds.split(",") if options.kinds else KINDS_BY_LAYOUT[layout]
        if options.marked is not None:
            kinds = (MARKED,)
        for scan in scans_of(root, layout, options.scan):
            for kind in kinds:
                name = _name(scan or root.resolve().stem, kind, options.min_score, options.every)
                if (options.out / f"{name}{SUFFIX}").exists():
                    print(f"{name}: exists", flush=True)
                    continue
                start = time.monotonic()
                if kind == MARKED:
                    capture = capture_marked(name, root, config, options.every, options.marked)
                else:
                    capture = make_capture(
                        name, root, layout, scan, kind, config, options.every, known=options.known
                    )
                write_capture(options.out, capture)
                seconds = time.monotonic() - start
                print(f"{name}: {len(capture.local_graphs)} frames, {seconds:.0f} s", flush=True)


def layout_of(root: Path) -> str:
    """``replica``, ``recording`` (ground truth beside it) or empty: no annotation."""
    if (root / "ReplicaSSG").is_dir():
        return "replica"
    whole = root.resolve()
    return "recording" if whole.with_name(f"{whole.stem}.gt.json").exists() else ""


def scans_of(root: Path, layout: str, chosen: Sequence[str]) -> list[str]:
    """The chosen scans, else those of the test split; one without a name if there are no scans."""
    if not layout:
        return [""]
    if layout == "recording":
        return open_annotations(root, layout).scans()
    return list(chosen) or open_annotations(root, layout).scans("test")


def make_capture(
    name: str,
    root: Path,
    layout: str,
    scan: str,
    kind: str,
    config: Config,
    every: int = 1,
    known: Kind | None = None,
) -> Capture:
    """Lift every N-th frame of a scan with the detections and poses of a kind.

    Known detections are `known`; None = recorded ones if there are any, else ground truth.

    Raises:
        DeWorldSGError: the data set cannot be read.
        SystemExit: a kind that is unknown, or that needs annotations.
    """
    if kind not in KINDS or (kind != BACKEND and not layout):
        expected = ", ".join(KINDS if layout else KINDS_BY_LAYOUT[layout])
        raise SystemExit(f"kind {kind} of {root}: expected {expected}")
    condition = CONDITIONS.get(kind, Condition(kind))
    with ExitStack() as opened:
        annotations = open_annotations(root, layout) if layout else None
        source = open_source(annotations.scan_folder(scan) if annotations else root)
        opened.callback(source.close)
        if known is None and annotations is not None:
            recorded = (annotations.scan_folder(scan) / RECORDED).exists()
            known = "recorded" if recorded else "ground-truth"
        choice = FrontEndChoice()
        if known is not None and kind != BACKEND:
            choice = condition.apply(FrontEndChoice(known))
        front_end, head = _front_end(choice, annotations, scan, source, config)
        frames = islice(Recording(source, config.inputs).frames(), 0, None, every)
        frames = repose(frames, condition.poses or PoseSource(), source, Counter())
        graphs, object_ids = [], []
        for local, ids in _lifted(frames, front_end, config, _truth(annotations, source)):
            graphs.append(local)
            object_ids.append(ids)
    known = [ids for ids in object_ids if ids is not None]
    return Capture(name, root.resolve(), layout, scan, head, graphs, known)


def _front_end(
    choice: FrontEndChoice,
    annotations: Annotations | None,
    scan: str,
    source: Source,
    config: Config,
) -> tuple[Perceiver, str]:
    """The front end, and the name of its relation head."""
    head = config.perception.relation_head if choice.kind == BACKEND else choice.kind
    if annotations is None:
        return build_perception(config.perception, world_up=config.inputs.world_up), head
    return build_front_end(choice, annotations, scan, source, config), head


def _truth(annotations: Annotations | None, source: Source) -> Callable[[RgbdFrame], UInt16 | None]:
    """The instance image of a frame: ids of annotated objects; None = not available."""
    if isinstance(annotations, RecordedRoom):
        return lambda frame: annotations.instances(frame.stamp_ns)
    return lambda frame: read_instances(source, frame.stamp_ns)


def _lifted(
    frames: Iterator[RgbdFrame],
    front_end: Perceiver,
    config: Config,
    truth: Callable[[RgbdFrame], UInt16 | None],
) -> Iterator[tuple[LocalGraph, Int64 | None]]:
    """The local graph of each frame that is not refused, and the true objects of its rows."""
    lifting = Lifting(config.lifting)
    for frame in frames:
        try:
            perceived = front_end.perceive(frame)
            local = lifting.lift_frame(perceived.frame_graph, perceived.instances, frame)
        except RefusedInput:
            continue
        true_ids = truth(frame)
        if true_ids is None:
            yield local, None
            continue
        masks = (perceived.instances == number for number in local.instance_ids)
        most = [np.bincount(true_ids[mask]).argmax() if mask.any() else 0 for mask in masks]
        yield local, np.array(most, np.int64)


# --- True boxes of objects that are marked as boxes in the world.
#
# The box of a frame is around the visible part of the object's shape. The shape is the surface that
# the recording measures in the marked box. If that is little of it, as of thin tubes and black
# plastic, the shape is an upright cylinder that fills the marked box.

CELL_M, MIN_FRAMES, MIN_CELLS, MEASURED_FRACTION = 0.03, 3, 5, 0.6
# What bears an object is in the lowest part of its box. The box of a chair at a table may contain
# the table's top, and what is on it.
BEARER_M, TABLE_M = 0.05, 0.15
# A box is drawn around that many points; depth this far in front of a point hides it.
CYLINDER_POINTS = 6000
HIDDEN_M = 0.08
# A detector sees no less of an object: part in the image, part of that not hidden, sides in pixels.
MIN_IN_IMAGE, MIN_VISIBLE, MIN_SIDE_PX = 0.1, 0.25, 10.0
# Points that are off, at each side of a box.
OUTLIERS = 0.01


class MarkedBoxes:
    """Perception with true boxes and names instead of a detector.

    Args:
        objects: that are marked.
        shapes: points (k, 3) of each, world.
        config: of perception.
    """

    def __init__(
        self, objects: Sequence[TrueObject], shapes: Sequence[Float64], config: Config
    ) -> None:
        names = [COCO_CLASSES.index(item.names[0]) for item in objects]
        self._classes = [spread({name: TRUE_PROBABILITY}, len(COCO_CLASSES)) for name in names]
        self._shapes = shapes
        self._detector = AnnotatedBoxes(COCO_CLASSES)
        self._perception = build_perception(
            config.perception, world_up=config.inputs.world_up, detector=self._detector
        )
        self.vocabulary = self._perception.vocabulary

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The objects of a frame, with our masks and relations."""
        boxes = [visible_box(frame, points) for points in self._shapes]
        self._detector.detections = [
            Detection(box, classes, TRUE_PROBABILITY, row + 1)
            for row, (box, classes) in enumerate(zip(boxes, self._classes))
            if box is not None
        ]
        return self._perception.perceive(frame)


def capture_marked(name: str, root: Path, config: Config, every: int, marked: Path) -> Capture:
    """Lift every N-th frame of a recording with true boxes of its marked objects."""
    objects = read_marked(marked).objects
    with ExitStack() as opened:
        source = open_source(root)
        opened.callback(source.close)
        shapes = shapes_of(
            objects, Recording(source, config.inputs).frames(), config.inputs.world_up
        )
        frames = islice(Recording(source, config.inputs).frames(), 0, None, every)
        front_end = MarkedBoxes(objects, shapes, config)
        graphs = [local for local, _ in _lifted(frames, front_end, config, lambda _: None)]
    return Capture(name, root.resolve(), "", "", config.perception.relation_head, graphs, [])


def shapes_of(
    objects: Sequence[TrueObject], frames: Iterator[RgbdFrame], world_up: str
) -> list[Float64]:
    """Points (k, 3) of the shape of each marked object, world."""
    hits: list[Counter[tuple[int, ...]]] = [Counter() for _ in objects]
    # A point in several boxes is of the smallest.
    order = sorted(range(len(objects)), key=lambda row: -np.prod(_size(objects[row])))
    for frame in islice(frames, 0, None, 2):
        v, u = np.nonzero(frame.depth_m > 0)
        T = frame.T_world_camera
        points = frame.intrinsics.back_project(u, v, frame.depth_m[v, u].astype(np.float64))
        points = points @ T[:3, :3].T + T[:3, 3]
        owner = np.full(len(points), -1)
        for row in order:
            owner[objects[row].contains(points, 0.0)] = row
        for row in np.unique(owner[owner >= 0]).tolist():
            cells = np.unique(np.floor(points[owner == row] / CELL_M).astype(int), axis=0)
            hits[row].update(map(tuple, cells.tolist()))
    unit = np.random.default_rng(0).uniform(-1, 1, (CYLINDER_POINTS, 3))
    around = np.delete(unit, max("xyz".find(world_up[-1]), 0), axis=1)
    cylinder = unit[(around**2).sum(axis=1) < 1]
    shapes = []
    for item, counts in zip(objects, hits):
        cells = [cell for cell, count in counts.items() if count >= MIN_FRAMES]
        points = (np.array(cells, np.float64).reshape(-1, 3) + 0.5) * CELL_M
        points = _without_bearers(item, points, objects, world_up)
        is_measured = len(points) >= MIN_CELLS
        if not is_measured or (np.ptp(points, axis=0) < MEASURED_FRACTION * _size(item)).any():
            points = (item.low + item.high) / 2 + cylinder * _size(item) / 2
            points = _without_bearers(item, points, objects, world_up)
        shapes.append(points)
    return shapes


def _without_bearers(
    item: TrueObject, points: Float64, objects: Sequence[TrueObject], world_up: str
) -> Float64:
    """The points without what bears the object, and without the tables that it is pushed under."""
    if world_up == "auto":
        return points
    up = np.array(AXES[world_up])
    heights, level = points @ up, up == 0.0
    bottom = min(item.low @ up, item.high @ up)
    kept = heights > bottom + BEARER_M
    for other in objects:
        top = max(other.low @ up, other.high @ up)
        if other is not item and other.names[0] in TABLES and bottom < top - TABLE_M:
            inside = ((points > other.low) & (points < other.high))[:, level].all(axis=1)
            kept &= ~(inside & (heights > top - TABLE_M))
    return points[kept]


def visible_box(frame: RgbdFrame, points_world: Float64) -> Float64 | None:
    """The box (4,) around the visible points (k, 3) of an object; None if they are too few."""
    T = invert_pose(frame.T_world_camera)
    points = points_world @ T[:3, :3].T + T[:3, 3]
    points = points[points[:, 2] > NEAREST_M]
    pixels = frame.intrinsics.project(points)
    height, width = frame.depth_m.shape
    inside = ((pixels >= 0) & (pixels < [width - 0.5, height - 0.5])).all(axis=1)
    if inside.sum() < max(MIN_IN_IMAGE * len(points_world), 1):
        return None
    u, v = pixels[inside].round().astype(int).T
    depth_m = frame.depth_m[np.minimum(v, height - 1), np.minimum(u, width - 1)]
    visible = (depth_m <= 0) | (depth_m > points[inside, 2] - HIDDEN_M)
    if visible.mean() < MIN_VISIBLE:
        return None
    low, high = np.quantile(pixels[inside][visible], [OUTLIERS, 1 - OUTLIERS], axis=0)
    return np.concatenate([low, high]) if (high - low).min() >= MIN_SIDE_PX else None


def _size(item: TrueObject) -> Float64:
    return item.high - item.low


def _name(scene: str, kind: str, min_score: float | None, every: int) -> str:
    if kind == BACKEND and min_score is not None:
        kind += f"-{min_score:g}"
    return f"{scene}.{kind}" + (f".every{every}" if every > 1 else "")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("data", nargs="+", type=Path, help="data set in ReplicaSSG's layout, or a recording")
    add("--out", required=True, type=Path, help="folder of the captures")
    add("--kinds", default="", help=f"of {','.join(KINDS)}; default: all that the data allow")
    add("--scan", nargs="+", default=[], help="scans of the data sets; default: the test split")
    choices = ("recorded", "ground-truth")
    add("--known", choices=choices, help="known detections; default: recorded if there are any")
    add("--marked", type=Path, help="file of boxes, as `evaluate losses` takes: true boxes")
    add("--min-score", type=float, help="minimum score of the backend's detections")
    add("--every", type=int, default=1, help="take every N-th frame")
    add("--config", type=Path, help="ROS parameter file; default: the built-in defaults")
    add("--settings", nargs="+", default=[], metavar="SECTION.FIELD=VALUE", help="set options")
    return parser


if __name__ == "__main__":
    main()
