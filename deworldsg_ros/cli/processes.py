"""Processes of the demo: started apart, with a log each, and ended one by one in good order."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO

PR_SET_PDEATHSIG = 1
# How long a process may take to end after each signal.
GRACE_S = ((signal.SIGINT, 8.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))


def _end_with_parent() -> Callable[[], None] | None:
    """What a child does first on Linux: it asks for SIGINT should its parent be killed."""
    try:
        prctl = ctypes.CDLL(None, use_errno=True).prctl
    except (OSError, AttributeError):
        return None
    return lambda: prctl(PR_SET_PDEATHSIG, signal.SIGINT)


class LoggedProcess:
    """A process in a session of its own: Ctrl-C in the terminal is left to its parent.

    Args:
        name: what to call it.
        command: program and arguments.
        environment: the whole environment.
        log: file for its standard error, and for its standard output unless that is read.
        read_output: whether `output` is to be read.
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
                os.kill(self._process.pid, number)

    def wait(self, timeout_s: float) -> int | None:
        """Exit code; None where it runs on."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None


def end_all(processes: Sequence[LoggedProcess]) -> dict[str, int | None]:
    """End all: SIGINT, then SIGTERM, then SIGKILL; gives the exit codes by name."""
    for number, grace_s in GRACE_S:
        running = [process for process in processes if process.exit_code is None]
        for process in running:
            process.signal(number)
        for process in running:
            process.wait(grace_s)
    return {process.name: process.exit_code for process in processes}
