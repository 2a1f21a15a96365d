"""Recorded detections and relations: a frontend.json beside each frame.

docs/dev/evaluation/protocol.md describes the file. The rest of a distribution, which the file does
not state, is spread evenly over the other classes or predicates. Relation probabilities become
logits.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends.assembly import (
    Detection,
    FrameDetections,
    Relation,
    assemble,
    spread,
)
from deworldsg_ros.evaluation.front_ends.injection import Injection
from deworldsg_ros.parsing import parse_any_json
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.recordings.folders.dataset import decode_image, read_file
from deworldsg_ros.scene.arrays import UInt16
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import Vocabulary

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
            instance_image = read_instances(self._sequence / names.pop())
        if instance_image.shape != shape:
            raise ValueError(f"instance image is {instance_image.shape}: expected {shape}")
        indices = {index for item in relations for index in (item.subject, item.object)}
        if not indices <= set(range(len(detections))):
            raise ValueError(f"relations name detections {sorted(indices)} of {len(detections)}")
        return FrameDetections(detections, relations, instance_image)


def read_instances(path: Path) -> UInt16:
    """Instance image (H, W) of a 16-bit PNG; raises RecordingError."""
    return np.asarray(decode_image(read_file(path), cv2.IMREAD_UNCHANGED, path), np.uint16)
