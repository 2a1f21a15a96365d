"""`deworldsg run` of the kitchen: frames per second with overlapping stages, and in turn.

    python bench/kitchen.py FOLDER

Both pipelines process the same 50 frames one after the other, then the next 50. The ratio is the
median over these pairs. Both must build the same graph.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Compared:
    """Seconds a frame of each part, and the overlapping pipeline.

    Attributes:
        overlapping_s, in_turn_s: by the clock.
        processor_s: of all threads, overlapping.
        pipeline: after all parts.
    """

    overlapping_s: list[float]
    in_turn_s: list[float]
    processor_s: list[float]
    pipeline: Pipeline


def compare(folder: Path, parts: int) -> Compared:
    """Both pipelines on each part; raises AssertionError if their graphs differ."""
    cv2.setNumThreads(1)
    overlapping, in_turn = Pipeline(Config(), overlapped=True), Pipeline(Config())
    for pipeline in (overlapping, in_turn):
        pipeline.lifting.warm_up()
    warm_up(Config())
    result = Compared([], [], [], overlapping)
    for number, (mine, other) in enumerate(zip(frames_in_parts(folder), frames_in_parts(folder))):
        if number == parts:
            break
        start, start_processor = time.perf_counter(), time.process_time()
        for _ in overlapping.process_all(mine[0]):
            pass
        middle, middle_processor = time.perf_counter(), time.process_time()
        for frame in other[0]:
            in_turn.process(frame)
        result.overlapping_s.append((middle - start) / mine[1])
        result.in_turn_s.append((time.perf_counter() - middle) / other[1])
        result.processor_s.append((middle_processor - start_processor) / mine[1])
    assert overlapping.graph() == in_turn.graph()
    return result


def figures(setup: Setup) -> list[Figure]:
    """Figures of `python -m bench`: the rate, and the milliseconds of each stage."""
    found = compare(setup.folder("redkitchen"), 1 if setup.quick else 5)
    processor_ms = 1e3 * statistics.median(found.processor_s)
    cores = len(os.sched_getaffinity(0))
    rate = Figure(
        "kitchen_run",
        1.0 / statistics.median(found.overlapping_s),
        "frames/s",
        target=32,
        more_is_better=True,
        reference="the same stages in turn",
        reference_value=1.0 / statistics.median(found.in_turn_s),
        ratio=statistics.median(b / a for a, b in zip(found.overlapping_s, found.in_turn_s)),
        note=f"median of parts of {FRAMES_OF_A_PAIR} frames, by the clock; the same graph",
    )
    processor = Figure(
        "kitchen_processor",
        processor_ms,
        "ms",
        note=f"processor time of a frame, all threads: {cores} cores cannot do more than "
        f"{1e3 * cores / processor_ms:.1f} frames/s",
    )
    stages = [
        Figure(
            f"kitchen_{stage}",
            1e3 * statistics.median(times.newest_s),
            "ms",
            note="median of a frame in its own thread, by the clock, while other stages run",
        )
        for stage, times in found.pipeline.times_s.items()
        if times.count
    ]
    return [rate, processor, *stages]


if __name__ == "__main__":
    for figure in figures(Setup(Path(sys.argv[1]).resolve().parent)):
        print(f"{figure.name}: {figure.value:.2f} {figure.unit}")
