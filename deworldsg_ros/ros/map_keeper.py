"""The map file of a node: continued at the start, written while the node works and at its end."""

from __future__ import annotations

import time
from pathlib import Path

from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import (
    Continued,
    claim_map,
    continue_map,
    copy_state,
    write_map,
    write_state,
)
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.worker import Worker
from deworldsg_ros.scene.array_file import Arrays
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.words import counted

# Of the graph's thread: 34 nodes take 5 ms, so a large graph is copied less often.
MAX_SHARE = 0.02
# Longest time in which a disk may take a checkpoint, before the map itself is written.
SLOW_DISK_S = 20.0


class MapKeeper:
    """Owns a map file; no other process may write it until `close`.

    A node that is killed has lost at most the last period: its graph is copied in the graph's
    thread, and written in another.

    Args:
        node: for the log and the counts.
        path: of the map file.
        period_s: seconds between two checkpoints of a graph that changes; 0 = none.

    Raises:
        ConfigurationError: if the map cannot be written, or another process writes it.
    """

    def __init__(self, node: StageNode, path: Path, period_s: float) -> None:
        self.path = path
        self._node = node
        self._period_s = period_s
        self._due_s: float | None = None  # None = nothing changed since the last checkpoint
        self._copying_s = 0.0
        self._lock = claim_map(path)
        self._worker: Worker[Arrays] = Worker(
            "map", self._write, size=1, on_overrun=lambda state: None
        )

    def continued(self, config: Config) -> Continued | None:
        """The graph of the map file, if there is one; raises ConfigurationError if it has none."""
        try:
            return continue_map(config, self.path)
        except ConfigurationError:
            self.close()
            raise

    def changed(self) -> None:
        """Note that the graph differs from the last checkpoint."""
        if self._due_s is None and self._period_s:
            self._due_s = time.monotonic() + max(self._period_s, self._copying_s / MAX_SHARE)

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until the next checkpoint is due, 0 = now; None without a change."""
        return None if self._due_s is None else max(0.0, self._due_s - now_s)

    def checkpoint(self, builder: GraphBuilder) -> None:
        """Copy the graph, and write the map in the background."""
        self._due_s = None
        started_s = time.monotonic()
        self._worker.submit(copy_state(builder))
        self._copying_s = time.monotonic() - started_s

    def save(self, builder: GraphBuilder | None) -> tuple[bool, str]:
        """Write the map now; returns whether it was written, and a sentence."""
        if builder is None:
            return False, "no map written: no local graph has arrived"
        if not self._worker.wait_idle(SLOW_DISK_S):
            return False, f"map {self.path}: not written, the disk takes nothing"
        try:
            write_map(builder, self.path)
        except ConfigurationError as error:
            return False, str(error)
        self._due_s = None
        return True, f"map {self.path}: {counted(builder.confirmed, 'node')}"

    def close(self) -> None:
        """End the thread, and let other processes write the map."""
        self._worker.stop()
        self._lock.release()

    def _write(self, state: Arrays) -> None:
        with self._node.refusing():  # the thread also writes the next one
            try:
                write_state(state, self.path)
            except ConfigurationError as error:
                self._node.drop("map_not_written", str(error))
