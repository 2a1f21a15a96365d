"""`deworldsg run`, `doctor`, `convert`, `info` and `compile`: commands on a recording."""

from __future__ import annotations

import gc
import itertools
import multiprocessing
import os
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack, closing, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich import box
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table
from rich.text import Text

from deworldsg_ros import __version__
from deworldsg_ros.base.kernels import COMPILING, on_compilation
from deworldsg_ros.base.timing import STAGES, Times, device_name, total_ms
from deworldsg_ros.base.words import counted, visible
from deworldsg_ros.cli import outputs
from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.cli.outputs import (
    Album,
    RunObserver,
    as_report,
    print_drops,
    print_findings,
    print_noted,
    print_part,
)
from deworldsg_ros.cli.terminal import frame_progress, say_instead, stopping_early, working
from deworldsg_ros.client import SceneGraph
from deworldsg_ros.config import Config
from deworldsg_ros.doctor import Finding, find
from deworldsg_ros.evaluation.temporal import UpdateLog
from deworldsg_ros.graph.embeddings import write_embeddings
from deworldsg_ros.graph.graph_files import write_graph
from deworldsg_ros.graph.provenance import write_seen, write_space
from deworldsg_ros.graph_builder import warm_up
from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.map_file import apart_of, check_paths, claim_map, continue_map, write_map
from deworldsg_ros.perception.registry import build_perception
from deworldsg_ros.pipeline import FrameResult, Pipeline
from deworldsg_ros.poses.loops import closings_in_words
from deworldsg_ros.poses.trajectory import write_tum
from deworldsg_ros.recordings.bags.storage import RawBag
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.posing import (
    PoseChoice,
    PosedSource,
    UnposedSource,
    choose_poses,
    posed_frames,
)
from deworldsg_ros.recordings.recording import Recording, detect_kind, open_source
from deworldsg_ros.recordings.replaying import check_output, write_mcap
from deworldsg_ros.recordings.source import RawRoleMessage, Role, Source
from deworldsg_ros.relocalisation import Returning
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import Trajectory
from deworldsg_ros.scene.errors import (
    ConfigurationError,
    DeWorldSGError,
    RecordingError,
    RefusedInput,
)
from deworldsg_ros.wire import messages as wire

# --- `deworldsg run`: build the scene graph of a recording in one process, without ROS.

# Clips that the world model lost.
FAILURES = ("world_model_error", "nan_features")
LOADING = "loading the models …"
# Files of bags and data sets by their ends; results, too, may be in the folder of a recording.
INPUTS = (
    *(".mcap", ".db3", "metadata.yaml", ".pose.txt"),
    *("rgb.txt", "depth.txt", "groundtruth.txt", "associations.txt"),
)


@dataclass(frozen=True)
class RunOptions:
    """Options of `deworldsg run`.

    Attributes:
        recording: bag or data set folder.
        out: folder for the results.
        config_path: ROS parameter file; None = the defaults.
        settings: ``section.field=value`` each, applied on top of the file.
        max_frames: process at most this many frames; 0 = all.
        topics: topics of a bag that the user named.
        dataset: options of a data set folder.
        poses: source of the camera poses.
        trajectory_out: TUM file for the poses of the processed frames; None = none.
        map_path: map file to load if it exists and to save at the end; None = none.
        relocalise: find the recording in the map, wherever its poses begin.
        temporal: whether the report contains the temporal stability of the graph.
        timings: whether the times of the stages are printed.
    """

    recording: Path
    out: Path = Path()
    config_path: Path | None = None
    settings: tuple[str, ...] = ()
    max_frames: int = 0
    topics: TopicChoice = TopicChoice()
    dataset: DatasetOptions = DatasetOptions()
    poses: PoseChoice = PoseChoice()
    trajectory_out: Path | None = None
    map_path: Path | None = None
    relocalise: bool = False
    temporal: bool = False
    timings: bool = False


