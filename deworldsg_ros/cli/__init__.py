"""The command line: `deworldsg`."""

from deworldsg_ros.cli.app import main

__all__ = ["main"]
