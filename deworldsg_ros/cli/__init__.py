"""The command line: `deworldsg`."""

from __future__ import annotations

import sys

from deworldsg_ros.cli.exit_codes import EXIT_INTERRUPTED


def main() -> None:
    """Run the program; exit code 0, 2 for an error of the user, 130 after Ctrl-C."""
    try:
        # The import takes a second: Ctrl-C may come during it, too.
        from deworldsg_ros.cli.app import app

        app(prog_name="deworldsg")
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)
