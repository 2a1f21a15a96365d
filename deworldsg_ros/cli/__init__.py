"""The command line: `deworldsg`."""

from __future__ import annotations

import sys

EXIT_INTERRUPTED = 130


def main() -> None:
    """Run the program; ends the process with 0, 2 for errors of the user, 130 after Ctrl-C."""
    try:
        # This takes a second, in which Ctrl-C may come, too.
        from deworldsg_ros.cli.app import app

        app(prog_name="deworldsg")
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)
