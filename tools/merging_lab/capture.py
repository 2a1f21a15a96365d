"""Lift recordings once under each kind of fault, so that replay.py can try merging rules on them.

    python tools/merging_lab/capture.py ROOMS bags/demo_room KITCHEN --out CAPTURES

The detections, faults and poses are those of `deworldsg evaluate`. A capture that exists is kept.
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
    FrontEndChoice,
    Kind,
    PoseSource,
    build_front_end,
    repose,
)
from deworldsg_ros.evaluation.recorded_room import RecordedRoom, open_annotations
from deworldsg_ros.evaluation.rows import HARD, Condition
from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.pipeline import Perceiver
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.sequence import read_instances
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.recordings.source import Source
from deworldsg_ros.scene.arrays import Int64, UInt16
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import LocalGraph

BACKEND = "backend"
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
        for scan in scans_of(root, layout, options.scan):
            for kind in kinds:
                name = _name(scan or root.resolve().stem, kind, options.min_score, options.every)
                if (options.out / f"{name}{SUFFIX}").exists():
                    print(f"{name}: exists", flush=True)
                    continue
                start = time.monotonic()
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
    add("--min-score", type=float, help="minimum score of the backend's detections")
    add("--every", type=int, default=1, help="take every N-th frame")
    add("--config", type=Path, help="ROS parameter file; default: the built-in defaults")
    add("--settings", nargs="+", default=[], metavar="SECTION.FIELD=VALUE", help="set options")
    return parser


if __name__ == "__main__":
    main()
