"""The process of a node: signals, exit codes, a clean end."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.signals import SignalHandlerOptions

from deworldsg_ros.scene.errors import DeWorldSGError

EXIT_USAGE = 2


def run_process(body: Callable[[threading.Event], int], args: list[str] | None = None) -> int:
    """Run something that uses ROS, from its start to its end.

    Args:
        body: given an event that SIGINT and SIGTERM set; returns the exit code.
        args: of the command line; None = those of the process.

    Returns:
        What the body returns, 2 for what cannot be used, 0 after an interrupt.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    # Our handlers, not rclpy's: those shut the context down while callbacks still publish.
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # a parameter file that cannot be read, a bad --ros-args
        return refuse(error)
    try:
        return body(stop)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except DeWorldSGError as error:
        return refuse(error)
    finally:
        rclpy.try_shutdown()


def refuse(error: Exception, code: int = EXIT_USAGE) -> int:
    """Say what is wrong in a line of the standard error; gives the exit code."""
    print(f"error: {error}", file=sys.stderr)
    return code
