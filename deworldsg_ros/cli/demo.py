"""`deworldsg demo`: a recording through the four nodes, as separate processes, over DDS."""

from __future__ import annotations

import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from deworldsg_ros import __version__
from deworldsg_ros.cli import outputs
from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.cli.installation import find_shared, node_command
from deworldsg_ros.cli.processes import LoggedProcess, end_all
from deworldsg_ros.cli.progress import frame_progress, working
from deworldsg_ros.recordings import events
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.errors import RecordingError
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.messages import ODOMETRY, Role
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.errors import DeWorldSGError

NODES = ("segmentation_node", "lifting_node", "relation_node", "graph_node")
ODOMETRY_NODE = "odometry_node"
REPLAY = "replay_node"
SHIPPED = ("bags/demo_room.mcap", "bags/demo_room")
# Loading models and compiling kernels for the first time takes minutes on a small machine.
READY_S = 900.0
# Before it has taken so long, nothing is said of it.
EXPLAIN_AFTER_S = 8.0
STALL_S = 30.0
POLL_S = 0.2
STARTING = "starting the nodes …"


class DemoFailed(DeWorldSGError):
    """The demo could not be brought to its end."""


def run_demo(
    path: Path | None,
    out: Path,
    config_path: Path | None,
    settings: list[str],
    *,
    rate: float,
    topics: TopicChoice,
    options: DatasetOptions,
    odometry: bool,
    console: Console,
) -> None:
    """Start the nodes, replay, write the results, end the nodes; raises DeWorldSGError."""
    path = path or _shipped()
    config = effective_config(config_path, settings)
    # Problems of the recording are told before anything is started.
    source = open_source(
        path, topics=topics, inputs=config.inputs, options=options, need_poses=not odometry
    )
    name, kind, frames = source.name, source.kind, source.frame_count
    # Poses out of TF or of odometry_node are messages of their own.
    is_odometry = not odometry and source.topics[Role.POSE].msgtype == ODOMETRY
    source.close()
    outputs.prepare_folder(out, config)
    (out / outputs.GRAPH_FILE).unlink(missing_ok=True)
    logs = out / "logs"
    logs.mkdir(exist_ok=True)

    started_s = time.perf_counter()
    with _one_interrupt(), _processes(console) as processes:
        parameters = ["--ros-args", "--params-file", str((out / outputs.CONFIG_FILE).absolute())]
        parameters += ["-p", f"inputs.pose_source:={'odometry' if is_odometry else 'pose'}"]
        environment = dds_environment()
        for node in (*NODES, ODOMETRY_NODE) if odometry else NODES:
            command = [*node_command(node), *parameters]
            if node == "graph_node":
                command += ["-p", f"save_path:={(out / outputs.GRAPH_FILE).absolute()}"]
            processes.append(LoggedProcess(node, command, environment, logs / f"{node}.log"))
        replay = LoggedProcess(
            REPLAY,
            [
                *node_command(REPLAY),
                "--ros-args",
                *_replay_parameters(path, out, rate, topics, odometry),
            ]
            + (["-p", f"intrinsics:='{_joined(options)}'"] if options.intrinsics else []),
            environment,
            logs / f"{REPLAY}.log",
            read_output=True,
        )
        processes.append(replay)
        finished = _follow(replay, processes, frames, console)
    wall_s = time.perf_counter() - started_s
    graph = outputs.read_graph(out)
    poses = [np.array(values).reshape(4, 4) for values in finished.poses]
    outputs.show_graph(out, graph, console, poses, config.inputs.world_up)
    _report(out, name, kind, frames, graph, finished, wall_s, console)


def dds_environment() -> dict[str, str]:
    """Environment of the nodes: this machine alone, a domain of its own, images that arrive."""
    environment = dict(os.environ)
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    # Domains above 101 collide with ephemeral ports on Linux.
    environment.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    # The wheels of ROS 2 do not set it, and rclpy looks for its type support there.
    environment.setdefault("AMENT_PREFIX_PATH", sys.prefix)
    profile = find_shared("config/fastdds.xml")
    if profile is not None:
        environment.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))
    environment["PYTHONUNBUFFERED"] = "1"
    return environment


def _shipped() -> Path:
    for relative in SHIPPED:
        found = find_shared(relative)
        if found is not None:
            return found
    raise RecordingError(
        f"the recording that ships with the package ({SHIPPED[0]}) is not installed: "
        "name a recording"
    )


def _joined(options: DatasetOptions) -> str:
    return ",".join(map(str, options.intrinsics or ()))


def _replay_parameters(
    path: Path, out: Path, rate: float, topics: TopicChoice, odometry: bool
) -> list[str]:
    values: dict[str, Any] = {
        "recording": f"'{path.absolute()}'",
        "rate": float(rate),
        "wait_s": READY_S,
        "required": "true",
        "stall_s": STALL_S,
        "odometry": str(odometry).lower(),
        "save": "true",
        "events": "true",
        "config": f"'{(out / outputs.CONFIG_FILE).absolute()}'",
    }
    for role in ("rgb", "depth", "camera_info", "pose"):
        if getattr(topics, role):
            values[f"{role}_topic"] = getattr(topics, role)
    return [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]


