"""The stage that lost each annotated object on the way to the graph, and a picture of it."""

from __future__ import annotations

import itertools
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from deworldsg_ros.base.files import confined, together, write_atomically
from deworldsg_ros.base.words import counted
from deworldsg_ros.evaluation.front_ends import annotated_objects, build_front_end, repose
from deworldsg_ros.evaluation.graph_measures import BOX_MARGIN_M, read_reference
from deworldsg_ros.evaluation.recorded_room import (
    NEAREST_M,
    Sight,
    TrueObject,
    Truth,
    middle_of,
    open_annotations,
    read_marked,
)
from deworldsg_ros.evaluation.runner import ScanTask, translation, with_relation_head
from deworldsg_ros.graph.messages import ABSENT
from deworldsg_ros.perception.protocols import Detections, Detector
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perception, turned_back
from deworldsg_ros.pipeline import FrameResult, Perceiver, Pipeline
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.recordings.source import Source
from deworldsg_ros.scene.arrays import Float64, UInt8, pairwise_iou
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose
from deworldsg_ros.scene.errors import EvaluationError, RefusedInput
from deworldsg_ros.scene.frame_graph import FrameGraph, Relations, Vocabulary
from deworldsg_ros.wire import messages as wire

# --- The annotated objects of a data set.


def _annotated(task: ScanTask, source: Source) -> tuple[Truth, Perceiver]:
    """The objects of an annotated scan, and the front end; raises DeWorldSGError."""
    annotations = open_annotations(task.root, task.layout)
    points = annotations.points(task.scan, aligned=task.options.aligned_ply)
    reference = read_reference(annotations, task.scan, points)
    seen = annotated_objects(annotations, task.scan, source)
    objects = zip(reference.ids, reference.labels, reference.boxes_min, reference.boxes_max)
    truth = Truth(
        tuple(TrueObject(str(number), (label,), low, high) for number, label, low, high in objects),
        BOX_MARGIN_M,
        translation(annotations),
        lambda frame: seen.detect(frame).instance_image,
    )
    return truth, build_front_end(task.front_end, annotations, task.scan, source, task.config)


# --- What becomes of each object in a run.

# The detector is asked once more for each frame, for all boxes from this score on. Below, a network
# has a box for everything.
LOW_SCORE = 0.05
# A view of an object is clear if it shows at least MIN_PIXELS of it, both sides of its box in the
# image are MIN_SIDE_PX long, and MIN_PART of the box is inside the image. The rendered rooms have
# these limits for what a detector can find.
MIN_PIXELS, MIN_SIDE_PX, MIN_PART = 200.0, 10.0, 0.3
# With fewer clear views, and without a detection, an object was never seen.
MIN_VIEWS = 3
# A detection is of the object whose visible pixels it fits best, from this overlap on, and rather
# of one that it names right.
MIN_IOU = 0.3
RIGHT_NAME_BONUS = 0.5
# One that fits none is of the object that it names right and whose box, grown by the error of boxes
# that people mark, has its middle.
MIDDLE_MARGIN_M = 0.1
# Drops of perception that leave the object in the frame.
NOT_REFUSED = ("relation_head_error", "embedder_error")

STAGES = {
    "found": "a node with a right name is in its place",
    "never seen": "no frame, or nearly none, shows it clearly",
    "never fired": f"no detection of it, whatever its name, from a score of {LOW_SCORE:g} on",
    "fired below": "only detections below the score threshold",
    "refused": "perception dropped its detections",
    "cut away": "its masks had too few pixels with depth",
    "merged": "its detections are in the node of another object",
    "misnamed": "the node in its place has another name",
    "unnamed": "the node in its place has no name",
    "hidden": "its node is not believed to exist",
    "removed": "its node was published and then removed from its place",
    "displaced": "its node is published outside its place",
}


class LowScores:
    """A detector that also keeps all detections of the newest image from `LOW_SCORE` on.

    Attributes:
        found: these detections.
        shape: height and width of the image.
    """

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self.found: Detections | None = None
        self.shape = (0, 0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._detector, name)

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """The detections of the detector itself."""
        self.found = self._detector.detect(rgb, min(LOW_SCORE, score_threshold))
        self.shape = (rgb.shape[0], rgb.shape[1])
        return self._detector.detect(rgb, score_threshold)