@dataclass(frozen=True)
class _Processed:
    """Result of a run over all frames.

    Attributes:
        poses: T_world_camera (4, 4) of each processed frame by its stamp in nanoseconds.
        closings: of loops of odometry, in words.
        refused: frames that the pipeline or the odometry refused, by reason.
        updates: log of the graph's updates; None without `RunOptions.temporal`.
        album: some of the frames.
        observer: what the doctor has to know.
        wall_s: seconds for all frames.
        stopped: whether Ctrl-C ended it before the last frame.
    """

    poses: dict[int, Float64]
    closings: str
    refused: Counter[str]
    updates: UpdateLog | None
    album: Album
    observer: RunObserver
    wall_s: float
    stopped: bool

    @property
    def frames_per_s(self) -> float:
        """Processed frames per second."""
        return len(self.poses) / self.wall_s


@dataclass(frozen=True)
class _Ran:
    """A recording that was processed; `drops` are counts by owner and reason."""

    recording: Recording
    pipeline: Pipeline
    processed: _Processed
    drops: dict[str, dict[str, int]]
    findings: list[Finding]


def run_recording(options: RunOptions, console: Console) -> None:
    """Run, write the results and print a summary.

    After Ctrl-C, the results are those of the frames so far.

    Raises:
        DeWorldSGError: for unusable input.
        KeyboardInterrupt: after Ctrl-C; a second one, before the results are written.
    """
    _check_paths(options)
    # The map is ours from reading to writing: what another process adds to it would be lost.
    with claim_map(options.map_path) if options.map_path else nullcontext():
        ran = _run(options, console, lambda: outputs.check_folder(options.out))
        _write_results(options, ran, console)
    outputs.print_drops(console, ran.recording.losses, ran.drops, ran.recording.reasons)
    _print_summary(options, ran.recording.frame_count, ran.pipeline, ran.processed, console)
    print_findings(console, ran.findings)
    if ran.processed.stopped:
        raise KeyboardInterrupt


def _check_paths(options: RunOptions) -> None:
    if options.relocalise and (options.map_path is None or options.temporal):
        raise ConfigurationError(
            "--relocalise: expected --map FILE, and no --temporal, which follows one graph"
        )
    files = [(f"the result {name}", options.out / name) for name in outputs.RESULTS]
    if options.trajectory_out is not None:
        files.append(("the trajectory", options.trajectory_out))
    check_paths(options.map_path, files)
    source = options.recording.resolve()
    if options.map_path is not None:
        files.append(("the map", options.map_path))
    for what, path in files:
        found = path.resolve()
        is_input = source in found.parents and path.name.endswith(INPUTS)
        if path.exists() and (found == source or is_input):
            raise ConfigurationError(f"{what} would replace {path}, which is of the recording")


def examine(options: RunOptions, console: Console) -> list[Finding]:
    """Run without results; what is off. Raises DeWorldSGError."""
    return _run(options, console).findings


def _run(options: RunOptions, console: Console, prepare: Callable[[], None] = lambda: None) -> _Ran:
    """Process a recording.

    Args:
        options: of the command.
        console: terminal.
        prepare: called when the recording is found to be usable, before the work.

    Raises:
        RecordingError: if no frame can be used.
    """
    config = effective_config(options.config_path, options.settings)
    source = open_source(
        options.recording,
        topics=options.topics,
        inputs=config.inputs,
        options=options.dataset,
        need_poses=options.poses.need_poses,
    )
    try:
        recording = Recording(
            choose_poses(source, options.poses, config),
            config.inputs,
            with_detections=config.perception.detector == "topic",
        )
        prepare()
        pipeline = build_pipeline(config, options.map_path, console, options.relocalise)
        processed = _process(recording, pipeline, options, console)
    finally:
        source.close()
    drops = {"recording": dict(recording.drops), "pipeline": dict(processed.refused)}
    if not processed.poses and processed.stopped:
        raise KeyboardInterrupt
    if not processed.poses:
        outputs.print_drops(console, recording.losses, drops, recording.reasons)
        print_findings(console, processed.observer.findings(recording, pipeline, drops))
        raise RecordingError(
            f"recording {options.recording}: not one frame could be used; see the reasons above"
        )
    dropped = pipeline.relations.counters().dropped
    failed = {reason: dropped[reason] for reason in FAILURES if reason in dropped}
    if failed:
        drops["world model"] = failed
    findings = processed.observer.findings(recording, pipeline, drops)
    return _Ran(recording, pipeline, processed, drops, findings)