@contextmanager
def _processes(console: Console) -> Iterator[list[LoggedProcess]]:
    """Processes that are ended whatever happens inside."""
    processes: list[LoggedProcess] = []
    try:
        yield processes
    finally:
        with console.status("ending the nodes …"):
            # The replay first, so that nothing comes any more.
            codes = end_all(processes[-1:]) | end_all(processes[:-1])
        for name, code in codes.items():
            # A node that is still loading has no handler yet: SIGINT itself ends it.
            if code not in (0, -signal.SIGINT):
                console.print(f"[yellow]{name} ended with code {code}[/]", highlight=False)


@contextmanager
def _one_interrupt() -> Iterator[None]:
    """The first SIGINT or SIGTERM interrupts; more of them must not leave nodes behind."""
    numbers = (signal.SIGINT, signal.SIGTERM)

    def interrupt(*_: Any) -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    previous = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _follow(
    replay: LoggedProcess, processes: list[LoggedProcess], frames: int, console: Console
) -> events.Finished:
    """Show what the replay tells until it has finished; raises DemoFailed."""
    lines: queue.Queue[bytes | None] = queue.Queue()

    def read() -> None:
        for line in replay.output:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, name="replay events", daemon=True).start()
    status = working(console, STARTING)
    status.start()
    progress = frame_progress(console)
    task = progress.add_task("replaying", total=frames, start=False, note="")
    finished: events.Finished | None = None
    saved: events.Saved | None = None
    started_s = time.monotonic()
    try:
        while finished is None:
            _check(processes)
            try:
                line = lines.get(timeout=POLL_S)
            except queue.Empty:
                continue
            if line is None:
                _give_time_to_end(replay)
                _check(processes)
                raise DemoFailed(_died(replay))
            event = _event(line)
            if isinstance(event, events.Waiting):
                status.update(_waiting_text(event, time.monotonic() - started_s))
            elif isinstance(event, events.Started):
                status.stop()
                progress.start_task(task)
                progress.start()
            elif isinstance(event, events.Progress):
                note = f"{event.nodes} nodes" if event.published < frames else "finishing …"
                progress.update(task, completed=event.published, note=note)
            elif isinstance(event, events.Saved):
                saved = event
            elif isinstance(event, events.Finished):
                finished = event
                progress.update(task, completed=event.published, note="")
    finally:
        status.stop()
        progress.stop()
    if saved is None or not saved.success:
        raise DemoFailed(
            "graph_node did not save its graph: "
            + (saved.message if saved else "it was not asked to")
            + _hint(finished)
        )
    return finished


def _event(line: bytes) -> events.Event | None:
    try:
        return events.decode(line.decode())
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return None  # something else that was printed


def _waiting_text(event: events.Waiting, since_s: float) -> str:
    words = [words[0] for item in event.missing if (words := item.split())[0].endswith("_node")]
    names = ", ".join(dict.fromkeys(words)) or event.missing[0]
    text = f"{STARTING} waiting for {names}"
    if since_s > EXPLAIN_AFTER_S:
        text += "\n  (the first start compiles the kernels, which takes a minute or two)"
    return text


def _check(processes: list[LoggedProcess]) -> None:
    for process in processes:
        if process.exit_code not in (None, 0) or (
            process.exit_code == 0 and process.name != REPLAY
        ):
            raise DemoFailed(_died(process))


def _give_time_to_end(process: LoggedProcess) -> None:
    process.wait(2.0)


def _died(process: LoggedProcess) -> str:
    lines = process.last_lines()
    return (
        f"{process.name} ended early with code {process.exit_code}. The end of its log, "
        f"{process.log}:\n{lines or '(it is empty)'}"
    )


def _hint(finished: events.Finished) -> str:
    """What the nodes were waiting for, in their own words."""
    texts = [
        f"{name}: {text}"
        for name, values in finished.diagnostics.items()
        for key, text in values.items()
        if key.startswith(("waiting for", "dropped "))
    ]
    return f" ({'; '.join(texts)})" if texts else ""


def _report(
    out: Path,
    name: str,
    kind: str,
    frames: int,
    graph: wire.SceneGraphMessage,
    finished: events.Finished,
    wall_s: float,
    console: Console,
) -> None:
    drops = {"recording": finished.drops}
    objects: dict[str, int] = {}
    for node, values in sorted(finished.diagnostics.items()):
        drops[node] = _counts(values, "dropped ")
        for reason, count in _counts(values, "objects left out ").items():
            objects[reason] = objects.get(reason, 0) + count
    outputs.write_report(
        out,
        {
            "program": f"deworldsg {__version__} demo",
            "recording": name,
            "kind": kind,
            "frames": {
                "images": frames,
                "published": finished.published,
                "processed": finished.answered,
                "unanswered": finished.unanswered,
            },
            "drops": {**drops, "objects": objects},
            "losses": finished.losses,
            "nodes": len(graph.nodes),
            "edges": len(graph.edges),
            "wall_s": round(wall_s, 3),
            "diagnostics": finished.diagnostics,
        },
    )
    outputs.print_drops(console, finished.losses, drops, {})
    if finished.unanswered or not finished.drained:
        console.print(
            f"[yellow]warning:[/] {finished.unanswered} frames came back from no node in time; "
            f"the logs in {out / 'logs'} may say why",
            highlight=False,
            soft_wrap=True,
        )
    console.print(
        f"{finished.published} frames published, {finished.answered} became part of the graph",
        highlight=False,
    )
    outputs.print_files(console, out)


def _counts(values: dict[str, str], prefix: str) -> dict[str, int]:
    return {
        key[len(prefix) :]: int(value) for key, value in values.items() if key.startswith(prefix)
    }
