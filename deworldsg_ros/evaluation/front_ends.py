"""Front ends: detections of a backend, true boxes, a recording or ground truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import cv2
import msgspec
import numpy as np
from scipy.spatial import cKDTree

from deworldsg_ros.base.files import parse_any_json
from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.injection import (
    Detection,
    Faults,
    FrameDetections,
    FrameFaults,
    Injection,
    Relation,
    assemble,
    parse_faults,
    spread,
    visible_box,
)
from deworldsg_ros.evaluation.recorded_room import RecordedRoom
from deworldsg_ros.perception.protocols import Detections, Detector
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perceived, Perception
from deworldsg_ros.pipeline import Perceiver
from deworldsg_ros.poses.loops import track_poses
from deworldsg_ros.poses.trajectory import PoseNoise, perturb_poses, read_trajectory
from deworldsg_ros.recordings.folders.annotations import Annotations, ScanAnnotation, ScanPoints
from deworldsg_ros.recordings.folders.dataset import decode_image, read_file
from deworldsg_ros.recordings.folders.sequence import SequenceDataset, read_instances, rotated_pose
from deworldsg_ros.recordings.source import Source
from deworldsg_ros.scene.arrays import UInt8, UInt16
from deworldsg_ros.scene.camera import RgbdFrame, invert_pose
from deworldsg_ros.scene.errors import EvaluationError, RefusedInput
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.vocabulary import PREDICATE_SETS

# --- Recorded detections and relations: a frontend.json beside each frame.
#
# docs/dev/evaluation/protocol.md describes the file. The rest of a distribution, which the file
# does not state, is spread evenly over the other classes or predicates. Relation probabilities
# become logits.

VERSION = 1
# Suffix of the file by the fraction of flipped labels in it.
FILE_SUFFIXES = {0.0: ".frontend.json", 0.1: ".frontend_flip10.json"}


class RecordedFrontEnd:
    """Replays recorded detections and relations.

    Args:
        sequence: folder of the frames.
        frame_numbers: number of each frame in its file names, by its stamp in nanoseconds.
        vocabulary: classes and predicates of the data set.
        flip: fraction of flipped labels, 0 or 0.1; selects the file.
        top_relations: number of relations kept per frame.
        injection: injects faults; None = no faults.

    Raises:
        EvaluationError: another fraction of flipped labels.
    """

    def __init__(
        self,
        sequence: Path,
        frame_numbers: Mapping[int, int],
        vocabulary: Vocabulary,
        *,
        flip: float = 0.0,
        top_relations: int = 10,
        injection: Injection | None = None,
    ) -> None:
        if flip not in FILE_SUFFIXES:
            known = ", ".join(f"{fraction:g}" for fraction in FILE_SUFFIXES)
            raise EvaluationError(f"--flip {flip:g} was not recorded: expected {known}")
        self.vocabulary = vocabulary
        self._sequence = sequence
        self._frame_numbers = frame_numbers
        self._suffix = FILE_SUFFIXES[flip]
        self._top_relations = top_relations
        self._injection = injection

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """Recorded detections and relations of a frame, with faults; raises EvaluationError."""
        if frame.stamp_ns not in self._frame_numbers:
            raise EvaluationError(
                f"frame with the stamp {frame.stamp_ns} ns is not in {self._sequence}"
            )
        number = self._frame_numbers[frame.stamp_ns]
        path = self._sequence / f"frame-{number:06d}{self._suffix}"
        try:
            seen = self._read(frame, parse_any_json(read_file(path)))
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise EvaluationError(
                f"{path} is not a recording of version {VERSION}: {type(error).__name__}: {error}"
            ) from error
        if self._injection is not None:
            seen = self._injection.apply(seen, frame, number)
        return assemble(frame, self.vocabulary, seen, self._top_relations)

    def _read(self, frame: RgbdFrame, content: Mapping[str, Any]) -> FrameDetections:
        if content["version"] != VERSION:
            raise ValueError(f"version is {content['version']}")
        class_count, predicate_count = (
            len(self.vocabulary.classes),
            len(self.vocabulary.predicates),
        )
        listed = content["detections"]
        detections = [
            Detection(
                np.array(item["box"], np.float64),
                spread(dict(item["probs"]), class_count),
                float(item["score"]),
                int(item["mask"]["value"]),
            )
            for item in listed
        ]
        relations = [
            Relation(
                int(item["s"]),
                int(item["o"]),
                float(item["score"]),
                spread(dict(item["probs"]), predicate_count),
            )
            for item in content["relations"]
        ]
        names = {item["mask"]["png"] for item in listed}
        if len(names) > 1:
            raise ValueError(f"masks are in {sorted(names)}: expected one image")
        shape = (frame.intrinsics.height, frame.intrinsics.width)
        instance_image = np.zeros(shape, np.uint16)
        if names:
            instance_image = read_instance_png(self._sequence / names.pop())
        if instance_image.shape != shape:
            raise ValueError(f"instance image is {instance_image.shape}: expected {shape}")
        indices = {index for item in relations for index in (item.subject, item.object)}
        if not indices <= set(range(len(detections))):
            raise ValueError(f"relations name detections {sorted(indices)} of {len(detections)}")
        return FrameDetections(detections, relations, instance_image)


def read_instance_png(path: Path) -> UInt16:
    """Instance image (H, W) of a 16-bit PNG; raises RecordingError."""
    return np.asarray(decode_image(read_file(path), cv2.IMREAD_UNCHANGED, path), np.uint16)


# --- The annotated objects in view: a detection of each, with its true box, class and pixels.
#
# The pixels come from the instance image of the frame. If the data set has none, each depth pixel
# belongs to the object of the nearest annotated surface point.

# Probability of the true class and predicate; the rest is spread evenly.
TRUE_PROBABILITY = 0.9
# Without instance images: step between the pixels that are looked up, for speed, and maximum
# distance of the annotated point of a pixel.
PIXEL_STRIDE = 2
MAX_DISTANCE_M = 0.05


class AnnotatedObjects:
    """Detects the annotated objects of a scan in its frames, without an error.

    Args:
        frame_numbers: number of each frame by its stamp in nanoseconds.
        instances: returns the instance image (H, W) of a frame, or None.
        annotation: annotated objects of the scan.
        points: annotated surface points of the scan.
        class_count: number of classes of the data set.
    """

    def __init__(
        self,
        frame_numbers: Mapping[int, int],
        instances: Callable[[RgbdFrame], UInt16 | None],
        annotation: ScanAnnotation,
        points: ScanPoints,
        class_count: int,
    ) -> None:
        self._frame_numbers = frame_numbers
        self._instances = instances
        self._classes = annotation.objects
        self._class_count = class_count
        listed = np.isin(points.object_ids, list(annotation.objects))
        usable = listed & np.isfinite(points.points_world).all(axis=1)
        self._tree = cKDTree(points.points_world[usable]) if usable.any() else None
        self._point_ids = points.object_ids[usable]

    def number(self, frame: RgbdFrame) -> int:
        """Number of a frame in its scan; raises EvaluationError if it is from another scan."""
        number = self._frame_numbers.get(frame.stamp_ns)
        if number is None:
            raise EvaluationError(f"frame with the stamp {frame.stamp_ns} ns is not in this scan")
        return number

    def detect(self, frame: RgbdFrame) -> FrameDetections:
        """A detection of each visible object, in the order of the annotation; no relations."""
        instances = self._instances(frame)
        if instances is None:
            instances = self._nearest_objects(frame)
        detections = []
        for object_id, class_index in self._classes.items():
            box = visible_box(instances, object_id)
            if box is not None:
                probabilities = spread({class_index: TRUE_PROBABILITY}, self._class_count)
                detections.append(Detection(box, probabilities, TRUE_PROBABILITY, object_id))
        return FrameDetections(detections, [], instances)

    def _nearest_objects(self, frame: RgbdFrame) -> UInt16:
        """Instance image (H, W) from the annotated point nearest to each depth pixel."""
        labels = np.zeros(frame.depth_m.shape, np.uint16)
        depth_m = frame.depth_m[::PIXEL_STRIDE, ::PIXEL_STRIDE]
        rows, columns = np.nonzero(depth_m > 0)
        if self._tree is None or not len(rows):
            return labels
        points_camera = frame.intrinsics.back_project(
            columns * PIXEL_STRIDE,
            rows * PIXEL_STRIDE,
            depth_m[rows, columns].astype(np.float64),
        )
        T = frame.T_world_camera
        points_world = points_camera @ T[:3, :3].T + T[:3, 3]
        distances, nearest = self._tree.query(points_world, distance_upper_bound=MAX_DISTANCE_M)
        near = np.isfinite(distances)
        coarse = np.zeros(depth_m.shape, np.uint16)
        coarse[rows[near], columns[near]] = self._point_ids[nearest[near]]
        fine = coarse.repeat(PIXEL_STRIDE, axis=0).repeat(PIXEL_STRIDE, axis=1)
        height, width = frame.depth_m.shape
        labels[:] = fine[:height, :width]
        labels[~(frame.depth_m > 0)] = 0
        return labels


# --- True boxes and classes in the configured perception: its masks and its relations.
#
# Errors of the detector are absent, so that edges are measured apart from them.


class AnnotatedBoxes:
    """A detector that states the detections of the frame in hand, whatever the image shows.

    Attributes:
        classes: of the data set.
        default_score_threshold: below the score of a true box.
        detections: of the frame in hand.
    """

    default_score_threshold = 0.5

    def __init__(self, classes: tuple[str, ...]) -> None:
        self.classes = classes
        self.detections: list[Detection] = []

    def detect(self, rgb: UInt8, score_threshold: float) -> Detections:
        """The detections in hand; see `Detector`."""
        found = [item for item in self.detections if item.score >= score_threshold]
        found = sorted(found, key=lambda item: -item.score)
        return Detections(
            np.array([item.box_xyxy for item in found], np.float64).reshape(-1, 4),
            np.array([item.class_probabilities for item in found]).reshape(-1, len(self.classes)),
            np.array([item.score for item in found], np.float64),
        )


class BoxesFrontEnd:
    """Perception with annotated boxes instead of a detector.

    Args:
        objects: the annotated objects of the scan.
        classes: of the data set.
        build: makes the perception around a detector.
        injection: injects faults into the boxes and classes.
    """

    def __init__(
        self,
        objects: AnnotatedObjects,
        classes: tuple[str, ...],
        build: Callable[[Detector], Perception],
        injection: Injection,
    ) -> None:
        self._objects = objects
        self._detector = AnnotatedBoxes(classes)
        self._perception = build(self._detector)
        self._injection = injection
        self.vocabulary = self._perception.vocabulary

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The annotated objects of a frame, with our masks and relations.

        Raises:
            EvaluationError: the frame is not in the scan.
        """
        seen = self._injection.apply(
            self._objects.detect(frame), frame, self._objects.number(frame)
        )
        self._detector.detections = list(seen.detections)
        return self._perception.perceive(frame)