def build_pipeline(
    config: Config, map_path: Path | None, console: Console, relocalise: bool = False
) -> Pipeline:
    """A pipeline with its models loaded, and with the map's graph if the map file exists."""
    with working(console, LOADING) as status:
        on_compilation(lambda: say_instead(console, status, COMPILING))
        # OpenCV's own threads would compete with those of the stages.
        cv2.setNumThreads(1)
        pipeline = Pipeline(config, overlapped=True)
        pipeline.lifting.warm_up()
        warm_up(config)
    if map_path is not None:
        continued = continue_map(config, map_path)
        if relocalise:
            pipeline.returning = Returning(config, continued.builder if continued else None)
        elif continued is not None:
            pipeline.go_on_with(continued.builder)
        if continued is not None:
            if continued.newest:
                console.print(continued.message, highlight=False, soft_wrap=True)
            else:
                outputs.print_noted(console, "warning:", continued.message)
    return pipeline


def _process(
    recording: Recording, pipeline: Pipeline, options: RunOptions, console: Console
) -> _Processed:
    """Process the frames of a recording, with a progress bar."""
    started_s = time.perf_counter()
    poses: dict[int, Float64] = {}
    closings_m: list[float] = []
    album = Album()
    refused: Counter[str] = Counter()
    observer = RunObserver()
    updates = UpdateLog(pipeline.config.output.rate_hz) if options.temporal else None

    stop = threading.Event()
    lock = threading.Lock()

    def refuse(refusal: RefusedInput) -> None:
        with lock:  # odometry and the jump gate run in the thread that reads the frames
            refused[refusal.reason] += 1
            recording.reasons.setdefault(refusal.reason, str(refusal))

    total = min(recording.frame_count, options.max_frames or recording.frame_count)
    with frame_progress(console) as progress, stopping_early(stop.set), ExitStack() as stack:
        task = progress.add_task("building the graph", total=total, note="")
        frames = posed_frames(recording, options.poses, refuse)
        chosen = itertools.islice(frames, options.max_frames or None)
        for frame, result in stack.enter_context(closing(pipeline.process_all(chosen))):
            if frame.trajectory is not None:
                closings_m.append(frame.trajectory.moved_m)
                _correct(poses, frame.trajectory)
            if isinstance(result, RefusedInput):
                refuse(result)
            else:
                poses[frame.stamp_ns] = frame.T_world_camera
                album.add(frame)
                observer.note(frame, result)
                _note_update(updates, recording, pipeline, result)
            progress.advance(task)
            # Counting the nodes takes time: not in every frame.
            if len(poses) % 5 == 0:
                progress.update(task, note=_node_count(pipeline))
            if stop.is_set():
                break
        progress.update(task, note=_node_count(pipeline), total=len(poses) + refused.total())
    wall_s = time.perf_counter() - started_s
    closings = closings_in_words(len(closings_m), sum(closings_m[-1:]))
    return _Processed(poses, closings, refused, updates, album, observer, wall_s, stop.is_set())


def _correct(poses: dict[int, Float64], trajectory: Trajectory) -> None:
    """Move the poses of frames as a closed loop did."""
    if poses:
        T_new_old = trajectory.at(np.array(list(poses), np.int64))
        poses.update(zip(poses, T_new_old @ np.array(list(poses.values()))))


def _note_update(
    updates: UpdateLog | None, recording: Recording, pipeline: Pipeline, result: FrameResult
) -> None:
    """Add the graph after a frame to the log, if there is one."""
    if updates is not None and pipeline.builder is not None:
        source = recording.source
        original = source.original if isinstance(source, PosedSource) else source
        updates.note(pipeline.builder, original, result)


def _node_count(pipeline: Pipeline) -> str:
    return "" if pipeline.builder is None else counted(pipeline.builder.confirmed, "node")


