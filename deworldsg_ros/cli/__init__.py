"""The command line: `deworldsg`."""

from __future__ import annotations

import io
import os
import signal
import sys


def main() -> None:
    """Run the program; exit code 0, 2 for an error of the user, 130 after Ctrl-C."""
    # Names of files may be no text: print them escaped rather than fail.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # As the nodes do; see `deworldsg_ros.nodes`.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        # The import takes a second: Ctrl-C may come during it, too. So nothing is imported above.
        from deworldsg_ros.cli.app import app

        app(prog_name="deworldsg")
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)  # EXIT_INTERRUPTED