# --- Detections and relations from the annotation; perfect without injected faults.

# Range of random relation scores: only the best relations of a frame are kept, and random scores
# give each relation its turn.
RELATION_SCORES = (0.8, 1.0)


class GroundTruthFrontEnd:
    """Detects the annotated objects and relations.

    Args:
        objects: the annotated objects of the scan.
        relations: (subject id, object id, index of the predicate) of the scan.
        vocabulary: classes and predicates of the data set.
        seed: random seed of the relation scores.
        top_relations: number of relations kept per frame.
        injection: injects faults; None = no faults.
    """

    def __init__(
        self,
        objects: AnnotatedObjects,
        relations: Sequence[tuple[int, int, int]],
        vocabulary: Vocabulary,
        *,
        seed: int = 0,
        top_relations: int = 10,
        injection: Injection | None = None,
    ) -> None:
        self.vocabulary = vocabulary
        self._objects = objects
        self._stated_relations = relations
        self._seed = seed
        self._top_relations = top_relations
        self._injection = injection

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """Detections and relations of a frame, with faults; raises EvaluationError."""
        number = self._objects.number(frame)
        seen = self._objects.detect(frame)
        indices = {item.instance: index for index, item in enumerate(seen.detections)}
        seen = replace(seen, relations=self._relate(number, indices))
        if self._injection is not None:
            seen = self._injection.apply(seen, frame, number)
        return assemble(frame, self.vocabulary, seen, self._top_relations)

    def _relate(self, number: int, indices: Mapping[int, int]) -> list[Relation]:
        stated: dict[tuple[int, int], dict[int, float]] = {}
        for subject, object_, predicate in self._stated_relations:
            if subject in indices and object_ in indices and subject != object_ and predicate >= 0:
                stated.setdefault((subject, object_), {})[predicate] = TRUE_PROBABILITY
        relations = []
        for (subject, object_), probabilities in stated.items():
            generator = np.random.default_rng([self._seed, 1, number, subject, object_])
            relations.append(
                Relation(
                    indices[subject],
                    indices[object_],
                    float(generator.uniform(*RELATION_SCORES)),
                    spread(probabilities, len(self.vocabulary.predicates)),
                )
            )
        return relations