def _write_results(options: RunOptions, ran: _Ran, console: Console) -> None:
    """Write the graph, its views, the report, the trajectory and the map; print the tables."""
    pipeline, processed = ran.pipeline, ran.processed
    if pipeline.builder is not None:
        pipeline.builder.find_rooms_and_things()
    graph, T_graph_world = pipeline.graph(), np.eye(4)
    if pipeline.returning is not None and pipeline.returning.found is not None:
        T_graph_world = pipeline.returning.found.T_map_world
    T_world_cameras = [T_graph_world @ pose for pose in processed.poses.values()]
    with outputs.writing(options.out, pipeline.config) as staged:
        path = write_graph(staged, graph)
        if pipeline.builder is not None:
            seen = pipeline.builder.frames.all(pipeline.builder.graph)
            write_seen(path, wire.ns_from_stamp(graph.stamp), seen)
            write_space(path, pipeline.builder.space)
            embeddings = pipeline.builder.graph.embeddings
            write_embeddings(path, wire.ns_from_stamp(graph.stamp), embeddings)
        world_up = pipeline.config.inputs.world_up
        frames = [
            replace(frame, T_world_camera=T_graph_world @ processed.poses[frame.stamp_ns])
            for frame in processed.album.frames
        ]
        space = None if pipeline.builder is None else pipeline.builder.space
        outputs.show_graph(staged, graph, console, T_world_cameras, world_up, frames, space)
        outputs.write_report(staged, _report(ran, graph))
        # Last: each of these two is in place at once, and must not be if the results failed.
        if options.trajectory_out is not None:
            write_tum(options.trajectory_out, list(processed.poses), T_world_cameras)
        if options.map_path is not None and pipeline.builder is not None:
            waits = pipeline.returning is not None and pipeline.returning.waits
            write_map(pipeline.builder, apart_of(options.map_path) if waits else options.map_path)


def _report(ran: _Ran, graph: wire.SceneGraphMessage) -> dict[str, Any]:
    """Content of run.json."""
    recording, pipeline, processed = ran.recording, ran.pipeline, ran.processed
    report = {
        "program": f"deworldsg {__version__} run",
        "recording": recording.name,
        "kind": recording.source.kind,
        "poses": recording.source.topics[Role.POSE].name,
        "frames": {"images": recording.frame_count, "processed": len(processed.poses)},
        "stopped": processed.stopped,
        "drops": {**ran.drops, "objects": dict(pipeline.drops)},
        "losses": recording.losses,
        "findings": as_report(ran.findings),
        "nodes": len(graph.nodes),
        "hidden_nodes": {} if pipeline.builder is None else pipeline.builder.hidden,
        "edges": len(graph.edges),
        "wall_s": round(processed.wall_s, 3),
        "frames_per_s": round(processed.frames_per_s, 2),
        "times_ms": _times_ms(pipeline.times_s),
        "device": device_name(),
    }
    if isinstance(recording.source, UnposedSource):
        report["loops"] = processed.closings
    if pipeline.relations.source != "none":
        report["clips"] = asdict(pipeline.relations.counters())
    if processed.updates is not None:
        report["temporal"] = processed.updates.quality().numbers()
    return report


def _print_summary(
    options: RunOptions, images: int, pipeline: Pipeline, processed: _Processed, console: Console
) -> None:
    frames = len(processed.poses)
    if processed.stopped:
        print_part(console, frames, images)
    console.print(
        f"{counted(frames, 'frame')} in {processed.wall_s:.1f} s "
        f"({processed.frames_per_s:.1f} per second)",
        highlight=False,
    )
    if pipeline.builder is not None and (hidden := pipeline.builder.hidden):
        reasons = ", ".join(f"{count} {reason}" for reason, count in hidden.items())
        console.print(f"hidden nodes (output.min_existence): {reasons}", highlight=False)
    if options.timings:
        _print_timings(console, pipeline.times_s, frames, processed.wall_s)
    if options.poses.odometry:
        console.print(processed.closings, highlight=False)
    outputs.print_files(console, options.out)
    if options.map_path is not None:
        path, what = options.map_path, "the map"
        if pipeline.returning is not None and pipeline.returning.waits:
            path, what = apart_of(path), f"the graph; {path} is unchanged"
        line = Text.assemble(f"  {path}  ", (what, "dim"))
        console.print(line, highlight=False, soft_wrap=True)
    if pipeline.returning is not None:
        _print_return(pipeline.returning, pipeline.graph(), console)


