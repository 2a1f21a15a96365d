"""Detections as a topic brings them: names and scores against whole distributions.

    python bench/sent.py [RECORDING]

The embedded detector finds the objects of each frame, once. Then the graph is built from them as
they are; from whole distributions, as a source may send them; from one name and its score; and from
these without what the source's own changes of mind tell (`perception/source.py`).
"""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from deworldsg_ros.config import Config, PerceptionConfig
from deworldsg_ros.evaluation.graph_measures import measure, read_reference
from deworldsg_ros.evaluation.recorded_room import RecordedRoom
from deworldsg_ros.perception import source
from deworldsg_ros.perception.protocols import Detections
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.camera import RgbdFrame, SentDetections

DEMO_ROOM = Path(__file__).resolve().parents[1] / "bags" / "demo_room"
# Detectors are asked for weaker boxes, too: they keep pixels out of masks.
LEAST_SCORE = 0.2


def sent(found: Detections, classes: tuple[str, ...], *, full: bool) -> SentDetections:
    """Detections as a source sends them: with whole distributions, or one name and its score."""
    best = found.class_probabilities.argmax(axis=1)
    names = [classes if full else (classes[label],) for label in best]
    scores = [
        tuple(row.tolist()) if full else (float(score),)
        for row, score in zip(found.class_probabilities, found.scores)
    ]
    return SentDetections(found.boxes_xyxy, found.scores, tuple(names), tuple(scores))


def main(recording: Path) -> None:
    """Print a line of measures for each way."""
    detector = build_perception(PerceptionConfig())._detector
    with closing(open_source(recording)) as opened:
        frames = list(Recording(opened).frames())
    found = [detector.detect(frame.rgb, LEAST_SCORE) for frame in frames]

    def frames_with(full: bool) -> list[RgbdFrame]:
        return [
            replace(frame, sent=sent(one, detector.classes, full=full))
            for frame, one in zip(frames, found)
        ]

    truth = RecordedRoom(recording)
    (scan,) = truth.scans()
    reference = read_reference(truth, scan, truth.points(scan))
    topic = Config(perception=PerceptionConfig(detector="topic"))
    learned = source.DetectionSource._compare
    for name, config, given, compare in (
        ("own detector", Config(), frames, learned),
        ("distributions", topic, frames_with(True), learned),
        ("name and score", topic, frames_with(False), learned),
        ("without changes of mind", topic, frames_with(False), _forget),
    ):
        source.DetectionSource._compare = compare  # type: ignore[method-assign]
        pipeline = Pipeline(config)
        for frame in given:
            pipeline.process(frame)
        done = measure(pipeline.graph(), reference)
        numbers = done.numbers()
        print(
            f"{name:24} found {done.found} of {done.objects}, {done.duplicates} duplicates, "
            f"precision {numbers['node_precision']:.2f}, class ECE "
            f"{100 * numbers['node_calibration_error']:.0f} %"
        )
    source.DetectionSource._compare = learned  # type: ignore[method-assign]


def _forget(known: source.DetectionSource, boxes: np.ndarray, best: list[int]) -> None:
    """In place of `_compare`: nothing is learned."""
    known._said = np.zeros((len(known.classes), len(known.classes)))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DEMO_ROOM)