# --- The choice of a front end, as picklable values, and the front end that it builds.

Kind = Literal["backend", "boxes", "recorded", "ground-truth"]
KINDS: tuple[Kind, ...] = ("backend", "boxes", "recorded", "ground-truth")
# Standard deviation of the edges of true boxes without --jitter, as in the recorded detections of
# the rendered rooms: no detector's boxes are exact.
BOXES_JITTER_PX = 2.0
# Faults of masks, which the front end `boxes` does not make.
MASK_FAULTS = ("bleed", "merge", "cut")


@dataclass(frozen=True)
class FrontEndChoice:
    """A front end and its faults.

    Attributes:
        kind: the configured ``backend``; ``boxes``, true boxes and classes in the configured
            perception; ``recorded`` detections; or ``ground-truth``.
        flip: fraction of labels that are wrong.
        miss: fraction of detections that are dropped.
        jitter_px: standard deviation of each box edge, pixels; None = 2 of ``boxes``, else 0.
        seed: random seed of the faults.
        faults: faults that persist over frames.

    Raises:
        EvaluationError: an unknown kind, a value out of range, faults of a backend, whose
            detections have no known objects, or faults of masks with ``boxes``.
    """

    kind: Kind = "backend"
    flip: float = 0.0
    miss: float = 0.0
    jitter_px: float | None = None
    seed: int = 0
    faults: Faults = Faults()

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise EvaluationError(f"--front-end {self.kind}: expected {', '.join(KINDS)}")
        for name, fraction in (("--flip", self.flip), ("--miss", self.miss)):
            if not 0.0 <= fraction <= 1.0:
                raise EvaluationError(f"{name} {fraction:g}: expected a fraction from 0 to 1")
        if self.edge_jitter_px < 0:
            raise EvaluationError(f"--jitter {self.edge_jitter_px:g}: expected 0 or more pixels")
        if self.kind == "backend" and self.stated():
            raise EvaluationError(
                f"--front-end backend with {self.stated()}: faults need boxes, recorded or "
                "ground-truth, whose detections have known objects"
            )
        of_masks = [name for name in MASK_FAULTS if getattr(self.faults, name)]
        if self.kind == "boxes" and of_masks:
            raise EvaluationError(
                f"--front-end boxes with {of_masks[0]} {getattr(self.faults, of_masks[0]):g}: the "
                "masks are those of the segmenter; expected faults of boxes and classes (flip, "
                "miss, jitter, label, false)"
            )

    @property
    def edge_jitter_px(self) -> float:
        """Standard deviation of each box edge, pixels."""
        if self.jitter_px is None:
            return BOXES_JITTER_PX if self.kind == "boxes" else 0.0
        return self.jitter_px

    def stated(self) -> str:
        """The faults, e.g. ``flip 0.1 miss 0.1``; empty without faults."""
        chosen = (("flip", self.flip), ("miss", self.miss), ("jitter", self.edge_jitter_px))
        words = [f"{name} {value:g}" for name, value in chosen if value]
        return " ".join(filter(None, [*words, self.faults.describe()]))

    def describe(self) -> str:
        """Kind and faults, e.g. ``recorded flip 0.1``."""
        return f"{self.kind} {self.stated()}".rstrip()


