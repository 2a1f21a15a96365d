"""The progress of a replay on the terminal, read from the events that replay_node prints."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence

import msgspec
from rich.console import Console

from deworldsg_ros.cli.processes import LoggedProcess
from deworldsg_ros.cli.progress import frame_progress, working
from deworldsg_ros.kernels import COMPILING
from deworldsg_ros.recordings import events
from deworldsg_ros.ros.health import DROPPED
from deworldsg_ros.scene.errors import DeWorldSGError
from deworldsg_ros.words import counted

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
        self._saved: events.Saved | None = None
        self._finished: events.Finished | None = None

    def follow(self, on_started: Callable[[], None] | None = None) -> events.Finished:
        """Show events until the replay has finished.

        Args:
            on_started: called when the nodes are ready and the first frame is published.

        Raises:
            DemoFailed: if a process ends early, or graph_node does not save its graph.
        """
        threading.Thread(target=self._read, name="replay events", daemon=True).start()
        self._status.start()
        try:
            while self._finished is None:
                event = self._next()
                self._show(event)
                if on_started is not None and isinstance(event, events.Started):
                    on_started()
        finally:
            self._status.stop()
            self._progress.stop()
        if self._saved is None or not self._saved.success:
            problem = self._saved.message if self._saved else "replay_node did not request it"
            raise DemoFailed(f"graph_node saved no graph: {problem}{_hint(self._finished)}")
        return self._finished

    def _read(self) -> None:
        for line in self._replay.output:
            self._lines.put(line)
        self._lines.put(None)

    def _next(self) -> events.Event | None:
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
            return events.decode(line.decode())
        except (msgspec.MsgspecError, UnicodeDecodeError):
            return None  # other output, e.g. of a library

    def _show(self, event: events.Event | None) -> None:
        if isinstance(event, events.Waiting):
            compiling = any(COMPILING in node.last_lines() for node in self._nodes)
            self._status.update(_waiting_text(event, compiling))
        elif isinstance(event, events.Started):
            self._status.stop()
            self._progress.start_task(self._task)
            self._progress.start()
        elif isinstance(event, events.Progress):
            finishing = event.published >= self._frames
            note = "finishing …" if finishing else counted(event.nodes, "node")
            self._progress.update(self._task, completed=event.published, note=note)
        elif isinstance(event, events.Saved):
            self._saved = event
        elif isinstance(event, events.Finished):
            self._finished = event
            self._progress.update(self._task, completed=event.published, note="")

    def _check_running(self) -> None:
        """Raise DemoFailed if a node has ended, or replay_node has failed."""
        for process in self._nodes:
            if process.exit_code is not None:
                raise DemoFailed(_early_end(process))
        if self._replay.exit_code not in (None, 0):
            raise DemoFailed(_early_end(self._replay))


def _waiting_text(event: events.Waiting, compiling: bool) -> str:
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


def _hint(finished: events.Finished) -> str:
    """Missing inputs and drops of every node, from its diagnostics."""
    texts = [
        f"{name}: {text}" if key.startswith("waiting for") else f"{name}: {key} {text}"
        for name, values in finished.diagnostics.items()
        for key, text in values.items()
        if key.startswith(("waiting for", DROPPED))
    ]
    return f" ({'; '.join(texts)})" if texts else ""
