"""Which front end, as plain values that travel to another process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import msgspec

from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends.faults import Faults
from deworldsg_ros.evaluation.front_ends.ground_truth import GroundTruthFrontEnd
from deworldsg_ros.evaluation.front_ends.injection import FrameFaults, Injection
from deworldsg_ros.evaluation.front_ends.recorded import RecordedFrontEnd
from deworldsg_ros.evaluation.recorded_room import RecordedRoom
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.pipeline import Perceiver
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.instances import read_instances
from deworldsg_ros.recordings.folders.sequence import SequenceDataset
from deworldsg_ros.recordings.source import Source
from deworldsg_ros.scene.arrays import UInt16
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.vocabularies import PREDICATE_SETS

Kind = Literal["backend", "recorded", "ground-truth"]
KINDS: tuple[Kind, ...] = ("backend", "recorded", "ground-truth")


@dataclass(frozen=True)
class FrontEndChoice:
    """A front end and its faults.

    Attributes:
        kind: the configured backend, what was recorded, or made from ground truth.
        flip: share of labels that are wrong.
        miss: share of detections that are missing.
        jitter_px: standard deviation of each box edge, pixels.
        seed: of the faults.
        faults: that persist over frames.

    Raises:
        EvaluationError: for an unknown kind, what is no share, or faults of a backend, whose
            detections cannot be told apart.
    """

    kind: Kind = "backend"
    flip: float = 0.0
    miss: float = 0.0
    jitter_px: float = 0.0
    seed: int = 0
    faults: Faults = Faults()

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise EvaluationError(f"--front-end {self.kind}: wanted {', '.join(KINDS)}")
        for name, share in (("--flip", self.flip), ("--miss", self.miss)):
            if not 0.0 <= share <= 1.0:
                raise EvaluationError(f"{name} {share:g}: wanted a share from 0 to 1")
        if self.jitter_px < 0:
            raise EvaluationError(f"--jitter {self.jitter_px:g}: wanted 0 or more pixels")
        if self.kind == "backend" and self.stated():
            raise EvaluationError(
                f"--front-end backend with {self.stated()}: wanted recorded or ground-truth, "
                "which know what each detection is of"
            )

    def stated(self) -> str:
        """Its faults in a few words; empty for none."""
        chosen = (("flip", self.flip), ("miss", self.miss), ("jitter", self.jitter_px))
        words = [f"{name} {value:g}" for name, value in chosen if value]
        return " ".join(filter(None, [*words, self.faults.describe()]))

    def describe(self) -> str:
        """In a few words."""
        return f"{self.kind} {self.stated()}".rstrip()


def build_front_end(
    choice: FrontEndChoice,
    annotations: Annotations,
    scan: str,
    source: Source,
    config: Config,
) -> Perceiver:
    """The chosen front end for one scan; raises EvaluationError, RecordingError."""
    if choice.kind == "backend":
        # Predicates are the data set's, whatever the configuration says.
        names = {predicates: name for name, predicates in PREDICATE_SETS.items()}
        predicate_set = names.get(annotations.vocabulary.predicates)
        perception = config.perception
        if predicate_set is not None:
            perception = msgspec.structs.replace(perception, predicate_set=predicate_set)
        return build_perception(perception, world_up=config.inputs.world_up)
    annotation = annotations.scan(scan)
    recorded = choice.kind == "recorded"
    injection = Injection(
        annotations.vocabulary,
        list(annotation.objects.values()),
        # Flips of a recording are recorded.
        FrameFaults(0.0 if recorded else choice.flip, choice.miss, choice.jitter_px),
        choice.faults,
        choice.seed,
    )
    top_relations = config.perception.max_relations
    if isinstance(annotations, RecordedRoom):
        frame_numbers = annotations.frame_numbers
    elif isinstance(source, SequenceDataset):
        frame_numbers = source.frame_numbers
    else:
        raise EvaluationError(f"{annotations.scan_folder(scan)}: wanted a scan in 3RScan's layout")
    if recorded:
        if not isinstance(source, SequenceDataset):
            raise EvaluationError(
                "--front-end recorded: this recording has no recorded detections; wanted backend "
                "or ground-truth"
            )
        return RecordedFrontEnd(
            source.sequence,
            frame_numbers,
            annotations.vocabulary,
            flip=choice.flip,
            top_relations=top_relations,
            injection=injection,
        )

    def instances(frame: RgbdFrame) -> UInt16 | None:
        if isinstance(annotations, RecordedRoom):
            return annotations.instances(frame.stamp_ns)
        return read_instances(source, frame.stamp_ns)

    return GroundTruthFrontEnd(
        frame_numbers,
        instances,
        annotation,
        annotations.points(scan),
        annotations.vocabulary,
        seed=choice.seed,
        top_relations=top_relations,
        injection=injection,
    )
