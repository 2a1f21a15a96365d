"""The choice of a front end, as picklable values, and the front end that it builds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import msgspec

from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends.annotated import AnnotatedObjects
from deworldsg_ros.evaluation.front_ends.boxes import BoxesFrontEnd
from deworldsg_ros.evaluation.front_ends.faults import Faults
from deworldsg_ros.evaluation.front_ends.ground_truth import GroundTruthFrontEnd
from deworldsg_ros.evaluation.front_ends.injection import FrameFaults, Injection
from deworldsg_ros.evaluation.front_ends.recorded import RecordedFrontEnd
from deworldsg_ros.evaluation.recorded_room import RecordedRoom
from deworldsg_ros.perception.protocols import Detector
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.stage import Perception
from deworldsg_ros.pipeline import Perceiver
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.instances import read_instances
from deworldsg_ros.recordings.folders.sequence import SequenceDataset
from deworldsg_ros.recordings.source import Source
from deworldsg_ros.scene.arrays import UInt16
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.vocabularies import PREDICATE_SETS

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
    frame_numbers = _frame_numbers(annotations, scan, source)
    top_relations = config.perception.max_relations
    if recorded:
        if not isinstance(source, SequenceDataset):
            raise EvaluationError(
                f"--front-end recorded: {annotations.scan_folder(scan)} has no recorded "
                "detections; expected backend, boxes or ground-truth"
            )
        return RecordedFrontEnd(
            source.sequence,
            frame_numbers,
            vocabulary,
            flip=choice.flip,
            top_relations=top_relations,
            injection=injection,
        )

    def instances(frame: RgbdFrame) -> UInt16 | None:
        if isinstance(annotations, RecordedRoom):
            return annotations.instances(frame.stamp_ns)
        return read_instances(source, frame.stamp_ns)

    objects = AnnotatedObjects(
        frame_numbers, instances, annotation, annotations.points(scan), len(vocabulary.classes)
    )
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
