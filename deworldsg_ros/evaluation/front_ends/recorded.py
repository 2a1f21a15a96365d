"""Recorded detections and relations: frontend.json beside each frame.

docs/evaluation/protocol.md describes the file. A class or predicate without a stated value gets
an even share of what the stated probabilities leave; relation probabilities become logits.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.front_ends.assembly import Detection, Relation, Seen, assemble, spread
from deworldsg_ros.evaluation.front_ends.injection import Injection
from deworldsg_ros.perception.stage import Perceived
from deworldsg_ros.recordings.folders.dataset import decode_image, read_file
from deworldsg_ros.scene.arrays import UInt16
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.frame_graph import Vocabulary

VERSION = 1
# Recordings by the share of their labels that are flipped.
FILE_SUFFIXES = {0.0: ".frontend.json", 0.1: ".frontend_flip10.json"}


class RecordedFrontEnd:
    """Replays what was recorded beside the frames.

    Args:
        sequence: folder of the frames.
        frame_numbers: number of the frame in its file names, by its stamp in nanoseconds.
        vocabulary: the classes and predicates that the recording counts.
        flip: which recording: the share of flipped labels, 0 or 0.1.
        top_relations: relations kept a frame.
        injection: puts faults into what was recorded; None = none.

    Raises:
        EvaluationError: for a share that was not recorded.
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
            known = ", ".join(f"{share:g}" for share in FILE_SUFFIXES)
            raise EvaluationError(f"--flip {flip:g} was not recorded: wanted {known}")
        self.vocabulary = vocabulary
        self._sequence = sequence
        self._frame_numbers = frame_numbers
        self._suffix = FILE_SUFFIXES[flip]
        self._top_relations = top_relations
        self._injection = injection

    def perceive(self, frame: RgbdFrame) -> Perceived:
        """The recorded graph of this frame; raises EvaluationError where there is none."""
        if frame.stamp_ns not in self._frame_numbers:
            raise EvaluationError(f"frame of {frame.stamp_ns} ns is not of {self._sequence}")
        number = self._frame_numbers[frame.stamp_ns]
        path = self._sequence / f"frame-{number:06d}{self._suffix}"
        try:
            seen = self._read(frame, json.loads(read_file(path)))
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise EvaluationError(
                f"{path} is no recording of version {VERSION}: {type(error).__name__}: {error}"
            ) from error
        if self._injection is not None:
            seen = self._injection.apply(seen, frame, number)
        return assemble(frame, self.vocabulary, seen, self._top_relations)

    def _read(self, frame: RgbdFrame, content: Mapping[str, Any]) -> Seen:
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
            raise ValueError(f"masks are in {sorted(names)}: wanted one image")
        shape = (frame.intrinsics.height, frame.intrinsics.width)
        instance_image = np.zeros(shape, np.uint16)
        if names:
            instance_image = read_instances(self._sequence / names.pop())
        if instance_image.shape != shape:
            raise ValueError(f"instance image is {instance_image.shape}: wanted {shape}")
        places = {place for item in relations for place in (item.subject, item.object)}
        if not places <= set(range(len(detections))):
            raise ValueError(f"relations name detections {sorted(places)} of {len(detections)}")
        return Seen(detections, relations, instance_image)


def read_instances(path: Path) -> UInt16:
    """Instance image (H, W) of a 16-bit PNG; raises RecordingError."""
    return np.asarray(decode_image(read_file(path), cv2.IMREAD_UNCHANGED, path), np.uint16)
