"""`deworldsg demo`: a recording through the four nodes, as separate processes, over DDS."""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np
from rich.console import Console

from deworldsg_ros import __version__
from deworldsg_ros.base.kernels import COMPILING
from deworldsg_ros.base.words import counted
from deworldsg_ros.checkpoints.catalogue import require_checkpoints, unused_detector
from deworldsg_ros.cli import outputs
from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.cli.outputs import Album, as_report, print_findings, print_part, sizes_of
from deworldsg_ros.cli.terminal import (
    dds_environment,
    find_shared,
    frame_progress,
    node_command,
    stopping_early,
    working,
)
from deworldsg_ros.config import Config
from deworldsg_ros.doctor import Finding, find
from deworldsg_ros.graph.graph_files import GRAPH_FILE, graph_path, read_graph
from deworldsg_ros.graph.provenance import read_space
from deworldsg_ros.recordings import replaying
from deworldsg_ros.recordings.bags.topics import TopicChoice
from deworldsg_ros.recordings.folders.dataset import DatasetOptions
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.recordings.source import ODOMETRY, Role
from deworldsg_ros.ros.health import DROPPED, LEFT_OUT, counts_in, observations_of
from deworldsg_ros.scene.camera import RgbdFrame
from deworldsg_ros.scene.errors import ConfigurationError, DeWorldSGError, RecordingError
from deworldsg_ros.wire import messages as wire

# --- Processes of the demo: each in its own session with its own log, ended one after the other.

INTERRUPTS = (signal.SIGINT, signal.SIGTERM)
PR_SET_PDEATHSIG = 1  # of Linux's prctl
# Time to end after each signal. graph_node writes its map after SIGINT.
GRACE_S = ((signal.SIGINT, 8.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))


class LoggedProcess:
    """A process in its own session, which Ctrl-C in the terminal does not reach.

    Args:
        name: name in messages.
        command: program and arguments.
        environment: the complete environment.
        log: file of its standard error, and of its standard output unless `read_output`.
        read_output: whether the parent reads `output`.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        log: Path,
        *,
        read_output: bool = False,
    ) -> None:
        self.name = name
        self.log = log
        with log.open("wb") as file:
            self._process = subprocess.Popen(
                list(command),
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if read_output else file,
                stderr=file,
                start_new_session=True,
                preexec_fn=_end_with_parent(),
            )

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def output(self) -> IO[bytes]:
        """Standard output."""
        assert self._process.stdout is not None
        return self._process.stdout

    @property
    def exit_code(self) -> int | None:
        """Exit code; None while it runs."""
        return self._process.poll()

    def last_lines(self, count: int = 12) -> str:
        """End of its log."""
        lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(lines[-count:])

    def signal(self, number: signal.Signals) -> None:
        """Send a signal, if it still runs."""
        if self.exit_code is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def wait(self, timeout_s: float | None) -> int | None:
        """Exit code; None on timeout. A timeout of None waits without end."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None


def _end_with_parent() -> Callable[[], None] | None:
    """On Linux, the first call of a child: request SIGINT for the death of its parent."""
    try:
        prctl = ctypes.CDLL(None, use_errno=True).prctl
    except (OSError, AttributeError):
        return None
    return lambda: prctl(PR_SET_PDEATHSIG, signal.SIGINT)


def end_all(processes: Sequence[LoggedProcess]) -> dict[str, int | None]:
    """End all by SIGINT, then SIGTERM, then SIGKILL; return the exit codes by name."""
    for number, grace_s in GRACE_S:
        running = [process for process in processes if process.exit_code is None]
        for process in running:
            process.signal(number)
        for process in running:
            process.wait(grace_s)
    return {process.name: process.exit_code for process in processes}


@contextlib.contextmanager
def ending(console: Console) -> Iterator[list[LoggedProcess]]:
    """A list of processes, the source of messages last; all are ended on the way out."""
    processes: list[LoggedProcess] = []
    try:
        yield processes
    finally:
        with console.status("ending the nodes …"):
            # The last one first, so that no new message arrives.
            codes = end_all(processes[-1:]) | end_all(processes[:-1])
        for name, code in codes.items():
            # A node that is still loading has no handler: SIGINT itself ends it.
            if code not in (0, -signal.SIGINT):
                line = f"{name} ended with exit code {code}"
                console.print(line, style="yellow", highlight=False)


@contextlib.contextmanager
def _on_interrupt(handler: Callable[..., None]) -> Iterator[None]:
    """Another handler of SIGINT and SIGTERM."""
    previous = {number: signal.signal(number, handler) for number in INTERRUPTS}
    try:
        yield
    finally:
        for number, former in previous.items():
            signal.signal(number, former)


@contextlib.contextmanager
def one_interrupt() -> Iterator[None]:
    """Only the first SIGINT or SIGTERM interrupts: a second one must not stop the clean-up."""

    def interrupt(*_: Any) -> None:
        for number in INTERRUPTS:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    with _on_interrupt(interrupt):
        yield