def build_front_end(
    choice: FrontEndChoice,
    annotations: Annotations,
    scan: str,
    source: Source,
    config: Config,
) -> Perceiver:
    """The front end of one scan; raises EvaluationError, RecordingError."""
    if choice.kind == "backend":
        return _backend(annotations, config)
    annotation = annotations.scan(scan)
    vocabulary = annotations.vocabulary
    recorded = choice.kind == "recorded"
    injection = Injection(
        vocabulary,
        list(annotation.objects.values()),
        # Recorded detections have their flipped labels in the file.
        FrameFaults(0.0 if recorded else choice.flip, choice.miss, choice.edge_jitter_px),
        choice.faults,
        choice.seed,
    )
    top_relations = config.perception.max_relations
    if recorded:
        if not isinstance(source, SequenceDataset):
            raise EvaluationError(
                f"--front-end recorded: {annotations.scan_folder(scan)} has no recorded "
                "detections; expected backend, boxes or ground-truth"
            )
        return RecordedFrontEnd(
            source.sequence,
            _frame_numbers(annotations, scan, source),
            vocabulary,
            flip=choice.flip,
            top_relations=top_relations,
            injection=injection,
        )
    objects = annotated_objects(annotations, scan, source)
    if choice.kind == "boxes":
        return _boxes(objects, injection, annotations, config)
    return GroundTruthFrontEnd(
        objects,
        annotation.relations,
        vocabulary,
        seed=choice.seed,
        top_relations=top_relations,
        injection=injection,
    )


