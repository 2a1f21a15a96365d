"""Run the graph builder over captured local graphs, and score its graphs: a line a capture.

    python tools/merging_lab/replay.py CAPTURES --only 'rooms_0.*' --settings merging.x=y

The graph of a capture equals that of `deworldsg evaluate run` with the same detections and poses.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import numpy as np
from captures import SUFFIX, Capture, read_capture
from msgspec.structs import replace

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import relation_of
from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.edge_measures import Calibrated, calibration_error, reliability
from deworldsg_ros.evaluation.graph_measures import (
    BOX_MARGIN_M,
    Measures,
    NodeView,
    ReferenceScene,
    measure,
    measure_views,
    read_reference,
)
from deworldsg_ros.evaluation.graph_measures import pool as pool_measures
from deworldsg_ros.evaluation.recorded_room import Truth as Marks
from deworldsg_ros.evaluation.recorded_room import open_annotations, read_marked
from deworldsg_ros.evaluation.runner import to_prediction, translate, translation
from deworldsg_ros.evaluation.scoring import ProtocolOptions, ScanResult, pool, score_scan
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.merging.matching import one_to_one
from deworldsg_ros.recordings.folders.annotations import Annotations, ScanPoints
from deworldsg_ros.relations.clips import LiveGraph
from deworldsg_ros.relations.stage import RelationReasoner, build_world_model
from deworldsg_ros.wire import messages as wire

NO_IMAGE = np.zeros((0, 0, 3), np.uint8)
HEADER = (
    f"{'':32s} {'objects':>7s} {'seen':>4s} {'nodes':>5s} {'found':>5s} {'dup.':>4s} {'wrong':>5s} "
    f"{'stray':>5s} {'prec.':>5s} {'rel.':>5s} {'ms':>5s}"
)


@dataclass(frozen=True)
class Replay:
    """The graph of a capture.

    Attributes:
        graph: the whole graph, with surface points.
        node_ids: for each frame, the node that each row became, 0 = none; merges are followed.
        median_ms: of `GraphBuilder.integrate` a frame, processor time.
    """

    graph: wire.SceneGraphMessage
    node_ids: list[list[int]]
    median_ms: float


@dataclass(frozen=True)
class Truth:
    """The annotation of a scan."""

    annotations: Annotations
    scan: str
    points: ScanPoints
    reference: ReferenceScene


@dataclass(frozen=True)
class Score:
    """The score of one capture, or of several.

    Attributes:
        name: of the capture.
        measures: of the graph.
        results: of the official protocol, a scan each.
        annotations: of these scans.
        seen: objects that have the right class in one detection at least: the most to be found.
        median_ms: of `GraphBuilder.integrate` a frame, processor time.
        existence: that each node states, and whether it is the first node of a true object.
    """

    name: str
    measures: Measures
    results: list[ScanResult]
    annotations: Annotations
    seen: int
    median_ms: float
    existence: list[Calibrated] = field(default_factory=list)

    def numbers(self) -> dict[str, float]:
        """Every number by name; recalls and precisions are fractions."""
        numbers = self.measures.numbers()
        numbers |= pool(self.results, self.annotations.vocabulary).numbers()
        numbers |= {"seen": self.seen, "integrate_ms": self.median_ms}
        if self.existence:
            numbers["existence_calibration_error"] = calibration_error(self.existence)
        return numbers

    def line(self) -> str:
        """The line of the table."""
        n = self.numbers()
        return (
            f"{self.name:32s} {n['objects']:7.0f} {n['seen']:4.0f} {n['nodes']:5.0f} "
            f"{n['found']:5.0f} {n['duplicates']:4.0f} {n['wrong_class']:5.0f} {n['stray']:5.0f} "
            f"{100 * n['node_precision']:5.1f} {100 * n['relationship_recall']:5.1f} "
            f"{n['integrate_ms']:5.2f}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Replay and score every capture of a folder."""
    options = _parser().parse_args(arguments)
    config = effective_config(options.config, options.settings)
    paths = chosen_paths(options.folder, options.only, options.skip)
    if not paths:
        raise SystemExit(f"{options.folder}: no capture of this name: expected NAME{SUFFIX}")
    print(HEADER)
    scores = []
    for path in paths:
        capture = read_capture(path)
        replayed = replay(capture, config)
        if not capture.layout:
            print(f"{capture.name:32s} {unannotated_line(capture, replayed)}", flush=True)
            if options.marked is not None:
                marks = read_marked(options.marked)
                print(*marked_lines(replayed.graph, marks, options.edges), sep="\n", flush=True)
            continue
        scores.append(score(capture, replayed))
        print(scores[-1].line(), flush=True)
        if options.missed:
            print(*missed_lines(capture, replayed), sep="\n", flush=True)
    pooled = list(pool_scenes(scores))
    for item in pooled:
        print(item.line())
    print(*calibration_lines([belief for item in scores for belief in item.existence]), sep="\n")
    if options.json:
        numbers = {item.name: item.numbers() for item in [*scores, *pooled]}
        options.json.write_text(json.dumps(numbers, indent=1))