def _start_process(processes: list[LoggedProcess], *arguments: Any, **options: Any) -> None:
    """Append a new process; an interrupt waits, so that no process starts without being listed."""
    held: list[int] = []
    with _on_interrupt(lambda number, _: held.append(number)):
        processes.append(LoggedProcess(*arguments, **options))
    for number in held[:1]:
        signal.raise_signal(number)


# --- The live view of the demo: viewer_node as one more process, and its address on the terminal.

VIEWER = "viewer_node"
# The line of viewer_node with its address.
ADDRESS = re.compile(r"^view: (http\S+)$", re.MULTILINE)
LOOK_PERIOD_S = 0.2
VIEW_START_LIMIT_S = 60.0


class DemoView:
    """The viewer of a demo. Without it the demo goes on, and says why.

    Args:
        processes: the process is put there, to be ended.
        config: ROS parameter file.
        logs: folder of its log.
        console: terminal.

    Attributes:
        url: of the page; None = not known yet.
    """

    def __init__(
        self,
        processes: list[LoggedProcess],
        config: Path,
        logs: Path,
        console: Console,
    ) -> None:
        self.url: str | None = None
        self._processes = processes
        self._config = config
        self._log = logs / f"{VIEWER}.log"
        self._console = console

    def start(self) -> None:
        """Start the process; its address is printed when the page is there.

        The demo calls it when the nodes are ready, so that they do not start later.
        """
        command = [*node_command(VIEWER), "--ros-args", "--params-file", str(self._config)]
        _start_process(self._processes, VIEWER, command, dds_environment(), self._log)
        viewer = self._processes[-1]
        threading.Thread(target=self._announce, args=[viewer], daemon=True).start()

    def stay_open(self) -> None:
        """Keep the page until Ctrl-C if someone is at the terminal."""
        if self.url is not None and self._console.is_terminal and sys.stdin.isatty():
            text = f"the view stays at {self.url}: press Ctrl-C to end"
            self._console.print(text, highlight=False, soft_wrap=True)
            with suppress(KeyboardInterrupt):
                self._processes[-1].wait(None)

    def _announce(self, process: LoggedProcess) -> None:
        end_s = time.monotonic() + VIEW_START_LIMIT_S
        while process.exit_code is None and time.monotonic() < end_s:
            found = ADDRESS.search(self._log.read_text(encoding="utf-8", errors="replace"))
            if found:
                self.url = found[1]
                self._console.print(f"live view: {self.url}", highlight=False, soft_wrap=True)
                return
            time.sleep(LOOK_PERIOD_S)
        if process.exit_code not in (None, 0):
            self._note(f"{VIEWER} ended with exit code {process.exit_code}; its log: {self._log}")

    def _note(self, reason: str) -> None:
        outputs.print_noted(self._console, "no live view:", reason)


# --- The progress of a replay on the terminal, read from the events that replay_node prints.

STARTING = "starting the nodes …"


class DemoFailed(DeWorldSGError):
    """A process of the demo ended early, or there is no graph."""


