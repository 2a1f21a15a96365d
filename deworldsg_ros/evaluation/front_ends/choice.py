"""Which front end, as plain values that travel to another process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import msgspec

from deworldsg_ros.config import Config
from deworldsg_ros.datasets.annotations import Annotations
from deworldsg_ros.datasets.sequence import SequenceDataset
from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends.ground_truth import GroundTruthFrontEnd
from deworldsg_ros.evaluation.front_ends.recorded import RecordedFrontEnd
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.perception.vocabularies import PREDICATE_SETS
from deworldsg_ros.pipeline import Perceiver

Kind = Literal["backend", "recorded", "ground-truth"]
KINDS: tuple[Kind, ...] = ("backend", "recorded", "ground-truth")


@dataclass(frozen=True)
class FrontEndChoice:
    """A front end and its faults.

    Attributes:
        kind: the configured backend, what was recorded, or made from ground truth.
        flip: share of labels that are wrong.
        miss: share of detections that are missing (ground truth).
        jitter_px: standard deviation of each box edge, pixels (ground truth).
        seed: of the faults (ground truth).
    """

    kind: Kind = "backend"
    flip: float = 0.0
    miss: float = 0.0
    jitter_px: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise EvaluationError(f"--front-end {self.kind}: wanted {', '.join(KINDS)}")
        for name, share in (("--flip", self.flip), ("--miss", self.miss)):
            if not 0.0 <= share <= 1.0:
                raise EvaluationError(f"{name} {share:g}: wanted a share from 0 to 1")
        if self.jitter_px < 0:
            raise EvaluationError(f"--jitter {self.jitter_px:g}: wanted 0 or more pixels")

    def describe(self) -> str:
        """In a few words."""
        faults = (("flip", self.flip), ("miss", self.miss), ("jitter", self.jitter_px))
        stated = [f"{name} {value:g}" for name, value in faults if value]
        return " ".join([self.kind, *stated])


def build_front_end(
    choice: FrontEndChoice,
    annotations: Annotations,
    scan: str,
    dataset: SequenceDataset,
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
    if choice.kind == "recorded":
        return RecordedFrontEnd(
            dataset.sequence,
            dataset.frame_numbers,
            annotations.vocabulary,
            flip=choice.flip,
            top_relations=config.perception.top_relations,
        )
    return GroundTruthFrontEnd(
        dataset,
        annotations.scan(scan),
        annotations.points(scan),
        annotations.vocabulary,
        miss=choice.miss,
        jitter_px=choice.jitter_px,
        flip=choice.flip,
        seed=choice.seed,
        top_relations=config.perception.top_relations,
    )