@dataclass(frozen=True)
class Boxes:
    """Detections of a frame: boxes (n, 4), names and scores (n,), and the object of each or -1."""

    boxes_xyxy: Float64
    names: list[str]
    scores: list[float]
    rows: list[int]

    def of(self, row: int) -> list[int]:
        """The detections of an object."""
        return [index for index, other in enumerate(self.rows) if other == row]


@dataclass
class View:
    """The frame that shows an object best: its image as JPEG, its detections, and its masks."""

    frame_number: int
    jpeg: UInt8
    edges: list[Float64]
    low: Boxes
    passed: Boxes
    contours: list[Any]


@dataclass
class Trace:
    """What became of an object so far.

    Attributes:
        frames, clear_views: number of frames that have a part of it, and that show it clearly.
        sight: the one with the most pixels.
        nearest_m: least depth.
        fired: name and score of the best detection, whatever its score.
        right_score: of the best detection with a right name.
        names: of the detections above the threshold, by name.
        refused, cut: frames by the reasons of perception and of lifting.
        nodes: number of detections that each node got.
        view, view_key: the frame for the picture, and how good it is.
    """

    frames: int = 0
    clear_views: int = 0
    sight: Sight = field(default_factory=lambda: Sight(0.0))
    nearest_m: float = np.inf
    fired: tuple[float, str] = (0.0, "")
    right_score: float = 0.0
    names: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    cut: Counter[str] = field(default_factory=Counter)
    nodes: Counter[int] = field(default_factory=Counter)
    view: View | None = None
    view_key: tuple[float, ...] = ()

    def look(self, sight: Sight) -> bool:
        """Add what a frame shows; returns whether it shows the object clearly."""
        clear = (
            sight.pixels >= MIN_PIXELS and sight.side_px >= MIN_SIDE_PX and sight.part >= MIN_PART
        )
        self.frames += 1
        self.clear_views += clear
        self.nearest_m = min(self.nearest_m, sight.depth_m)
        if sight.pixels >= self.sight.pixels:
            self.sight = sight
        return clear


