"""The process of a node: signals and exit codes."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.signals import SignalHandlerOptions

from deworldsg_ros.scene.errors import ConfigurationError, DeWorldSGError
from deworldsg_ros.words import visible_lines

EXIT_USAGE = 2
# A model never returns: EX_SOFTWARE of sysexits.h.
EXIT_HUNG = 70
# "true": a launch file or systemd starts the process again when it ends.
RESPAWN_VARIABLE = "DEWORLDSG_RESPAWN"
NO_SECURITY = ConfigurationError(
    "ROS_SECURITY_ENABLE is true, but this middleware was built without security, as the wheels of "
    "ROS 2 are: source a ROS 2 Jazzy of the system, or unset ROS_SECURITY_ENABLE"
)


def run_process(body: Callable[[threading.Event], int], args: list[str] | None = None) -> int:
    """Initialise ROS, run a function, shut ROS down.

    Args:
        body: called with an event that SIGINT and SIGTERM set; returns the exit code.
        args: command line; None = that of the process.

    Returns:
        The exit code of `body`; 2 for unusable input; 0 after an interrupt.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    # rclpy's own handlers would shut the context down while callbacks still publish.
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # an unreadable parameter file, or malformed --ros-args
        return refuse(error)
    try:
        return body(stop)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except DeWorldSGError as error:
        return refuse(error)
    except RuntimeError as error:  # RCLError, which rclpy does not export
        if "security libraries" not in str(error):
            raise
        return refuse(NO_SECURITY)
    finally:
        rclpy.try_shutdown()


def refuse(error: Exception, code: int = EXIT_USAGE) -> int:
    """Print an error on the standard error; return the exit code."""
    print(f"error: {visible_lines(str(error))}", file=sys.stderr)
    return code