class ReplayProgress:
    """Shows the start of the nodes, then a bar over the frames.

    Args:
        replay: the process of replay_node, which prints events.
        nodes: the other processes.
        frames: number of RGB images in the recording.
        console: terminal.

    Attributes:
        stopped: whether Ctrl-C ended the replay before the last frame.
    """

    def __init__(
        self, replay: LoggedProcess, nodes: Sequence[LoggedProcess], frames: int, console: Console
    ) -> None:
        self._replay = replay
        self._nodes = nodes
        self._frames = frames
        self._lines: queue.Queue[bytes | None] = queue.Queue()
        self._status = working(console, STARTING)
        self._progress = frame_progress(console)
        self._task = self._progress.add_task("replaying", total=frames, start=False, note="")
        self._saved: replaying.Saved | None = None
        self._finished: replaying.Finished | None = None
        self.stopped = False

    def follow(self, on_started: Callable[[], None] | None = None) -> replaying.Finished:
        """Show events until the replay has finished.

        After the first frame, the first Ctrl-C ends the replay early, and the graph is saved.

        Args:
            on_started: called when the nodes are ready and the first frame is published.

        Raises:
            DemoFailed: if a process ends early, or graph_node does not save its graph.
        """
        threading.Thread(target=self._read, name="replay events", daemon=True).start()
        self._status.start()
        stack = contextlib.ExitStack()
        try:
            while self._finished is None:
                event = self._next()
                self._show(event)
                if isinstance(event, replaying.Started):
                    stack.enter_context(stopping_early(self._stop))
                    if on_started is not None:
                        on_started()
        finally:
            stack.close()
            self._status.stop()
            self._progress.stop()
        if self._saved is None or not self._saved.success:
            problem = self._saved.message if self._saved else "replay_node did not request it"
            raise DemoFailed(f"graph_node saved no graph: {problem}{_hint(self._finished)}")
        return self._finished

    def _stop(self) -> None:
        self.stopped = True
        self._replay.signal(replaying.STOP_EARLY)

    def _read(self) -> None:
        for line in self._replay.output:
            self._lines.put(line)
        self._lines.put(None)

    def _next(self) -> replaying.Event | None:
        """The next event; None if there is none yet."""
        self._check_running()
        try:
            line = self._lines.get(timeout=0.2)
        except queue.Empty:
            return None
        if line is None:
            self._replay.wait(2.0)  # its output ends before its process
            self._check_running()
            raise DemoFailed(_early_end(self._replay))
        try:
            return replaying.decode(line.decode())
        except (msgspec.MsgspecError, UnicodeDecodeError):
            return None  # other output, e.g. of a library

    def _show(self, event: replaying.Event | None) -> None:
        if isinstance(event, replaying.Waiting):
            compiling = any(COMPILING in node.last_lines() for node in self._nodes)
            self._status.update(_waiting_text(event, compiling))
        elif isinstance(event, replaying.Started):
            self._status.stop()
            self._progress.start_task(self._task)
            self._progress.start()
        elif isinstance(event, replaying.Progress):
            finishing = self.stopped or event.published >= self._frames
            note = "finishing …" if finishing else counted(event.nodes, "node")
            self._progress.update(self._task, completed=event.published, note=note)
        elif isinstance(event, replaying.Saved):
            self._saved = event
        elif isinstance(event, replaying.Finished):
            self._finished = event
            self._progress.update(self._task, completed=event.published, note="")

    def _check_running(self) -> None:
        """Raise DemoFailed if a node has ended, or replay_node has failed."""
        for process in self._nodes:
            if process.exit_code is not None:
                raise DemoFailed(_early_end(process))
        if self._replay.exit_code not in (None, 0):
            raise DemoFailed(_early_end(self._replay))


def _waiting_text(event: replaying.Waiting, compiling: bool) -> str:
    words = [words[0] for item in event.missing if (words := item.split())[0].endswith("_node")]
    names = ", ".join(dict.fromkeys(words)) or event.missing[0]
    text = f"{STARTING} waiting for {names}"
    if compiling:
        text += f"\n  {COMPILING}"
    return text


def _early_end(process: LoggedProcess) -> str:
    lines = process.last_lines()
    return (
        f"{process.name} ended early with exit code {process.exit_code}. The end of its log, "
        f"{process.log}:\n{lines or '(it is empty)'}"
    )


def _hint(finished: replaying.Finished) -> str:
    """Missing inputs and drops of every node, from its diagnostics."""
    texts = [
        f"{name}: {text}" if key.startswith("waiting for") else f"{name}: {key} {text}"
        for name, values in finished.diagnostics.items()
        for key, text in values.items()
        if key.startswith(("waiting for", DROPPED))
    ]
    return f" ({'; '.join(texts)})" if texts else ""


# --- `deworldsg demo`: a recording through the four nodes, as separate processes, over DDS.

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
        KeyboardInterrupt: after Ctrl-C. If it came during the replay, the results are those of the
            frames so far; a second one leaves none.
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
            space = read_space(graph_path(staged))
            outputs.show_graph(staged, graph, console, poses, config.inputs.world_up, frames, space)
            findings = _findings(graph, finished, config)
            _write_report(staged, recording, graph, finished, wall_s, findings)
        if progress.stopped:
            print_part(console, finished.published, recording.frames)
        _print_summary(out, finished, console)
        print_findings(console, findings)
        if progress.stopped:
            raise KeyboardInterrupt
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
        _start_process(processes, node, command, environment, logs / f"{node}.log")
    command = [*node_command(REPLAY), *common, *_parameters(_replay_values(recording, options))]
    log = logs / f"{REPLAY}.log"
    _start_process(processes, REPLAY, command, environment, log, read_output=True)


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
    finished: replaying.Finished,
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


def _findings(
    graph: wire.SceneGraphMessage, finished: replaying.Finished, config: Config
) -> list[Finding]:
    """Findings, from the diagnostics of the nodes, the graph and the configuration."""
    unused, settings = unused_detector(config.perception)
    seen = replace(
        observations_of(finished.diagnostics),
        images=finished.published,
        frames=finished.processed,
        nodes=len(graph.nodes),
        hidden=Counter(node.reason for node in graph.hidden or ()),
        sizes=sizes_of(graph),
        missing=(),  # after the last frame, every input is missing
        unused_detector=unused,
        its_settings=settings,
    )
    return find(seen)


def _drops(finished: replaying.Finished) -> dict[str, dict[str, int]]:
    """Drops by reason: of the recording, and of each node."""
    nodes = sorted(finished.diagnostics.items())
    return {"recording": finished.drops} | {
        node: counts_in(values, DROPPED) for node, values in nodes
    }


def _print_summary(out: Path, finished: replaying.Finished, console: Console) -> None:
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
