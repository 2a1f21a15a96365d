"""Processes of the demo: each in its own session with its own log, ended one after the other."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from rich.console import Console

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
def one_interrupt() -> Iterator[None]:
    """Only the first SIGINT or SIGTERM interrupts: a second one must not stop the clean-up."""
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
