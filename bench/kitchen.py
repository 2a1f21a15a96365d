"""`deworldsg run` of the kitchen: frames per second with overlapping stages, and in turn.

    python bench/kitchen.py FOLDER

Both pipelines process the same 50 frames one after the other, then the next 50. The ratio is the
median over these pairs. Both must build the same graph.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.figures import Figure, Setup
from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import warm_up
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.recording import open_recording
from deworldsg_ros.scene.camera import RgbdFrame

FRAMES_OF_A_PAIR = 50


def frames_in_parts(folder: Path) -> Iterator[tuple[Iterator[RgbdFrame], int]]:
    """The frames of a recording, in parts that are read when they are used, and their numbers."""
    recording = open_recording(folder)
    frames = recording.frames()
    for first in range(0, recording.frame_count, FRAMES_OF_A_PAIR):
        count = min(FRAMES_OF_A_PAIR, recording.frame_count - first)
        yield (next(frames) for _ in range(count)), count


def compare(folder: Path, parts: int) -> tuple[list[float], list[float], Pipeline]:
    """Seconds a frame of each part: overlapping, and in turn; the overlapping pipeline."""
    cv2.setNumThreads(1)
    overlapping, in_turn = Pipeline(Config(), overlapped=True), Pipeline(Config())
    for pipeline in (overlapping, in_turn):
        pipeline.lifting.warm_up()
    warm_up(Config())
    ours, reference = [], []
    for number, (mine, other) in enumerate(zip(frames_in_parts(folder), frames_in_parts(folder))):
        if number == parts:
            break
        start = time.perf_counter()
        for _ in overlapping.process_all(mine[0]):
            pass
        middle = time.perf_counter()
        for frame in other[0]:
            in_turn.process(frame)
        ours.append((middle - start) / mine[1])
        reference.append((time.perf_counter() - middle) / other[1])
    assert overlapping.graph() == in_turn.graph()
    return ours, reference, overlapping


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`: the rate, and the milliseconds of each stage."""
    ours, reference, pipeline = compare(setup.folder("redkitchen"), 1 if setup.quick else 5)
    rate = Figure(
        "kitchen_run",
        1.0 / statistics.median(ours),
        "frames/s",
        target=32,
        more_is_better=True,
        reference="the same stages in turn",
        reference_value=1.0 / statistics.median(reference),
        ratio=statistics.median(b / a for a, b in zip(ours, reference)),
        note=f"median of parts of {FRAMES_OF_A_PAIR} frames, by the clock; the same graph",
    )
    stages = [
        Figure(
            f"kitchen_{stage}",
            1e3 * statistics.median(times_s),
            "ms",
            note="median of a frame in its own thread, by the clock, while other stages run",
        )
        for stage, times_s in pipeline.times_s.items()
        if times_s
    ]
    return [rate, *stages]


if __name__ == "__main__":
    for figure in figures(Setup(Path(sys.argv[1]).resolve().parent)):
        print(f"{figure.name}: {figure.value:.2f} {figure.unit}")