def annotated_objects(annotations: Annotations, scan: str, source: Source) -> AnnotatedObjects:
    """The annotated objects of a scan in its frames; raises EvaluationError, RecordingError."""

    def instances(frame: RgbdFrame) -> UInt16 | None:
        if isinstance(annotations, RecordedRoom):
            return annotations.instances(frame.stamp_ns)
        return read_instances(source, frame.stamp_ns)

    return AnnotatedObjects(
        _frame_numbers(annotations, scan, source),
        instances,
        annotations.scan(scan),
        annotations.points(scan),
        len(annotations.vocabulary.classes),
    )


def _boxes(
    objects: AnnotatedObjects, injection: Injection, annotations: Annotations, config: Config
) -> BoxesFrontEnd:
    """True boxes in the configured perception; raises EvaluationError, ConfigurationError."""
    if config.perception.relation_head == "egtr":
        raise EvaluationError(
            "--front-end boxes with perception.relation_head egtr, which reads its detector's "
            "queries: set perception.relation_head to geometric"
        )

    def build(detector: Detector) -> Perception:
        return _backend(annotations, config, detector)

    return BoxesFrontEnd(objects, annotations.vocabulary.classes, build, injection)


def _backend(
    annotations: Annotations, config: Config, detector: Detector | None = None
) -> Perception:
    """The configured perception, with the predicates of the data set.

    `detector` replaces the configured one.
    """
    names = {predicates: name for name, predicates in PREDICATE_SETS.items()}
    predicate_set = names.get(annotations.vocabulary.predicates)
    perception = config.perception
    if predicate_set is not None:
        perception = msgspec.structs.replace(perception, predicate_set=predicate_set)
    return build_perception(perception, world_up=config.inputs.world_up, detector=detector)


