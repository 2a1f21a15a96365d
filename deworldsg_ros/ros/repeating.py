"""A thread that calls a function again and again, for work that waits for others."""

from __future__ import annotations

import threading
from collections.abc import Callable

from deworldsg_ros.ros.node import StageNode


class Repeating:
    """Calls a function every `period_s`; exceptions are counted by the node.

    Args:
        node: counts.
        function: may block; the next call waits for it.
        period_s: from the end of one call to the start of the next.
    """

    def __init__(self, node: StageNode, function: Callable[[], None], period_s: float) -> None:
        self._node, self._function, self._period_s = node, function, period_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while not self._stop.wait(self._period_s):
            with self._node.refusing():
                self._function()
