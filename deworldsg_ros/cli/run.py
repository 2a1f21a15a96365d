"""`deworldsg run`: a recording becomes a scene graph in one process, without ROS."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from deworldsg_ros import __version__
from deworldsg_ros.bags.errors import RecordingError
from deworldsg_ros.bags.recording import Recording, open_recording
from deworldsg_ros.bags.topics import TopicChoice
from deworldsg_ros.cli import outputs
from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.cli.progress import frame_progress
from deworldsg_ros.datasets.dataset import DatasetOptions
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.scene.camera import Float64
from deworldsg_ros.scene.errors import RefusedInput

# The bar shows the number of nodes every so many frames: counting them costs something.
COUNT_EVERY = 5
LOADING = "loading the models … (the first time kernels are compiled, which takes a minute or two)"


def run_recording(
    path: Path,
    out: Path,
    config_path: Path | None,
    settings: list[str],
    *,
    max_frames: int,
    topics: TopicChoice,
    options: DatasetOptions,
    console: Console,
) -> None:
    """Run, write the results and print them; raises DeWorldSGError."""
    config = effective_config(config_path, settings)
    recording = open_recording(path, config.inputs, topics=topics, options=options)
    try:
        outputs.prepare_folder(out, config)
        with console.status(LOADING):
            pipeline = Pipeline(config)
            pipeline.lifting.warm_up()
        started_s = time.perf_counter()
        poses, refused = _process(recording, pipeline, max_frames, console)
        wall_s = time.perf_counter() - started_s
    finally:
        recording.close()
    drops = {"recording": dict(recording.drops), "pipeline": dict(refused)}
    processed = len(poses)
    if not processed:
        outputs.print_drops(console, recording.losses, drops, recording.reasons)
        raise RecordingError(f"recording {path}: not one frame could be used")
    graph = pipeline.graph()
    outputs.write_graph(out, graph)
    outputs.show_graph(out, graph, console, poses, config.inputs.world_up)
    report = {
        "program": f"deworldsg {__version__} run",
        "recording": recording.name,
        "kind": recording.source.kind,
        "frames": {"images": recording.frame_count, "processed": processed},
        "drops": {**drops, "objects": dict(pipeline.drops)},
        "losses": recording.losses,
        "nodes": len(graph.nodes),
        "edges": len(graph.edges),
        "wall_s": round(wall_s, 3),
        "frames_per_s": round(processed / wall_s, 2),
        "times_ms": _times_ms(pipeline.times_s),
    }
    outputs.write_report(out, report)
    outputs.print_drops(console, recording.losses, drops, recording.reasons)
    console.print(
        f"{processed} frames in {wall_s:.1f} s ({processed / wall_s:.1f} a second)", highlight=False
    )
    outputs.print_files(console, out)


def _process(
    recording: Recording, pipeline: Pipeline, max_frames: int, console: Console
) -> tuple[list[Float64], Counter[str]]:
    """Poses (4, 4) of the frames that were processed, and refusals by reason."""
    poses: list[Float64] = []
    refused: Counter[str] = Counter()
    total = min(recording.frame_count, max_frames or recording.frame_count)
    with frame_progress(console) as progress:
        task = progress.add_task("building the graph", total=total, note="")
        for frame in itertools.islice(recording.frames(), max_frames or None):
            try:
                pipeline.process(frame)
                poses.append(frame.T_world_camera)
            except RefusedInput as refusal:
                refused[refusal.reason] += 1
                recording.reasons.setdefault(refusal.reason, str(refusal))
            progress.advance(task)
            if pipeline.builder is not None and len(poses) % COUNT_EVERY == 0:
                progress.update(task, note=f"{len(pipeline.builder.graph)} nodes")
        if pipeline.builder is not None:
            note = f"{len(pipeline.builder.graph)} nodes"
            progress.update(task, note=note, total=len(poses) + refused.total())
    return poses, refused


def _times_ms(times_s: dict[str, list[float]]) -> dict[str, Any]:
    """Median and 95th percentile of each stage."""
    return {
        stage: {
            "median": round(1e3 * float(np.median(values)), 3),
            "p95": round(1e3 * float(np.percentile(values, 95)), 3),
        }
        for stage, values in times_s.items()
        if values
    }