def _print_return(returning: Returning, graph: wire.SceneGraphMessage, console: Console) -> None:
    """Print where the recording was found in the map, and what has changed since."""
    console.print(f"found in the map: {returning.status}", highlight=False, soft_wrap=True)
    if not returning.waits:
        for line in returning.changes(SceneGraph(graph)).dated_lines:
            console.print(f"  {line}", highlight=False, soft_wrap=True)


def _times_ms(times_s: dict[str, Times]) -> dict[str, Any]:
    """Mean, median and 95th percentile of each stage, milliseconds per call."""
    return {
        stage: {
            "mean": round(1e3 * item.total_s / item.count, 3),
            "median": round(1e3 * float(np.median(item.newest_s)), 3),
            "p95": round(1e3 * float(np.percentile(item.newest_s, 95)), 3),
        }
        for stage, item in times_s.items()
        if item.count
    }


def _print_timings(console: Console, times_s: dict[str, Times], frames: int, wall_s: float) -> None:
    """Print a table: mean milliseconds per frame, median and 95th percentile per call."""
    times_ms, totals_ms = _times_ms(times_s), total_ms(times_s)
    table = Table(title=f"milliseconds per frame on {device_name()}")
    table.add_column("stage")
    for heading in ("mean", "median", "95 %"):
        table.add_column(heading, justify="right")
    for stage in (*(stage for stage in STAGES if stage in times_ms), "perception"):
        numbers = (totals_ms[stage] / frames, times_ms[stage]["median"], times_ms[stage]["p95"])
        name = "perception, in total" if stage == "perception" else stage.replace("_", " ")
        table.add_row(name, *(f"{number:.2f}" for number in numbers))
    stages = ("reading", "perception", "lifting", "merging", "relations")
    in_turn_ms = sum(totals_ms[stage] for stage in stages) / frames
    table.add_row("sum of the stages", f"{in_turn_ms:.2f}", "", "")
    table.add_row("frame (stages overlap)", f"{1e3 * wall_s / frames:.2f}", "", "")
    console.print(table)


# --- `deworldsg doctor`: say what is off with a recording, or with the nodes that run now.

NOTHING = "nothing is off"


def examine_recording(options: RunOptions, console: Console) -> bool:
    """Run a recording without results and print the findings; whether all is well."""
    return _told(examine(options, console), console)


def examine_nodes(seconds: float, console: Console) -> bool:
    """Listen to running nodes and print the findings; whether all is well."""
    from deworldsg_ros.ros.observing import observe_nodes

    with console.status(f"listening for {seconds:g} s …"):
        seen = observe_nodes(seconds)
    return _told(find(seen), console)


def _told(findings: Sequence[Finding], console: Console) -> bool:
    print_findings(console, findings)
    is_well = all(finding.harmless for finding in findings)
    if is_well:
        console.print(NOTHING, highlight=False)
    return is_well


# --- `deworldsg convert`: convert a folder or bag to one MCAP file.


def convert_recording(
    kind: str,
    path: Path,
    output: Path,
    *,
    topics: TopicChoice,
    options: DatasetOptions,
    console: Console,
) -> None:
    """Write a recording as an MCAP file; raises RecordingError."""
    check_output(output)
    source = open_source(path, kind=kind, topics=topics, options=options)
    try:
        with frame_progress(console) as progress:
            task = progress.add_task("converting", total=source.frame_count, note="")
            count = write_mcap(_counted(source, progress, task), output)
            progress.update(task, total=progress.tasks[0].completed)
    finally:
        source.close()
    print_drops(console, source.losses, {"recording": source.drops}, {})
    size_mb = output.stat().st_size / 1e6
    console.print(
        f"{output}: {counted(count, 'message')}, {size_mb:.1f} MB", highlight=False, soft_wrap=True
    )


def _counted(source: Source, progress: Progress, task: TaskID) -> Iterator[RawRoleMessage]:
    for message in source.raw_messages():
        yield message
        if message.role is Role.RGB:
            progress.advance(task)


