"""Run of the pipeline on one scan, and evaluation of its graph.

`evaluate_scan` is a function of a picklable task, so that scans can run in other processes or on a
cluster. Its only side effect is the folder of its results.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace

from deworldsg_ros.base.files import confined, together, write_atomically
from deworldsg_ros.base.timing import device_name, total_ms
from deworldsg_ros.checkpoints.cards import read_probe_card
from deworldsg_ros.checkpoints.catalogue import WORLD_MODELS, require_checkpoints
from deworldsg_ros.config import Config, RelationsConfig, to_yaml
from deworldsg_ros.evaluation.baselines import BASELINES, BaselinePipeline, build_baseline
from deworldsg_ros.evaluation.edge_measures import EDGES_FILE, write_edge_list
from deworldsg_ros.evaluation.front_ends import FrontEndChoice, PoseSource, build_front_end, repose
from deworldsg_ros.evaluation.graph_measures import (
    Measures,
    ReferenceScene,
    measure,
    read_reference,
)
from deworldsg_ros.evaluation.predictions import ScanPrediction
from deworldsg_ros.evaluation.recorded_room import open_annotations
from deworldsg_ros.evaluation.scoring import ProtocolOptions, ScanResult, score_scan
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.graph.graph_files import GRAPH_FILE, write_graph
from deworldsg_ros.pipeline import Perceiver, Pipeline
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import EvaluationError, RecordingError, RefusedInput
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.wire import messages as wire

# --- Translation of detector labels to the classes of a data set.
#
# The protocol scores classes of the data set. A label that is a class stays. Other labels (of COCO)
# are translated by the data set's own mapping, else by the synonyms below. A label without a
# translation stays, and its probability counts for no class.

# COCO classes to labels or classes of the data sets, the first known one counts.
SYNONYMS: dict[str, tuple[str, ...]] = {
    "apple": ("fruit",),
    "bicycle": ("bike",),
    "cell phone": ("phone",),
    "couch": ("sofa",),
    "dining table": ("table",),
    "keyboard": ("computer-keyboard",),
    "oven": ("major-appliance",),
    "potted plant": ("indoor-plant", "plant"),
    "suitcase": ("bag",),
    "tv": ("tv-screen", "tv"),
    "wine glass": ("glass",),
}


def translation(annotations: Annotations) -> dict[str, str]:
    """Class by label, for labels that are not classes themselves."""
    classes = set(annotations.vocabulary.classes)
    known = {label: name for label, name in annotations.class_of_label.items() if name in classes}
    for label, names in SYNONYMS.items():
        for name in (label, *names):
            found = name if name in classes else known.get(name)
            if found is not None:
                known.setdefault(label, found)
    return {label: name for label, name in known.items() if label not in classes}


def translate(graph: wire.SceneGraphMessage, annotations: Annotations) -> wire.SceneGraphMessage:
    """The graph with classes of the data set; probabilities of labels of one class are added.

    The label is the most probable class, also of a node without a name.

    Mutual edges are in both directions, as in the ground truth.
    """
    if any(edge.mutual is True for edge in graph.edges):
        graph = msgspec.structs.replace(graph, edges=_both_directions(graph.edges))
    names = translation(annotations)
    if not any(belief.label in names for node in graph.nodes for belief in node.classes):
        names = {}
        if all(node.named for node in graph.nodes):
            return graph
    nodes = []
    for node in graph.nodes:
        sums: dict[str, float] = {}
        for belief in node.classes:
            label = names.get(belief.label, belief.label)
            sums[label] = sums.get(label, 0.0) + belief.probability
        # A stable sort: labels with equal probability keep their order.
        beliefs = [
            wire.Belief(label, min(probability, 1.0))
            for label, probability in sorted(sums.items(), key=lambda item: -item[1])
        ]
        label = beliefs[0].label if beliefs else node.label
        nodes.append(msgspec.structs.replace(node, classes=beliefs, label=label))
    return msgspec.structs.replace(graph, nodes=nodes)


def _both_directions(edges: Sequence[wire.EdgeState]) -> list[wire.EdgeState]:
    swapped = [
        msgspec.structs.replace(edge, subject=edge.object, object=edge.subject)
        for edge in edges
        if edge.mutual is True
    ]
    return sorted([*edges, *swapped], key=lambda edge: (edge.subject, edge.object))


# --- Conversion of scene graphs of this package to predictions of the protocol.

# About the number of surface points that one observation adds to a node.
POINTS_PER_OBSERVATION = 64


def to_prediction(
    graph: wire.SceneGraphMessage, vocabulary: Vocabulary, *, sampled: bool = True
) -> ScanPrediction:
    """Nodes with their surface points, edges with their predicate distributions, in graph order.

    Of several predictions for one object the protocol takes the one with most points. A graph
    stores a bounded sample of each surface; therefore the first `POINTS_PER_OBSERVATION` points
    count once per observation of the node.

    A graph contains the k most probable labels. The rest of the probability is spread evenly over
    the other labels. Classes outside the vocabulary are left out (see `labels`).

    Args:
        graph: scene graph with surface points.
        vocabulary: classes and predicates of the data set.
        sampled: False if the graph contains all points of a node; then each point counts once.

    Raises:
        EvaluationError: all classes, or some predicate, are outside the vocabulary.
    """
    classes = {name: index for index, name in enumerate(vocabulary.classes)}
    predicates = {name: index for index, name in enumerate(vocabulary.predicates)}
    index_of = {node.id: index for index, node in enumerate(graph.nodes)}
    points = tuple(_segment(node) if sampled else surface_points(node) for node in graph.nodes)
    labels = {belief.label for node in graph.nodes for belief in node.classes}
    if labels and not labels & set(classes):
        raise _foreign("class", labels)
    unknown = {belief.label for edge in graph.edges for belief in edge.predicates} - set(predicates)
    if unknown:
        raise _foreign("predicate", unknown)
    class_scores = [_expand(node.classes, classes) for node in graph.nodes]
    edge_scores = [_expand(edge.predicates, predicates) for edge in graph.edges]
    edges = [(index_of[edge.subject], index_of[edge.object]) for edge in graph.edges]
    return ScanPrediction(
        points,
        np.array(class_scores).reshape(-1, len(classes)),
        np.array(edges, np.int64).reshape(-1, 2),
        np.array(edge_scores).reshape(-1, len(predicates)),
        [] if all(map(len, points)) else ["a node has no surface points: it supports no object"],
    )


def _segment(node: wire.NodeState) -> Float64:
    """Points (n, 3) of a node. The stored sample is in random order, so its start is random too."""
    return np.tile(surface_points(node)[:POINTS_PER_OBSERVATION], (node.observations, 1))


def _expand(beliefs: Sequence[wire.Belief], indices: dict[str, int]) -> Float64:
    others = len(indices) - sum(belief.label in indices for belief in beliefs)
    left = max(0.0, 1.0 - sum(belief.probability for belief in beliefs))
    scores = np.full(len(indices), left / others if others else 0.0)
    for belief in beliefs:
        if belief.label in indices:
            scores[indices[belief.label]] = belief.probability
    return scores


def _foreign(kind: str, labels: set[str]) -> EvaluationError:
    return EvaluationError(
        f"scene graph has the {kind} '{min(labels)}', which is not in the data set: make the graph "
        "with the vocabulary of the data set"
    )


# --- Run of the pipeline on one scan, and evaluation of its graph.
#
# `evaluate_scan` is a function of a picklable task, so that scans can run in other processes or on
# a cluster. Its only side effect is the folder of its results.

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
    with ExitStack() as opened:
        return _evaluate(task, opened)


def warn_of_training(config: RelationsConfig, annotations: Annotations, scan: str) -> None:
    """Log a warning if the configured probe was trained on this scan or on its room."""
    if config.world_model not in WORLD_MODELS:
        return
    places = {scan}
    with suppress(RecordingError):  # 3RScan may lack the list of its rooms
        places.add(annotations.room(scan))
    if places & read_probe_card(Path(config.probe_path).expanduser()).seen_groups:
        logger.warning(
            "scan %s or its room was in the training of probe %s: its figures say nothing about "
            "other rooms",
            scan,
            config.probe_path,
        )


def _evaluate(task: ScanTask, opened: ExitStack) -> ScanOutcome:
    annotations = open_annotations(task.root, task.layout)
    if task.method == PIPELINE:
        warn_of_training(task.config.relations, annotations, task.scan)
    annotation = annotations.scan(task.scan)
    points = annotations.points(task.scan, aligned=task.options.aligned_ply)
    reference = read_reference(annotations, task.scan, points)
    source = open_source(annotations.scan_folder(task.scan), options=task.dataset)
    opened.callback(source.close)
    front_end = build_front_end(task.front_end, annotations, task.scan, source, task.config)
    pipeline = build_method(task.method, with_relation_head(task), front_end)
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


def with_relation_head(task: ScanTask) -> Config:
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