def chosen_paths(folder: Path, only: Sequence[str], skip: Sequence[str] = ()) -> list[Path]:
    """The captures of a folder whose names match a pattern of `only` and none of `skip`."""

    def matches(path: Path, patterns: Sequence[str]) -> bool:
        return any(fnmatch(path.name.removesuffix(SUFFIX), pattern) for pattern in patterns)

    paths = sorted(folder.glob(f"*{SUFFIX}"))
    return [path for path in paths if matches(path, only) and not matches(path, skip)]


def replay(capture: Capture, config: Config) -> Replay:
    """Merge the local graphs and relate their nodes, as `Pipeline` does.

    Raises:
        SystemExit: for a world model that needs images.
    """
    perception = replace(config.perception, relation_head=capture.relation_head)
    config = replace(config, perception=perception)
    if build_world_model(config.relations) is not None:
        raise SystemExit(
            f"relations.world_model is {config.relations.world_model}: it needs images; "
            "expected physics or none"
        )
    first = capture.local_graphs[0]
    builder = GraphBuilder(config, first.vocabulary, first.frame_id)
    reasoner = RelationReasoner(config.relations, None)
    reasoner.watch(LiveGraph(builder.graph))
    times_s, node_ids = [], []
    for local in capture.local_graphs:
        start = time.thread_time()
        node_ids.append(builder.integrate(local))
        times_s.append(time.thread_time() - start)
        builder.add_evidence(reasoner.observe(local, NO_IMAGE))
    builder.find_things()
    followed = [[builder.graph.resolve(node) or 0 for node in row] for row in node_ids]
    return Replay(builder.full(), followed, 1e3 * float(np.median(times_s)))


def score(capture: Capture, replayed: Replay) -> Score:
    """Score the graph of an annotated capture."""
    truth = read_truth(capture.root, capture.layout, capture.scan)
    annotations = truth.annotations
    graph = translate(replayed.graph, annotations)
    result = score_scan(
        annotations.scan(truth.scan),
        truth.points,
        to_prediction(graph, annotations.vocabulary),
        ProtocolOptions(),
    )
    detections = measure_views(list(detection_views(capture, annotations)), [], truth.reference)
    return Score(
        capture.name,
        measure(graph, truth.reference),
        [result],
        annotations,
        detections.found,
        replayed.median_ms,
        existence_beliefs(graph.nodes, truth.reference),
    )


def pool_scenes(scores: Sequence[Score]) -> Iterator[Score]:
    """The sum over the scenes of each data set, for each kind with several scenes."""
    groups: dict[tuple[Path, str], list[Score]] = {}
    for item in scores:
        kind = item.name.partition(".")[2]
        groups.setdefault((item.annotations.root, kind), []).append(item)
    for (_, kind), items in groups.items():
        if len(items) > 1:
            yield Score(
                f"{len(items)} scenes: {kind}",
                pool_measures(item.measures for item in items),
                [result for item in items for result in item.results],
                items[0].annotations,
                sum(item.seen for item in items),
                float(np.mean([item.median_ms for item in items])),
                [belief for item in items for belief in item.existence],
            )


@cache
def read_truth(root: Path, layout: str, scan: str) -> Truth:
    """The annotation of a scan; read once."""
    annotations = open_annotations(root, layout)
    points = annotations.points(scan, aligned=False)
    return Truth(annotations, scan, points, read_reference(annotations, scan, points))


def detection_views(capture: Capture, annotations: Annotations) -> Iterator[NodeView]:
    """Every detection as a node of its own."""
    names = translation(annotations)
    number = 0
    for local in capture.local_graphs:
        best = local.class_probabilities.argmax(axis=1)
        for row, mean_m in enumerate(local.means_world):
            label = local.vocabulary.classes[best[row]]
            number += 1
            probability = float(local.class_probabilities[row, best[row]])
            no_points = np.zeros((0, 3))
            yield NodeView(number, names.get(label, label), probability, mean_m, no_points, 1.0)