class Tracer:
    """Runs the pipeline and follows each annotated object through its stages.

    Args:
        pipeline: its detector is asked for low scores too, if it is the configured perception.
        truth: the objects.
    """

    def __init__(self, pipeline: Pipeline, truth: Truth) -> None:
        self.pipeline, self.truth = pipeline, truth
        self.traces = [Trace() for _ in truth.objects]
        self.known: set[str] = set()
        self._low: LowScores | None = None
        self._successors: dict[int, int | None] = {}
        self._published: set[int] = set()
        if isinstance(pipeline.perception, Perception):
            pipeline.perception.watch(self._watch)

    def _watch(self, name: str, backend: Any) -> Any:
        if name == "detector":
            self._low = backend = LowScores(backend)
        return backend

    def process(self, frame: RgbdFrame, number: int) -> None:
        """Process a frame; raises RefusedInput as the pipeline does."""
        result = self.pipeline.process(frame)
        self._follow_nodes()
        graph, local = result.perceived.frame_graph, result.local
        self.known.update(graph.vocabulary.classes)
        sights = self.truth.sights(frame)
        passed = self._matched(frame, graph, sights)
        low = self._low_boxes(frame, result, sights) or passed
        lifted = dict(zip((local.instance_ids - 1).tolist(), result.node_ids))
        threshold = getattr(self.pipeline.perception, "score_threshold", 0.0)
        for row, sight in sights.items():
            trace = self.traces[row]
            clear = trace.look(sight)
            best = best_right = 0.0
            for index in low.of(row):
                name, score = low.names[index], low.scores[index]
                best = max(best, score)
                trace.fired = max(trace.fired, (score, name))
                if self.truth.is_right(row, name):
                    best_right = max(best_right, score)
            trace.right_score = max(trace.right_score, best_right)
            mine = passed.of(row)
            if mine:
                trace.names.update(passed.names[index] for index in mine)
                got = [lifted[index] for index in mine if index in lifted]
                trace.nodes.update(got)
                if not got:
                    trace.cut[_reasons(local.drops)] += 1
            elif best >= threshold and low is not passed:
                trace.refused[_reasons(result.perceived.drops)] += 1
            key = (float(clear), best_right, best, sight.pixels, sight.part)
            if key > trace.view_key:
                trace.view_key = key
                trace.view = self._view(frame, number, row, (low, passed), result)

    def _follow_nodes(self) -> None:
        assert self.pipeline.builder is not None
        graph = self.pipeline.builder.graph
        self._successors.update(graph.take_removals())
        slots = graph.nodes.slots
        self._published.update(graph.nodes.ids[slots[graph.nodes.confirmed[slots]]].tolist())

    def resolve(self, node_id: int) -> int | None:
        """The node that an id stands for at the end, following merges; None = removed."""
        current: int | None = node_id
        while current is not None and current in self._successors:
            current = self._successors[current]
        return current

    def was_published(self, node_id: int) -> bool:
        """Whether a node, also one that is gone, was in the graph at any frame."""
        return node_id in self._published

    def _matched(self, frame: RgbdFrame, graph: FrameGraph, sights: Mapping[int, Sight]) -> Boxes:
        """The detections of a frame graph, each with its object."""
        classes = graph.vocabulary.classes
        names = [classes[index] for index in graph.class_probabilities.argmax(axis=1).tolist()]
        keys = [row for row, sight in sights.items() if sight.pixels]
        rows = [-1] * len(names)
        seen = np.array([sights[row].box_xyxy for row in keys]).reshape(-1, 4)
        ious = pairwise_iou(graph.boxes_xyxy, seen)
        for index, name in enumerate(names):
            right = np.array([self.truth.is_right(row, name) for row in keys], bool)
            value = np.where(ious[index] >= MIN_IOU, ious[index] + RIGHT_NAME_BONUS * right, 0.0)
            if value.any():
                rows[index] = keys[int(value.argmax())]
            elif right.any():
                middle = middle_of(frame, graph.boxes_xyxy[index])
                around = [
                    row
                    for row in itertools.compress(keys, right.tolist())
                    if self.truth.objects[row].contains(middle, MIDDLE_MARGIN_M)
                ]
                rows[index] = around[0] if len(around) == 1 else -1
        return Boxes(graph.boxes_xyxy, names, graph.scores.tolist(), rows)

    def _low_boxes(
        self, frame: RgbdFrame, result: FrameResult, sights: Mapping[int, Sight]
    ) -> Boxes | None:
        """All detections from `LOW_SCORE` on, in the image as the camera took it."""
        if self._low is None or self._low.found is None:
            return None
        found, (height, width) = self._low.found, self._low.shape
        classes = found.classes or tuple(self._low.classes)
        graph = FrameGraph(
            0,
            "",
            width,
            height,
            Vocabulary(classes, ()),
            np.clip(found.boxes_xyxy, 0.0, [width - 1.0, height - 1.0] * 2),
            found.class_probabilities,
            found.scores,
            Relations.none(0),
        )
        nothing = np.zeros((height, width), np.uint16)
        graph, _ = turned_back(graph, nothing, result.perceived.turns)
        return self._matched(frame, graph, sights)

    def _view(
        self,
        frame: RgbdFrame,
        number: int,
        row: int,
        boxes: tuple[Boxes, Boxes],
        result: FrameResult,
    ) -> View:
        low, passed = boxes
        bgr = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR)
        _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 90])
        contours: list[Any] = []
        for index in passed.of(row):
            mask = (result.perceived.instances == index + 1).astype(np.uint8)
            contours += cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
        edges = _projected_edges(frame, self.truth.objects[row])
        return View(number, np.asarray(jpeg), edges, low, passed, contours)


def _reasons(drops: Mapping[str, int]) -> str:
    return ", ".join(sorted(set(drops) - set(NOT_REFUSED))) or "joined with another box"


# --- The stage that lost an object: the first cause first.


@dataclass(frozen=True)
class Loss:
    """What became of an annotated object.

    Attributes:
        item: the object.
        stage: of `STAGES`.
        detail: one sentence.
        duplicates: nodes with a right name in its place, beyond the first.
        has_class: whether the detector has a name for it.
        trace: the counts of the run.
        picture: file name; empty = none.
    """

    item: TrueObject
    stage: str
    detail: str
    duplicates: int
    has_class: bool
    trace: Trace
    picture: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        trace = self.trace
        return {
            "id": self.item.id,
            "names": list(self.item.names),
            "box_m": [self.item.low.tolist(), self.item.high.tolist()],
            "stage": self.stage,
            "detail": self.detail,
            "duplicates": self.duplicates,
            "detector_has_class": self.has_class,
            "frames": trace.frames,
            "clear_views": trace.clear_views,
            "most_pixels": trace.sight.pixels,
            "nearest_m": trace.nearest_m if np.isfinite(trace.nearest_m) else None,
            "best_score": round(trace.fired[0], 3),
            "best_name": trace.fired[1],
            "best_right_score": round(trace.right_score, 3),
            "detections": dict(trace.names.most_common()),
            "refused": dict(trace.refused),
            "cut_away": dict(trace.cut),
            "nodes": dict(trace.nodes.most_common()),
            "picture": self.picture or None,
        }


