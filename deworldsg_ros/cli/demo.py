"""`deworldsg demo`: a recording through the four nodes, as separate processes, over DDS."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from deworldsg_ros import __version__
from deworldsg_ros.checkpoints.required import require_checkpoints
from deworldsg_ros.cli import outputs
from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.cli.demo_view import DemoView
from deworldsg_ros.cli.installation import dds_environment, find_shared, node_command
from deworldsg_ros.cli.observing import as_report, print_findings, sizes_of
from deworldsg_ros.cli.processes import LoggedProcess, ending, one_interrupt
from deworldsg_ros.cli.replay_progress import ReplayProgress
from deworldsg_ros.config import Config
from deworldsg_ros.doctor import Finding, find
from deworldsg_ros.recordings import events
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.messages import ODOMETRY, Role
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.ros.diagnosed import observations_of
from deworldsg_ros.ros.health import DROPPED, LEFT_OUT, counts_in
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.graph_file import GRAPH_FILE, read_graph
from deworldsg_ros.view.photos import Album
from deworldsg_ros.words import counted

NODES = ("segmentation_node", "lifting_node", "relation_node", "graph_node")
ODOMETRY_NODE = "odometry_node"
REPLAY = "replay_node"
SHIPPED = ("bags/demo_room.mcap", "bags/demo_room")
# Loading models and compiling kernels for the first time takes minutes on a small machine.
START_LIMIT_S = 900.0
# Reading them takes a few seconds, however long the recording is.
MOST_PHOTO_FRAMES = 600


@dataclass(frozen=True)
class DemoOptions:
    """A replay through the nodes.

    Attributes:
        rate: 1 = recorded speed, 0 = as fast as the nodes process frames.
        topics: topics of a bag that the user named.
        intrinsics: fx, fy, cx, cy in pixels, for a folder without intrinsics.
        odometry: whether odometry_node makes the poses, and none of the recording is published.
        view: whether viewer_node shows the graph.
    """

    rate: float = 1.0
    topics: TopicChoice = TopicChoice()
    intrinsics: tuple[float, float, float, float] | None = None
    odometry: bool = False
    view: bool = True


@dataclass(frozen=True)
class _Recording:
    """A recording that can be replayed; `pose_source` is the message of its poses."""

    path: Path
    name: str
    kind: str
    frames: int
    pose_source: str


def run_demo(
    path: Path | None,
    out: Path,
    config_path: Path | None,
    settings: list[str],
    options: DemoOptions,
    *,
    console: Console,
) -> None:
    """Start the nodes, replay, end the nodes, write and show the results.

    Args:
        path: recording; None = the recording that ships with the package.
        out: folder of the results, created if missing.
        config_path: ROS parameter file; None = the defaults.
        settings: ``section.field=value``, on top of the file.
        options: the replay.
        console: terminal.

    Raises:
        DeWorldSGError: for unusable input, or if a process ends early.
    """
    config = effective_config(config_path, settings)
    require_checkpoints(config.perception, config.relations)
    # Opened first, so that a problem of the recording is reported before any process starts.
    recording = _check_recording(path or _shipped(), config, options)
    with one_interrupt(), ending(console) as viewers:
        with outputs.writing(out, config) as staged:
            view = DemoView(viewers, staged / outputs.CONFIG_FILE, out / "logs", console)
            started_s = time.perf_counter()
            with ending(console) as processes:
                _start(processes, recording, staged, out / "logs", options)
                *nodes, replay = processes
                progress = ReplayProgress(replay, nodes, recording.frames, console)
                finished = progress.follow(view.start if options.view else None)
            wall_s = time.perf_counter() - started_s
            graph = read_graph(staged)
            poses = [np.array(values).reshape(4, 4) for values in finished.poses]
            frames = _frames(recording.path, config, options)
            outputs.show_graph(staged, graph, console, poses, config.inputs.world_up, frames)
            findings = _findings(graph, finished)
            _write_report(staged, recording, graph, finished, wall_s, findings)
        _print_summary(out, finished, console)
        print_findings(console, findings)
        view.stay_open()


def _frames(path: Path, config: Config, options: DemoOptions) -> list[RgbdFrame]:
    """Some frames of the recording, for photos; none if its poses were not used."""
    if options.odometry:
        return []
    dataset = DatasetOptions(intrinsics=options.intrinsics)
    source = open_source(path, topics=options.topics, inputs=config.inputs, options=dataset)
    album = Album()
    try:
        for frame in itertools.islice(Recording(source, config.inputs).frames(), MOST_PHOTO_FRAMES):
            album.add(frame)
    finally:
        source.close()
    return album.frames


def configuration_of(models: str, config_path: Path | None) -> Path | None:
    """The configuration file of ``--models``, unless a file is given; raises ConfigurationError."""
    if models not in ("embedded", "paper"):
        raise ConfigurationError(f"--models {models}: expected embedded or paper")
    if models == "embedded" or config_path is not None:
        return config_path
    found = find_shared("config/paper.yaml")
    if found is None:
        raise ConfigurationError("config/paper.yaml is missing: install the package again")
    return found


def _shipped() -> Path:
    for relative in SHIPPED:
        found = find_shared(relative)
        if found is not None:
            return found
    raise RecordingError(
        f"the recording that ships with the package ({SHIPPED[0]}) is not installed: "
        "give the path of a recording"
    )


def _check_recording(path: Path, config: Config, options: DemoOptions) -> _Recording:
    source = open_source(
        path,
        topics=options.topics,
        inputs=config.inputs,
        options=DatasetOptions(intrinsics=options.intrinsics),
        need_poses=not options.odometry,
    )
    try:
        # replay_node and odometry_node publish all other poses as PoseStamped.
        is_odometry = not options.odometry and source.topics[Role.POSE].msgtype == ODOMETRY
        return _Recording(
            path.absolute(),
            source.name,
            source.kind,
            source.frame_count,
            "odometry" if is_odometry else "pose",
        )
    finally:
        source.close()


def _start(
    processes: list[LoggedProcess],
    recording: _Recording,
    out: Path,
    logs: Path,
    options: DemoOptions,
) -> None:
    """Append the processes of the nodes, then that of replay_node."""
    logs.mkdir(exist_ok=True)
    environment = dds_environment()
    common = ["--ros-args", "--params-file", str((out / outputs.CONFIG_FILE).absolute())]
    save_path = str((out / GRAPH_FILE).absolute())
    for node in (*NODES, ODOMETRY_NODE) if options.odometry else NODES:
        values = {"inputs.pose_source": recording.pose_source, "save_path": _quoted(save_path)}
        command = [*node_command(node), *common, *_parameters(values)]
        processes.append(LoggedProcess(node, command, environment, logs / f"{node}.log"))
    command = [*node_command(REPLAY), *common, *_parameters(_replay_values(recording, options))]
    processes.append(
        LoggedProcess(REPLAY, command, environment, logs / f"{REPLAY}.log", read_output=True)
    )


def _replay_values(recording: _Recording, options: DemoOptions) -> dict[str, Any]:
    values: dict[str, Any] = {
        "recording": _quoted(str(recording.path)),
        "rate": float(options.rate),
        "wait_s": START_LIMIT_S,
        "odometry": str(options.odometry).lower(),
        "save": "true",
        "events": "true",
    }
    topics = [f"{role}={topic}" for role, topic in vars(options.topics).items() if topic]
    if topics:
        values["topics"] = _quoted(",".join(topics))
    if options.intrinsics:
        values["intrinsics"] = _quoted(",".join(map(str, options.intrinsics)))
    return values


def _parameters(values: dict[str, Any]) -> list[str]:
    return [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]


def _quoted(text: str) -> str:
    """A string in YAML: ROS reads 1,2 or a path like 7 as something else."""
    return "'" + text.replace("'", "''") + "'"


def _write_report(
    out: Path,
    recording: _Recording,
    graph: wire.SceneGraphMessage,
    finished: events.Finished,
    wall_s: float,
    findings: list[Finding],
) -> None:
    objects: Counter[str] = Counter()
    for values in finished.diagnostics.values():
        objects.update(counts_in(values, LEFT_OUT))
    report = {
        "program": f"deworldsg {__version__} demo",
        "recording": recording.name,
        "kind": recording.kind,
        "frames": {
            "images": recording.frames,
            "published": finished.published,
            "processed": finished.processed,
            "without_result": finished.without_result,
        },
        "drops": {**_drops(finished), "objects": dict(objects)},
        "losses": finished.losses,
        "findings": as_report(findings),
        "nodes": len(graph.nodes),
        "edges": len(graph.edges),
        "wall_s": round(wall_s, 3),
        "diagnostics": finished.diagnostics,
    }
    outputs.write_report(out, report)


def _findings(graph: wire.SceneGraphMessage, finished: events.Finished) -> list[Finding]:
    """What is off, from the diagnostics of the nodes and the graph."""
    seen = replace(
        observations_of(finished.diagnostics),
        images=finished.published,
        frames=finished.processed,
        nodes=len(graph.nodes),
        hidden=Counter(node.reason for node in graph.hidden or ()),
        sizes=sizes_of(graph),
        missing=(),  # after the last frame, every input is missing
    )
    return find(seen)


def _drops(finished: events.Finished) -> dict[str, dict[str, int]]:
    """Drops by reason: of the recording, and of each node."""
    nodes = sorted(finished.diagnostics.items())
    return {"recording": finished.drops} | {
        node: counts_in(values, DROPPED) for node, values in nodes
    }


def _print_summary(out: Path, finished: events.Finished, console: Console) -> None:
    outputs.print_drops(console, finished.losses, _drops(finished), {})
    if finished.without_result or not finished.drained:
        outputs.print_noted(
            console,
            "warning:",
            f"no result for {counted(finished.without_result, 'frame')}; see the logs of the "
            f"nodes in {out / 'logs'}",
        )
    console.print(
        f"{counted(finished.published, 'frame')} published, {finished.processed} merged into the "
        "graph",
        highlight=False,
    )
    outputs.print_files(console, out)