def existence_beliefs(
    nodes: Iterable[wire.NodeState], reference: ReferenceScene
) -> list[Calibrated]:
    """The existence that each node states, and whether it is the first node of a true object.

    The surest nodes choose first. Nodes without the field are left out.
    """
    stated = [
        (float(existence), node)
        for node in nodes
        if isinstance(existence := getattr(node, "existence", None), float)
    ]
    low, high = reference.boxes_min - BOX_MARGIN_M, reference.boxes_max + BOX_MARGIN_M
    free = np.ones(len(reference), bool)
    labels = np.array(reference.labels)
    beliefs = []
    for existence, node in sorted(stated, key=lambda item: -item[0]):
        mean_m = np.array(node.mean_m)
        inside = ((mean_m >= low) & (mean_m <= high)).all(axis=1) & (labels == node.label)
        rows = np.flatnonzero(inside & free)
        if len(rows):
            distances_m = np.linalg.norm(reference.centroids[rows] - mean_m, axis=1)
            free[rows[distances_m.argmin()]] = False
        beliefs.append(Calibrated(existence, bool(len(rows))))
    return beliefs


def calibration_lines(beliefs: Sequence[Calibrated]) -> list[str]:
    """The table of calibration of the nodes' existence; empty without beliefs."""
    if not beliefs:
        return []
    lines = [f"\n{'existence':>9s} {'nodes':>5s} {'true':>5s}"]
    lines += [f"{b.probability:9.2f} {b.size:5d} {b.right:5.2f}" for b in reliability(beliefs)]
    return [*lines, f"expected calibration error {100 * calibration_error(beliefs):.1f} %"]


def missed_lines(capture: Capture, replayed: Replay) -> list[str]:
    """The objects without a node of their class, and the nodes that their detections went to."""
    truth = read_truth(capture.root, capture.layout, capture.scan)
    graph = translate(replayed.graph, truth.annotations)
    nodes = {node.id: node for node in graph.nodes}
    found = {
        row
        for row, label in enumerate(truth.reference.labels)
        for node in nodes.values()
        if node.label == label and _inside(node.mean_m, truth.reference, row)
    }
    lines = []
    for row, object_id in enumerate(truth.reference.ids):
        if row in found:
            continue
        into: Counter[int] = Counter()
        for ids, went_to in zip(capture.object_ids, replayed.node_ids):
            into.update(node for true, node in zip(ids.tolist(), went_to) if true == object_id)
        parts = []
        for node_id, count in into.most_common(4):
            node = nodes.get(node_id)
            parts.append(f"{count} in {node.label if node else 'no published node'} {node_id}")
        label = truth.reference.labels[row]
        lines.append(
            f"    {label} {object_id}: {sum(into.values())} detections; {', '.join(parts)}"
        )
    return lines


def _inside(mean_m: Sequence[float], reference: ReferenceScene, row: int) -> bool:
    low, high = reference.boxes_min[row] - BOX_MARGIN_M, reference.boxes_max[row] + BOX_MARGIN_M
    return bool(((np.array(mean_m) >= low) & (np.array(mean_m) <= high)).all())


def unannotated_line(capture: Capture, replayed: Replay) -> str:
    """The nodes by label; with a list ``SCENE.json`` beside this file, which of it was found."""
    nodes = replayed.graph.nodes
    labels = Counter(node.label for node in nodes)
    listed = ", ".join(f"{count} {label}" for label, count in labels.most_common())
    counts = f"{len(nodes)} nodes, {replayed.median_ms:.2f} ms"
    path = Path(__file__).parent / f"{capture.scene}.json"
    if not path.exists():
        return f"{counts}: {listed}"
    m = measure(replayed.graph, read_list(path))
    others = m.nodes - m.matched
    return (
        f"{counts}; of {m.objects} large objects {m.found} found, {m.duplicates} duplicates; "
        f"{others} other nodes: {listed}"
    )


def read_list(path: Path) -> ReferenceScene:
    """The objects of a list, without relations."""
    objects = json.loads(path.read_text())["objects"]
    boxes = np.array([item["aabb"] for item in objects], np.float64)
    return ReferenceScene(
        list(range(1, len(objects) + 1)),
        [item["label"] for item in objects],
        boxes[:, 0],
        boxes[:, 1],
        boxes.mean(axis=1),
        frozenset(),
        exact=False,
    )


# --- Recordings whose objects are marked as boxes, and whose relations were judged by hand.

EDGE_PROBABILITY = 0.5
# A node with a name is of an object within the margin of marks; one without has its mean in the
# box. Of several objects, the nearest: a hundredth of the distance to the middle decides inside.
UNNAMED_MARGIN_M = 0.05
MIDDLE_WEIGHT = 0.01


