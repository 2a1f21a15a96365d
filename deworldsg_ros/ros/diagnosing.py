"""What a node says about itself: the message of /diagnostics, and log lines of drops."""

from __future__ import annotations

import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from deworldsg_ros.ros.health import INTERNAL_ERROR, UNMATCHED_PREFIX, Report
from deworldsg_ros.words import visible, visible_lines

# Minimum time between two log lines with the same reason.
LOG_PERIOD_S = 10.0


class DropLog:
    """Logs drops, each reason at most once per LOG_PERIOD_S; safe to use from several threads.

    Args:
        logger: of rclpy.
    """

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._logged_s: dict[str, float] = {}
        self._lock = threading.Lock()

    def write(self, reason: str, message: str) -> None:
        """Log a drop."""
        now_s = time.monotonic()
        with self._lock:
            if now_s - self._logged_s.get(reason, -LOG_PERIOD_S) < LOG_PERIOD_S:
                return
            self._logged_s[reason] = now_s
        if reason == INTERNAL_ERROR:  # with a traceback
            self._logger.error(f"{reason}: {visible_lines(message)}")
        elif reason.startswith(UNMATCHED_PREFIX):
            self._logger.debug(f"{reason}: {visible(message)}")
        else:
            self._logger.warning(f"{reason}: {visible(message)}")


def diagnostic_array(report: Report, name: str, full_name: str) -> DiagnosticArray:
    """The message of a report, without a stamp."""
    status = DiagnosticStatus(
        level=bytes([report.level]),
        name=f"{name}: {full_name}",
        message=report.message,
        hardware_id="deworldsg_ros",
        values=[KeyValue(key=key, value=value) for key, value in report.values.items()],
    )
    return DiagnosticArray(status=[status])