class Judge:
    """Names the stage that lost each object of a run that has ended.

    Args:
        tracer: the run.
    """

    def __init__(self, tracer: Tracer) -> None:
        self._tracer, self._truth = tracer, tracer.truth
        builder = tracer.pipeline.builder
        assert builder is not None
        self._nodes = {node.id: node for node in tracer.pipeline.graph().nodes}
        self._hidden = builder.merging.hidden(builder.graph)
        self._graph = builder.graph
        # How many detections of each object a node got.
        self._got: dict[int, Counter[int]] = {}
        self._fates: list[Counter[int | None]] = []
        for row, trace in enumerate(tracer.traces):
            fates: Counter[int | None] = Counter()
            for node_id, count in trace.nodes.items():
                last = tracer.resolve(node_id)
                fates[last] += count
                if last is not None:
                    self._got.setdefault(last, Counter())[row] += count
            self._fates.append(fates)
        self._supporting = self._supports()

    def _supports(self) -> dict[int, list[int]]:
        """The named nodes that support each object: its name, in its place, and it is nearest."""
        found: dict[int, list[int]] = {}
        for node in self._nodes.values():
            rows = [
                row
                for row in range(len(self._truth.objects))
                if node.named and self._truth.is_right(row, node.label) and self._at(node, row)
            ]
            if rows:
                mean = np.array(node.mean_m)
                centres = {row: _centre(self._truth.objects[row]) for row in rows}
                best = min(rows, key=lambda row: float(np.linalg.norm(mean - centres[row])))
                found.setdefault(best, []).append(node.id)
        return found

    def _at(self, node: wire.NodeState, row: int) -> bool:
        item = self._truth.objects[row]
        return bool(item.contains(np.array(node.mean_m), self._truth.margin_m))

    def losses(self) -> list[Loss]:
        """What became of each object, in the order of the annotation."""
        known = {self._truth.class_of.get(name, name) for name in self._tracer.known}
        found = []
        for row, (item, trace) in enumerate(zip(self._truth.objects, self._tracer.traces)):
            stage, detail = self._stage(row, trace)
            duplicates = max(0, len(self._supporting.get(row, [])) - 1)
            has_class = not known.isdisjoint(item.names)
            found.append(Loss(item, stage, detail, duplicates, has_class, trace))
        return found

    def _stage(self, row: int, trace: Trace) -> tuple[str, str]:
        if row in self._supporting:
            return "found", ", ".join(f"#{number}" for number in self._supporting[row])
        if trace.nodes:
            return self._of_nodes(row, self._fates[row])
        if trace.cut:
            return "cut away", _stated(trace.cut)
        if trace.refused:
            return "refused", _stated(trace.refused)
        if trace.clear_views < MIN_VIEWS:
            return "never seen", _why_unseen(trace)
        score, name = trace.fired
        if not score:
            return "never fired", f"{counted(trace.clear_views, 'clear view')}"
        right = f"with a right name up to {trace.right_score:.2f}" if trace.right_score else ""
        detail = f"best as {name} with {score:.2f}; {right or 'never with a right name'}"
        return "fired below", f"{detail}, in {counted(trace.clear_views, 'clear view')}"

    def _of_nodes(self, row: int, fates: Counter[int | None]) -> tuple[str, str]:
        """The stage after lifting: where the nodes of an object's detections are."""
        count = fates.total()
        for node_id, _ in fates.most_common():
            node = self._nodes.get(node_id or 0)
            if node is not None and self._owner(node.id) == row and self._at(node, row):
                return self._of_name(node, row)
        main, got = fates.most_common(1)[0]
        share = f"{got} of {counted(count, 'detection')}"
        clear = counted(self._tracer.traces[row].clear_views, "clear view")
        if main is None:
            was = any(map(self._tracer.was_published, self._tracer.traces[row].nodes))
            return (
                ("removed", f"{share}: the node was published and is gone")
                if was
                else (
                    "hidden",
                    f"{share}: the node was never believed in, and was forgotten; {clear}",
                )
            )
        node = self._nodes.get(main)
        if node is None:
            slot = self._graph.nodes.slot(main)
            reason = self._hidden.get(main, "not published")
            existence = float(self._graph.nodes.existence[slot])
            stage = "removed" if reason == ABSENT else "hidden"
            return stage, f"{share} in node #{main}: {reason}; exists with {existence:.0%}; {clear}"
        said = f"{node.label} #{main}"
        counts_for = [other for other, ids in self._supporting.items() if main in ids]
        owner = counts_for[0] if counts_for else self._owner(main)
        if owner != row:
            other = self._truth.objects[owner]
            return "merged", f"{share} in {said}, which is {other.title}"
        item = self._truth.objects[row]
        mean = np.array(node.mean_m)
        gap = np.maximum(np.maximum(item.low - mean, mean - item.high), 0.0)
        return "displaced", f"{share} in {said}, {np.linalg.norm(gap):.2f} m from its box"

    def _of_name(self, node: wire.NodeState, row: int) -> tuple[str, str]:
        guesses = ", ".join(f"{item.label} {item.probability:.0%}" for item in node.classes[:3])
        if not node.named:
            return "unnamed", f"#{node.id}: {guesses}"
        if self._truth.is_right(row, node.label):
            return "merged", f"{node.label} #{node.id} counts for a nearer {node.label}"
        said = ", ".join(
            f"{n} × {name}" for name, n in self._tracer.traces[row].names.most_common(3)
        )
        return "misnamed", f"#{node.id}: {guesses}; the detector said {said}"

    def _owner(self, node_id: int) -> int:
        """The object that most detections of a node are of."""
        return self._got[node_id].most_common(1)[0][0]