def marked_lines(graph: wire.SceneGraphMessage, marks: Marks, edges: Path | None) -> list[str]:
    """Named nodes against marked objects; with a file of true relations, each edge against it."""
    named = [node for node in graph.nodes if node.named]
    rows = [nearest_mark(node, marks) for node in named]
    right = [row for row in rows if row is not None]
    found, precision = len(set(right)), len(right) / max(len(rows), 1)
    lines = [
        f"    of {len(marks.objects)} marked objects {found} found, {len(right) - found} "
        f"duplicates; {len(named)} nodes with a name, precision {precision:.2f}; "
        f"{marked_with_node(graph.nodes, marks)} objects have one of all {len(graph.nodes)} nodes"
    ]
    if edges is None:
        return lines
    content = json.loads(edges.read_text())
    things = read_marked(edges).objects if content["objects"] else ()
    marks = dataclasses.replace(marks, objects=(*marks.objects, *things))
    true = {(subject, name, other) for subject, name, other in content["relations"]}
    true |= {(b, name, a) for a, name, b in true if name == "near"}
    at = {node.id: nearest_mark(node, marks) for node in graph.nodes}
    ids = {node: "?" if row is None else marks.objects[row].id for node, row in at.items()}
    said = {node.id: f"{node.label} #{node.id} ({ids[node.id]})" for node in graph.nodes}
    judged = [
        ((ids[edge.subject], item.label, ids[edge.object]) in true, edge, item)
        for edge in graph.edges
        for item in edge.predicates
        if item.probability >= EDGE_PROBABILITY
    ]
    count = sum(is_right for is_right, _, _ in judged)
    items = SceneGraph(graph)
    sentences = [
        is_right
        for is_right, edge, item in judged
        if relation_of(
            edge, items[edge.subject], items[edge.object], item.label
        ).triplet_probability
        >= EDGE_PROBABILITY
    ]
    lines.append(f"    of {len(sentences)} sentences {sum(sentences)} right")
    lines.append(f"    of {len(judged)} edges {count} right; the others:")
    lines += [
        f"      {said[edge.subject]} {item.label} {said[edge.object]} {item.probability:.2f}"
        for is_right, edge, item in judged
        if not is_right
    ]
    return lines


def nearest_mark(node: wire.NodeState, marks: Marks) -> int | None:
    """Row of the marked object that a node is; None if it has another name, or is elsewhere."""
    best, least = None, marks.margin_m if node.named else UNNAMED_MARGIN_M
    for row in range(len(marks.objects)):
        if node.named and not marks.is_right(row, node.label):
            continue
        distance_m = _mark_distance(node, marks, row)
        if distance_m < least:
            best, least = row, distance_m
    return best


def marked_with_node(nodes: Sequence[wire.NodeState], marks: Marks) -> int:
    """Number of marked objects with a node, whatever its name; a node is of one object.

    A node with a right name has the margin of marks, any other that of nodes without a name.
    """
    worth = np.zeros((len(nodes), len(marks.objects)))
    for index, node in enumerate(nodes):
        for row in range(len(marks.objects)):
            is_right = node.named and marks.is_right(row, node.label)
            margin_m = marks.margin_m if is_right else UNNAMED_MARGIN_M
            worth[index, row] = _mark_distance(node, marks, row) < margin_m
    return sum(row >= 0 for row in one_to_one(worth))


def _mark_distance(node: wire.NodeState, marks: Marks, row: int) -> float:
    """Metres of a node to a box, and a part of those to its middle."""
    mean, item = np.array(node.mean_m), marks.objects[row]
    gap_m = np.linalg.norm(np.maximum(np.maximum(item.low - mean, mean - item.high), 0))
    middle_m = np.linalg.norm((item.low + item.high) / 2 - mean)
    return float(gap_m + MIDDLE_WEIGHT * middle_m)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("folder", type=Path, help="captures of capture.py")
    add("--only", nargs="+", default=["*"], metavar="PATTERN", help="captures of these names")
    add("--skip", nargs="+", default=[], metavar="PATTERN", help="leave these captures out")
    add("--config", type=Path, help="ROS parameter file; default: the built-in defaults")
    add("--settings", nargs="+", default=[], metavar="SECTION.FIELD=VALUE", help="set options")
    add("--marked", type=Path, help="boxes of the objects of recordings without annotation")
    add("--edges", type=Path, help="with --marked: the true relations, edges_*.json")
    add("--missed", action="store_true", help="list the objects that have no node")
    add("--json", type=Path, help="write every number by name to this file")
    return parser


if __name__ == "__main__":
    main()
