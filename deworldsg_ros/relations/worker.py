"""A thread in which the world model works, in nobody's way."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from deworldsg_ros.relations.clips import Rgb
from deworldsg_ros.relations.stage import RelationReasoner
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence


class EvidenceWorker:
    """Runs a reasoner's `work` in a thread of its own.

    `observe` returns the neighbour pairs at once, whatever the world model does; predictions come
    through `deliver`, in the worker's thread. To run in one thread instead, call the reasoner's
    `observe` and `drain`.

    Args:
        reasoner: whose clips are encoded; its counters tell what was dropped.
        deliver: called with each prediction; an exception in it is reported and the worker goes
            on.
        report: told what went wrong; default: the log.
    """

    def __init__(
        self,
        reasoner: RelationReasoner,
        deliver: Callable[[RelationEvidence], None],
        report: Callable[[str], None] | None = None,
    ) -> None:
        self.reasoner = reasoner
        self._deliver = deliver
        self._report = logging.getLogger(__name__).warning if report is None else report
        self._changed = threading.Condition()
        self._stopping = False
        self._busy = False
        # Something came since the last look, so that a clip may be worth its time now.
        self._news = False
        # A daemon, so that a model that never returns cannot keep the process alive.
        self._thread = threading.Thread(target=self._run, name="world-model", daemon=True)

    def start(self) -> None:
        """Start the thread; once."""
        self._thread.start()

    def observe(self, local: LocalGraph, rgb: Rgb | None = None) -> RelationEvidence:
        """Neighbour pairs of a frame, at once; see `RelationReasoner.observe`."""
        evidence = self.reasoner.observe(local, rgb)
        self._wake()
        return evidence

    def learn(self, change: Callable[[], None]) -> None:
        """Change the graph that clips are chosen by; see `RelationReasoner.learn`."""
        self.reasoner.learn(change)
        self._wake()

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until all clips that may be are encoded and delivered; False where time ran out."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._stopping or not (self._busy or self._news), timeout_s
            )

    def stop(self, timeout_s: float = 5.0) -> bool:
        """Drop what is queued and end the thread.

        Returns:
            False where the world model was still at its last clip when time ran out; the thread
            then ends, without delivering, when the model comes back.
        """
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self.reasoner.clear()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _wake(self) -> None:
        with self._changed:
            self._news = True
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._stopping or self._news)
                self._news = False
                self._busy = True
            while not self._stopping and (batch := self.reasoner.work_batch()):
                self._deliver_all(batch)
            if self._stopping:
                return

    def _deliver_all(self, batch: list[RelationEvidence]) -> None:
        for evidence in batch:
            if self._stopping:
                return
            try:
                self._deliver(evidence)
            except Exception as error:  # the receiver's fault must not end the world model
                self._report(f"evidence was not delivered: {type(error).__name__}: {error}")
