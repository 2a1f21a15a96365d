"""`deworldsg run`: a recording becomes a scene graph in one process, without ROS."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from deworldsg_ros import __version__
from deworldsg_ros.cli import outputs
from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.cli.progress import frame_progress, working
from deworldsg_ros.evaluation.measures.temporal import UpdateLog
from deworldsg_ros.graph_builder import GraphBuilder, check_map_writable
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.poses.odometry import HAS_ODOMETRY, WITHOUT_ODOMETRY
from deworldsg_ros.poses.trajectory import write_tum
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.messages import Role
from deworldsg_ros.recordings.posing import PoseChoice, PosedSource, choose_poses, posed_frames
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.timing import STAGES, device_name, total_ms

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
    poses: PoseChoice,
    temporal: bool,
    trajectory_out: Path | None,
    map_path: Path | None = None,
    timings: bool = False,
    console: Console,
) -> None:
    """Run, write the results and print them; raises DeWorldSGError."""
    config = effective_config(config_path, settings)
    if poses.odometry and not HAS_ODOMETRY:
        console.print(f"[yellow]warning:[/] {WITHOUT_ODOMETRY}", highlight=False, soft_wrap=True)
    source = open_source(
        path,
        topics=topics,
        inputs=config.inputs,
        options=options,
        need_poses=poses.need_poses,
    )
    try:
        recording = Recording(choose_poses(source, poses, config), config.inputs)
        outputs.prepare_folder(out, config)
        if map_path is not None:
            check_map_writable(map_path)
        with working(console, LOADING):
            pipeline = Pipeline(config)
            pipeline.lifting.warm_up()
        if map_path is not None and map_path.exists():
            pipeline.go_on_with(GraphBuilder.from_map(config, map_path))
            console.print(f"going on with {map_path}", highlight=False, soft_wrap=True)
        started_s = time.perf_counter()
        updates = UpdateLog(config.output.rate_hz) if temporal else None
        path_taken, refused = _process(recording, pipeline, poses, max_frames, console, updates)
        wall_s = time.perf_counter() - started_s
    finally:
        source.close()
    drops = {"recording": dict(recording.drops), "pipeline": dict(refused)}
    processed = len(path_taken)
    if not processed:
        outputs.print_drops(console, recording.losses, drops, recording.reasons)
        raise RecordingError(f"recording {path}: not one frame could be used")
    graph = pipeline.graph()
    outputs.write_graph(out, graph)
    T_world_cameras = list(path_taken.values())
    outputs.show_graph(out, graph, console, T_world_cameras, config.inputs.world_up)
    if trajectory_out is not None:
        write_tum(trajectory_out, list(path_taken), T_world_cameras)
    if map_path is not None and pipeline.builder is not None:
        pipeline.builder.save_map(map_path)
    clips = pipeline.relations.counters()
    if failed := clips.dropped.get("world_model_error"):
        drops["world model"] = {"world_model_error": failed}
    report = {
        "program": f"deworldsg {__version__} run",
        "recording": recording.name,
        "kind": recording.source.kind,
        "poses": recording.source.topics[Role.POSE].name,
        "frames": {"images": recording.frame_count, "processed": processed},
        "drops": {**drops, "objects": dict(pipeline.drops)},
        "losses": recording.losses,
        "nodes": len(graph.nodes),
        "edges": len(graph.edges),
        "wall_s": round(wall_s, 3),
        "frames_per_s": round(processed / wall_s, 2),
        "times_ms": _times_ms(pipeline.times_s),
        "device": device_name(),
    }
    if pipeline.relations.source != "none":
        report["clips"] = asdict(clips)
    if updates is not None:
        report["temporal"] = updates.quality().numbers()
    outputs.write_report(out, report)
    outputs.print_drops(console, recording.losses, drops, recording.reasons)
    console.print(
        f"{processed} frames in {wall_s:.1f} s ({processed / wall_s:.1f} a second)", highlight=False
    )
    if timings:
        _print_timings(console, pipeline.times_s, processed)
    outputs.print_files(console, out)
    if map_path is not None:
        console.print(f"  {map_path}  [dim]the map[/]", highlight=False, soft_wrap=True)


def _process(
    recording: Recording,
    pipeline: Pipeline,
    choice: PoseChoice,
    max_frames: int,
    console: Console,
    updates: UpdateLog | None,
) -> tuple[dict[int, Float64], Counter[str]]:
    """Poses (4, 4) of the frames that were processed, by stamp, and refusals by reason."""
    poses: dict[int, Float64] = {}
    refused: Counter[str] = Counter()

    def refuse(refusal: RefusedInput) -> None:
        refused[refusal.reason] += 1
        recording.reasons.setdefault(refusal.reason, str(refusal))

    total = min(recording.frame_count, max_frames or recording.frame_count)
    with frame_progress(console) as progress:
        task = progress.add_task("building the graph", total=total, note="")
        frames = posed_frames(recording, choice, pipeline.config, refuse)
        for frame in itertools.islice(frames, max_frames or None):
            try:
                result = pipeline.process(frame)
                poses[frame.stamp_ns] = frame.T_world_camera
            except RefusedInput as refusal:
                refuse(refusal)
            else:
                if updates is not None and pipeline.builder is not None:
                    source = recording.source
                    truth = source.original if isinstance(source, PosedSource) else source
                    updates.note(pipeline.builder, truth, result)
            progress.advance(task)
            if pipeline.builder is not None and len(poses) % COUNT_EVERY == 0:
                progress.update(task, note=f"{pipeline.builder.confirmed} nodes")
        if pipeline.builder is not None:
            note = f"{pipeline.builder.confirmed} nodes"
            progress.update(task, note=note, total=len(poses) + refused.total())
    return poses, refused


def _times_ms(times_s: dict[str, list[float]]) -> dict[str, Any]:
    """Mean, median and 95th percentile of each stage."""
    return {
        stage: {
            "mean": round(1e3 * float(np.mean(values)), 3),
            "median": round(1e3 * float(np.median(values)), 3),
            "p95": round(1e3 * float(np.percentile(values, 95)), 3),
        }
        for stage, values in times_s.items()
        if values
    }


def _print_timings(console: Console, times_s: dict[str, list[float]], frames: int) -> None:
    """Mean milliseconds a frame of each stage, and what one call of it took."""
    times_ms, totals_ms = _times_ms(times_s), total_ms(times_s)
    table = Table(title=f"milliseconds a frame on {device_name()}")
    table.add_column("stage")
    for heading in ("mean", "median", "95 %"):
        table.add_column(heading, justify="right")
    for stage in (*(stage for stage in STAGES if stage in times_ms), "perception"):
        numbers = (totals_ms[stage] / frames, times_ms[stage]["median"], times_ms[stage]["p95"])
        name = "perception, all of it" if stage == "perception" else stage.replace("_", " ")
        table.add_row(name, *(f"{number:.2f}" for number in numbers))
    whole = ("perception", "lifting", "merging", "relations")
    table.add_row("frame", f"{sum(totals_ms[stage] for stage in whole) / frames:.2f}", "", "")
    console.print(table)
