"""The command line: `deworldsg`."""

from deworldsg_ros.cli.main import main

__all__ = ["main"]