def _centre(item: TrueObject) -> Float64:
    return (item.low + item.high) / 2


def _stated(reasons: Counter[str]) -> str:
    return "; ".join(f"{name} in {counted(n, 'frame')}" for name, n in reasons.most_common())


def _why_unseen(trace: Trace) -> str:
    sight = trace.sight
    if not trace.frames:
        return "in no image"
    if not sight.pixels:
        return f"in {counted(trace.frames, 'image')}, but hidden, or without depth"
    if sight.part < MIN_PART:
        return f"cut off: {sight.part:.0%} of it in the image that shows most"
    if sight.pixels < MIN_PIXELS or sight.side_px < MIN_SIDE_PX:
        return (
            f"too small: at most {sight.pixels:.0f} pixels, {sight.side_px:.0f} wide, from "
            f"{trace.nearest_m:.1f} m on"
        )
    return f"clear in only {counted(trace.clear_views, 'frame')}"


# --- Pictures of losses: the best view, with the box, the detections and the masks.

TRUE, MINE, OTHER, WEAK = (80, 220, 60), (0, 140, 255), (200, 200, 200), (230, 60, 230)
LINE_PX = 20
# Weak boxes of other objects, which would hide the image, are left out.
SHOWN_SCORE = 0.3


def _projected_edges(frame: RgbdFrame, item: TrueObject) -> list[Float64]:
    """The edges of a box in the image, (2, 2) pixels each; those behind the camera are left out."""
    corners = np.array(np.meshgrid(*zip(item.low, item.high), indexing="ij")).reshape(3, 8).T
    T = invert_pose(frame.T_world_camera)
    points = corners @ T[:3, :3].T + T[:3, 3]
    edges = []
    for a in range(8):
        for bit in (1, 2, 4):
            b = a | bit
            if b != a and min(points[a, 2], points[b, 2]) > NEAREST_M:
                edges.append(frame.intrinsics.project(points[[a, b]]))
    return edges