# --- `deworldsg info`: show the topics of a recording.


def show_recording(
    path: Path, topics: TopicChoice, options: DatasetOptions, console: Console
) -> None:
    """Print the kind, the topics and their use, and the lost data; raises RecordingError.

    Args:
        path: of the recording.
        topics: topics of a bag that the user named.
        options: intrinsics that the user gave.
        console: terminal.
    """
    kind = detect_kind(path)
    used: dict[str, str] = {}
    problem = None
    losses: list[str] = []
    frames = 0
    try:
        source = open_source(path, kind=kind, topics=topics, options=options, need_poses=False)
    except RecordingError as error:
        if kind != "rosbag2":
            raise
        problem = str(error)
    else:
        used = {topic.name: role.value for role, topic in source.topics.items()}
        rows = [(topic.name, topic.msgtype, topic.count) for topic in source.topics.values()]
        frames, losses = source.frame_count, source.losses
        source.close()
    if kind == "rosbag2":
        bag = RawBag(path)
        rows = [(topic.name, topic.msgtype, topic.count) for topic in bag.topics]
        losses = bag.losses
        bag.close()
    console.print(
        f"{path}: {kind}, {counted(frames, 'RGB image')}", highlight=False, soft_wrap=True
    )
    table = Table(box=box.SIMPLE)
    table.add_column("topic" if kind == "rosbag2" else "files", overflow="fold")
    table.add_column("type", overflow="fold")
    table.add_column("messages", justify="right")
    table.add_column("used as")
    for name, msgtype, count in rows:
        kind_of = Text(visible(msgtype.split("/")[-1]))
        table.add_row(Text(visible(name)), kind_of, str(count), used.get(name, ""))
    console.print(table)
    if used and Role.POSE.value not in used.values():
        print_noted(
            console, "no poses:", "use run or demo with --odometry, or run with --poses FILE"
        )
    for loss in losses:
        print_noted(console, "lost:", loss)
    if problem:
        raise RecordingError(problem)


# --- `deworldsg compile`: compile the kernels ahead, so that no first frame waits for the
# compiler.

# The longest first, so that all processes end at about the same time.
PARTS: dict[str, Callable[[Config], object]] = {
    "merging": lambda config: warm_up(config, "merging"),
    "pairs": lambda config: warm_up(config, "pairs"),
    "perception": lambda config: build_perception(config.perception),
    "lifting": lambda config: Lifting(config.lifting).warm_up(),
    "drift": lambda config: warm_up(config, "drift"),
}


class CompilationFailed(DeWorldSGError):
    """A part could not be compiled."""


def compile_kernels(console: Console) -> None:
    """Compile the kernels of the default configuration into the cache, in a process for each core.

    Numba compiles one kernel at a time in a process. A process that compiles several parts
    compiles numba's own functions, which most kernels use, only once. Kernels that are in the cache
    are only loaded.

    Raises:
        CompilationFailed: with the error of the process.
    """
    start = time.perf_counter()
    # A forked process would have the threads' locks of this one, but not its threads.
    context = multiprocessing.get_context("spawn")
    processes = min(len(PARTS), len(os.sched_getaffinity(0)))
    with (
        working(console, "compiling the kernels …"),
        ProcessPoolExecutor(processes, mp_context=context) as pool,
    ):
        try:
            parts = {pool.submit(_compile, part): part for part in PARTS}
            for number, done in enumerate(as_completed(parts), 1):
                done.result()
                console.print(f"{number} of {len(PARTS)}: {parts[done]}", highlight=False)
        except Exception as error:  # numba can fail in more ways than can be listed
            text = "".join(traceback.format_exception(error))
            raise CompilationFailed(f"the kernels could not be compiled:\n{text}") from error
    console.print(f"the kernels are ready ({time.perf_counter() - start:.1f} s)", highlight=False)


def _compile(part: str) -> None:
    # The compiler's objects live to its end. To look at them again and again takes 8 % of the time,
    # to free them after each part 6 % (and saves 0.1 of 0.7 GB).
    gc.disable()
    PARTS[part](Config())
