"""Run of the pipeline on one scan, and evaluation of its graph.

`evaluate_scan` is a function of a picklable task, so that scans can run in other processes or on a
cluster. Its only side effect is the folder of its results.
"""

from __future__ import annotations

import logging
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from deworldsg_ros.checkpoints.probe_card import read_card
from deworldsg_ros.checkpoints.required import WORLD_MODELS, require_checkpoints
from deworldsg_ros.config import Config, RelationsConfig, to_yaml
from deworldsg_ros.evaluation.baselines import BASELINES, BaselinePipeline, build_baseline
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends.choice import FrontEndChoice, build_front_end
from deworldsg_ros.evaluation.measures.edge_list import EDGES_FILE, write_edge_list
from deworldsg_ros.evaluation.measures.graph_measures import (
    Measures,
    ReferenceScene,
    measure,
    read_reference,
)
from deworldsg_ros.evaluation.pose_sources import PoseSource, repose
from deworldsg_ros.evaluation.protocol.labels import translate
from deworldsg_ros.evaluation.protocol.scene_graphs import to_prediction
from deworldsg_ros.evaluation.protocol.scoring import ProtocolOptions, ScanResult, score_scan
from deworldsg_ros.evaluation.recorded_room import open_annotations
from deworldsg_ros.files import confined, together, write_atomically
from deworldsg_ros.pipeline import Perceiver, Pipeline
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.graph_file import GRAPH_FILE, write_graph
from deworldsg_ros.timing import device_name, total_ms

logger = logging.getLogger(__name__)

CONFIG_FILE = "config.yaml"
PIPELINE = "deworldsg"


@dataclass(frozen=True)
class ScanTask:
    """Input of `evaluate_scan`.

    Attributes:
        root: folder of the data set.
        layout: ``replica``, ``3rscan`` or ``recording``.
        scan: id of the scan.
        out: folder of all results; those of the scan are in ``out/SCAN``.
        config: configuration of the pipeline.
        front_end: source of detections.
        options: options of the protocol.
        dataset: options of the data set folder.
        every: process every N-th frame.
        max_frames: stop after this many frames; 0 = no limit.
        checkpoints: number of evaluations of the graph during the run, evenly spaced.
        method: the pipeline, or the name of a baseline.
        poses: source of poses.
    """

    root: Path
    layout: str
    scan: str
    out: Path
    config: Config
    front_end: FrontEndChoice
    options: ProtocolOptions
    dataset: DatasetOptions = DatasetOptions()
    every: int = 1
    max_frames: int = 0
    checkpoints: int = 0
    method: str = PIPELINE
    poses: PoseSource = PoseSource()


@dataclass(frozen=True)
class Checkpoint:
    """Recalls of the graph after a number of frames, and after a time since the first."""

    frames: int
    stamp_s: float
    nodes: int
    object_recall: float
    predicate_recall: float
    relationship_recall: float


@dataclass(frozen=True)
class ScanOutcome:
    """Output of `evaluate_scan`.

    Attributes:
        scan: id of the scan.
        result: ranks of the protocol.
        measures: measures beside the protocol.
        frames: number of frames processed.
        nodes, edges: size of the graph.
        times_ms: median milliseconds of each stage.
        total_ms: milliseconds of each stage, sum over all frames.
        device: device of the measured times.
        drops: number of frames and objects left out, by reason.
        over_time: checkpoints.
    """

    scan: str
    result: ScanResult
    measures: Measures
    frames: int
    nodes: int
    edges: int
    times_ms: dict[str, float]
    drops: dict[str, int]
    over_time: list[Checkpoint] = field(default_factory=list)
    total_ms: dict[str, float] = field(default_factory=dict)
    device: str = ""


def evaluate_scan(task: ScanTask) -> ScanOutcome:
    """Run one scan and evaluate its graph.

    The graph is written to ``out/SCAN/scene_graph.json``, and its edges beside the annotation to
    ``edges.csv`` there.

    Raises:
        DeWorldSGError: the scan cannot be read or evaluated.
    """
    uses_perception = task.front_end.kind == "backend"
    # A baseline has no world model.
    require_checkpoints(
        task.config.perception if uses_perception else None,
        task.config.relations if task.method == PIPELINE else None,
    )
    if task.method == PIPELINE:
        warn_of_training(task.config.relations, task.scan)
    with ExitStack() as opened:
        return _evaluate(task, opened)


def warn_of_training(config: RelationsConfig, scan: str) -> None:
    """Log a warning if the configured probe was trained on this scan."""
    if config.world_model not in WORLD_MODELS:
        return
    if scan in read_card(Path(config.probe_path).expanduser()).seen_groups:
        logger.warning(
            "scan %s was in the training of probe %s: its figures say nothing about other scans",
            scan,
            config.probe_path,
        )