def draw_loss(loss: Loss, row: int) -> UInt8:
    """The picture (H, W, 3), BGR, of a lost object with a view; `row` is that of its truth."""
    view = loss.trace.view
    assert view is not None
    image = np.asarray(cv2.imdecode(view.jpeg, cv2.IMREAD_COLOR), np.uint8)
    tinted = cv2.drawContours(image.copy(), view.contours, -1, MINE, cv2.FILLED)
    image = np.asarray(cv2.addWeighted(tinted, 0.35, image, 0.65, 0.0), np.uint8)
    cv2.drawContours(image, view.contours, -1, MINE, 1)
    for boxes, colour in ((view.low, WEAK), (view.passed, MINE)):
        for box, name, score, other in zip(boxes.boxes_xyxy, boxes.names, boxes.scores, boxes.rows):
            mine = other == row
            if not mine and (score < SHOWN_SCORE or boxes is view.low):
                continue
            shade = colour if mine else OTHER
            x1, y1, x2, y2 = np.clip(box, -5000, 5000).round().astype(int).tolist()
            cv2.rectangle(image, (x1, y1), (x2, y2), shade, 2 if mine else 1)
            _write(image, f"{name} {score:.2f}", (x1 + 2, max(y1, 0) + 12), shade)
    for edge in view.edges:
        start, end = np.clip(edge, -5000, 5000).round().astype(int).tolist()
        cv2.line(image, start, end, TRUE, 1)
    lines = [
        f"{loss.item.title}: {loss.stage}",
        *_wrapped(loss.detail, image.shape[1] // 8),
        f"frame {view.frame_number}; green: its box; orange: detections and mask of it; "
        "purple: below the threshold",
    ]
    head = np.zeros((LINE_PX * len(lines) + 6, image.shape[1], 3), np.uint8)
    for number, line in enumerate(lines):
        _write(head, line, (6, LINE_PX * (number + 1) - 5), (255, 255, 255))
    return np.vstack([head, image])


def _wrapped(text: str, width: int) -> list[str]:
    return re.findall(rf"\S.{{0,{width}}}(?:\s|$)|\S+", text)


def _write(image: UInt8, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    # The fonts of OpenCV have ASCII only.
    text = text.replace("×", "x").encode("ascii", "replace").decode()
    for shade, thickness in (((0, 0, 0), 3), (colour, 1)):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, shade, thickness, cv2.LINE_AA)


# --- The losses of a scan.

LOSSES_FILE = "losses.json"


def trace_scan(task: ScanTask, marked: Path | None = None) -> list[Loss]:
    """Run a scan, and say of each object which stage lost it.

    ``out/SCAN`` gets `LOSSES_FILE` and a picture of each lost object that an image has a part of,
    all of them or none.

    Args:
        task: as for `evaluate_scan`; of the pipeline.
        marked: file of boxes (`read_marked`) for a recording `task.root` without other annotation.

    Raises:
        DeWorldSGError: the scan cannot be read, or no frame of it was processed.
    """
    folder = (
        open_annotations(task.root, task.layout).scan_folder(task.scan)
        if marked is None
        else task.root
    )
    source = open_source(folder, options=task.dataset)
    try:
        if marked is None:
            truth, front_end = _annotated(task, source)
            config = with_relation_head(task)
        else:
            config = task.config
            truth = read_marked(marked)
            front_end = build_perception(config.perception, world_up=config.inputs.world_up)
        tracer = Tracer(Pipeline(config, front_end), truth)
        refused: Counter[str] = Counter()
        frames = Recording(source, config.inputs).frames()
        taken = islice(islice(frames, 0, None, task.every), task.max_frames or None)
        count = 0
        for number, frame in enumerate(repose(taken, task.poses, source, refused)):
            try:
                tracer.process(frame, number * task.every)
            except RefusedInput as refusal:
                refused[refusal.reason] += 1
                continue
            count += 1
    finally:
        source.close()
    if not count:
        raise EvaluationError(f"scan {task.scan}: all frames were refused: {dict(refused)}")
    return _write_losses(task, Judge(tracer).losses())


def _write_losses(task: ScanTask, losses: Sequence[Loss]) -> list[Loss]:
    names = [
        f"{row:03d}_{re.sub('[^A-Za-z0-9]+', '_', loss.item.names[0])[:40]}.png"
        for row, loss in enumerate(losses)
    ]
    written = []
    try:
        with together(confined(task.out, task.scan), [LOSSES_FILE, *names]) as staged:
            for row, (loss, name) in enumerate(zip(losses, names)):
                if loss.stage != "found" and loss.trace.view is not None:
                    _, png = cv2.imencode(".png", draw_loss(loss, row))
                    write_atomically(staged / name, png.tobytes())
                    loss = replace(loss, picture=name)
                written.append(loss)
            content = {
                "scan": task.scan,
                "stages": count_stages(written),
                "objects": [loss.to_dict() for loss in written],
            }
            write_atomically(staged / LOSSES_FILE, json.dumps(content, indent=1, allow_nan=False))
    except OSError as error:
        raise EvaluationError(f"--out {task.out}: cannot be written ({error.strerror})") from error
    return written


def count_stages(losses: Sequence[Loss]) -> dict[str, int]:
    """The number of objects of each stage, and ``duplicates``, the nodes beyond one an object."""
    counts = Counter(loss.stage for loss in losses)
    duplicates = sum(loss.duplicates for loss in losses)
    return {**{stage: counts[stage] for stage in STAGES}, "duplicates": duplicates}
