"""The live view of the demo: viewer_node as one more process, and its address on the terminal."""

from __future__ import annotations

import re
import sys
import threading
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from deworldsg_ros.cli import outputs
from deworldsg_ros.cli.installation import dds_environment, node_command
from deworldsg_ros.cli.processes import LoggedProcess

VIEWER = "viewer_node"
# The line of viewer_node with its address.
ADDRESS = re.compile(r"^view: (http\S+)$", re.MULTILINE)
LOOK_PERIOD_S = 0.2
START_LIMIT_S = 60.0


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
        if find_spec("viser") is None:
            self._note("it needs the package viser: pip install 'deworldsg_ros[view]'")
            return
        command = [*node_command(VIEWER), "--ros-args", "--params-file", str(self._config)]
        process = LoggedProcess(VIEWER, command, dds_environment(), self._log)
        self._processes.append(process)
        threading.Thread(target=self._announce, args=[process], daemon=True).start()

    def stay_open(self) -> None:
        """Keep the page until Ctrl-C if someone is at the terminal."""
        if self.url is not None and self._console.is_terminal and sys.stdin.isatty():
            text = f"the view stays at {self.url}: press Ctrl-C to end"
            self._console.print(text, highlight=False, soft_wrap=True)
            with suppress(KeyboardInterrupt):
                self._processes[-1].wait(None)

    def _announce(self, process: LoggedProcess) -> None:
        end_s = time.monotonic() + START_LIMIT_S
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