def _evaluate(task: ScanTask, opened: ExitStack) -> ScanOutcome:
    annotations = open_annotations(task.root, task.layout)
    annotation = annotations.scan(task.scan)
    points = annotations.points(task.scan, aligned=task.options.aligned_ply)
    reference = read_reference(annotations, task.scan, points)
    source = open_source(annotations.scan_folder(task.scan), options=task.dataset)
    opened.callback(source.close)
    front_end = build_front_end(task.front_end, annotations, task.scan, source, task.config)
    pipeline = build_method(task.method, _with_relation_head(task), front_end)
    recording = Recording(source, task.config.inputs)
    total = len(range(0, recording.frame_count, task.every))
    total = min(total, task.max_frames or total)
    marks = {round(total * (i + 1) / task.checkpoints) for i in range(task.checkpoints)}
    refused: Counter[str] = Counter()
    over_time: list[Checkpoint] = []

    def score(graph: wire.SceneGraphMessage) -> ScanResult:
        prediction = to_prediction(
            translate(graph, annotations),
            annotations.vocabulary,
            sampled=task.method not in BASELINES,
        )
        return score_scan(annotation, points, prediction, task.options)

    frames = 0
    started_ns: int | None = None
    taken = islice(islice(recording.frames(), 0, None, task.every), total)
    for frame in repose(taken, task.poses, source, refused):
        started_ns = frame.stamp_ns if started_ns is None else started_ns
        try:
            pipeline.process(frame)
        except RefusedInput as refusal:
            refused[refusal.reason] += 1
            continue
        frames += 1
        if frames in marks:
            result = score(pipeline.graph())
            over_time.append(_checkpoint(frames, 1e-9 * (frame.stamp_ns - started_ns), result))
    if not frames:
        raise EvaluationError(f"scan {task.scan}: all frames were refused: {dict(refused)}")
    graph = pipeline.graph()
    measures = measure(translate(graph, annotations), reference)
    _write(task, graph, measures)
    return ScanOutcome(
        scan=task.scan,
        result=score(graph),
        measures=measures,
        frames=frames,
        nodes=len(graph.nodes),
        edges=len(graph.edges),
        times_ms={
            stage: 1e3 * float(np.median(times.newest_s))
            for stage, times in pipeline.times_s.items()
            if times.count
        },
        drops=dict(recording.drops + refused + pipeline.drops),
        over_time=over_time,
        total_ms=total_ms(pipeline.times_s),
        device=device_name(),
    )


def _with_relation_head(task: ScanTask) -> Config:
    """The configuration with the name of the relation head that runs.

    Recorded and annotated relations do not come from the configured head: the beliefs of edges
    take their votes as independent of the geometry.
    """
    config, kind = task.config, task.front_end.kind
    if kind not in ("recorded", "ground-truth"):
        return config
    return replace(config, perception=replace(config.perception, relation_head=kind))


def build_method(method: str, config: Config, front_end: Perceiver) -> Pipeline | BaselinePipeline:
    """The pipeline or a baseline, on the detections of the front end; raises EvaluationError."""
    if method == PIPELINE:
        return Pipeline(config, front_end)
    return BaselinePipeline(build_baseline(method), front_end)


def evaluate_graph(
    annotations: Annotations, scan: str, graph: wire.SceneGraphMessage, options: ProtocolOptions
) -> tuple[ScanResult, Measures]:
    """Score and measure a graph."""
    points = annotations.points(scan, aligned=options.aligned_ply)
    graph = translate(graph, annotations)
    prediction = to_prediction(graph, annotations.vocabulary)
    reference: ReferenceScene = read_reference(annotations, scan, points)
    result = score_scan(annotations.scan(scan), points, prediction, options)
    return result, measure(graph, reference)


def _checkpoint(frames: int, stamp_s: float, result: ScanResult) -> Checkpoint:
    def recall(ranks: list[int]) -> float:
        return sum(ranked == 0 for ranked in ranks) / len(ranks) if ranks else float("nan")

    return Checkpoint(
        frames,
        stamp_s,
        len(result.matching.supports),
        recall(result.object_ranks),
        recall(result.predicate_ranks),
        recall(result.relationship_ranks),
    )


def _write(task: ScanTask, graph: wire.SceneGraphMessage, measures: Measures) -> None:
    try:
        folder = confined(task.out, task.scan)
        with together(folder, (CONFIG_FILE, GRAPH_FILE, EDGES_FILE)) as staged:
            write_atomically(staged / CONFIG_FILE, to_yaml(task.config))
            write_graph(staged, graph)
            write_edge_list(staged / EDGES_FILE, measures.edges, measures.relations)
    except OSError as error:
        raise EvaluationError(f"--out {task.out}: cannot be written ({error.strerror})") from error