def _frame_numbers(annotations: Annotations, scan: str, source: Source) -> Mapping[int, int]:
    """Number of each frame by its stamp in nanoseconds; raises EvaluationError."""
    if isinstance(annotations, RecordedRoom):
        return annotations.frame_numbers
    if isinstance(source, SequenceDataset):
        return source.frame_numbers
    raise EvaluationError(
        f"{annotations.scan_folder(scan)} is a {source.kind}: expected a scan in 3RScan's layout"
    )


# --- Front ends: detections and relations of a backend, true boxes, a recording or ground truth.
#
# Each is a `pipeline.Perceiver`. Methods of lifting and merging are compared on identical
# detections.

__all__ = ["Faults", "FrontEndChoice", "build_front_end", "parse_faults"]


# --- Sources of the camera poses of an evaluation, as picklable values.

PoseKind = Literal["ground-truth", "slam", "odometry", "perturbed"]
POSE_KINDS: tuple[PoseKind, ...] = ("ground-truth", "slam", "odometry", "perturbed")
# Drift of 2 % and 1 degree per metre, and jitter of a hand-held camera: worse than good SLAM.
PERTURBATION = PoseNoise(jitter_m=0.005, jitter_deg=0.2, drift_m_per_m=0.02, drift_deg_per_m=1.0)


@dataclass(frozen=True)
class PoseSource:
    """A source of poses. All sources start at the first ground-truth pose.

    Attributes:
        kind: ``ground-truth`` of the data set, ``slam`` from the .slam.pose.txt of the frames,
            ``odometry`` from the images, or ``perturbed`` ground truth.
        noise: noise of ``perturbed``.

    Raises:
        EvaluationError: an unknown kind.
    """

    kind: PoseKind = "ground-truth"
    noise: PoseNoise = PERTURBATION

    def __post_init__(self) -> None:
        if self.kind not in POSE_KINDS:
            raise EvaluationError(f"--poses {self.kind}: expected {', '.join(POSE_KINDS)}")


def repose(
    frames: Iterator[RgbdFrame],
    poses: PoseSource,
    source: Source,
    drops: Counter[str],
) -> Iterator[RgbdFrame]:
    """The frames with the chosen poses. Frames without a pose are dropped and counted in `drops`.

    Raises:
        DeWorldSGError: a trajectory cannot be read.
    """
    if poses.kind == "ground-truth":
        return frames
    if poses.kind == "perturbed":
        return perturb_poses(frames, poses.noise)
    first = next(frames, None)
    if first is None:
        return frames
    again = chain([first], frames)
    if poses.kind == "slam":
        if not isinstance(source, SequenceDataset):
            raise EvaluationError(
                "--poses slam: the recording has no frame-NNNNNN.slam.pose.txt; use other poses"
            )
        return _of_slam(again, source, drops)

    def lost(refusal: RefusedInput) -> None:
        drops[refusal.reason] += 1

    return track_poses(again, first.T_world_camera, lost)


def _of_slam(
    frames: Iterator[RgbdFrame], dataset: SequenceDataset, drops: Counter[str]
) -> Iterator[RgbdFrame]:
    trajectory = read_trajectory(dataset.sequence, "slam")
    T_truth_slam = None
    for index, frame in enumerate(frames):
        number = dataset.frame_numbers[frame.stamp_ns]
        T_slam_camera = trajectory.at(frame.stamp_ns, number, index, 0)
        if T_slam_camera is None:
            drops["no_slam_pose"] += 1
            continue
        # Trackers process the images as stored; `rotated` data sets rotate them when they are read.
        T_slam_camera = rotated_pose(T_slam_camera) if dataset.rotated else T_slam_camera
        if T_truth_slam is None:
            # The SLAM world starts at its first camera: align that pose with the ground truth.
            T_truth_slam = frame.T_world_camera @ invert_pose(T_slam_camera)
        yield replace(frame, T_world_camera=T_truth_slam @ T_slam_camera)
