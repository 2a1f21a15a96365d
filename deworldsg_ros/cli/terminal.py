"""Progress on the terminal, and the files of the installation."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
)
from rich.status import Status
from rich.text import Text

import deworldsg_ros

# --- Find the files and executables of the package, in a checkout or an installation.

PACKAGE = "deworldsg_ros"


def checkout() -> Path | None:
    """Root of the source tree if the package runs from one; None for an installation."""
    root = Path(deworldsg_ros.__file__).resolve().parents[1]
    return root if (root / "package.xml").exists() else None


def prefixes() -> list[Path]:
    """Installation prefixes that may hold the package, best first."""
    found: list[Path] = []
    # ament_index_python raises if AMENT_PREFIX_PATH is not set or does not contain the package.
    with contextlib.suppress(Exception):
        from ament_index_python.packages import get_package_prefix

        found.append(Path(get_package_prefix(PACKAGE)))
    return [*found, Path(sys.prefix)]


def find_shared(relative: str) -> Path | None:
    """A file or folder of the share folder, e.g. ``config/paper.yaml``; None if it is missing."""
    source = checkout()
    folders = [source] if source else []
    folders += [prefix / "share" / PACKAGE for prefix in prefixes()]
    return next((folder / relative for folder in folders if (folder / relative).exists()), None)


def dds_environment() -> dict[str, str]:
    """Environment of the nodes: this machine, its own domain, shared memory for images."""
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


def node_command(name: str) -> list[str]:
    """Command that starts a node: its installed executable, or its module."""
    if checkout() is None:
        for prefix in prefixes():
            executable = prefix / "lib" / PACKAGE / name
            if os.access(executable, os.X_OK):
                return [str(executable)]
    return [sys.executable, "-m", f"{PACKAGE}.nodes.{name}"]


# --- Ctrl-C that keeps what there is.


@contextlib.contextmanager
def stopping_early(stop: Callable[[], None]) -> Iterator[None]:
    """The first Ctrl-C calls `stop`; the next one interrupts, as before.

    Only the main thread has signals: in another one, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.getsignal(signal.SIGINT)

    def interrupted(*_: Any) -> None:
        signal.signal(signal.SIGINT, former)
        stop()

    signal.signal(signal.SIGINT, interrupted)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)


# --- The progress bar and the spinner of all commands.


class _RateColumn(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:5.1f}/s" if speed else "     –", style="progress.data.speed")


def working(console: Console, text: str) -> Status:
    """A spinner with a text; without a terminal, the text alone."""
    if not console.is_terminal:
        console.print(text, highlight=False, soft_wrap=True)
    return console.status(text)


def say_instead(console: Console, status: Status, text: str) -> None:
    """Give a spinner another text; without a terminal, print it."""
    if console.is_terminal:
        status.update(text)
    else:
        console.print(text, highlight=False, soft_wrap=True)


def frame_progress(console: Console) -> Progress:
    """Progress over frames: bar, count, frames per second, time, and a field `note`."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}", markup=False),
        console=console,
    )
