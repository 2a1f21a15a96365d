"""A thread for the world model, so that frames never wait for it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from deworldsg_ros.relations.clips import Rgb
from deworldsg_ros.relations.stage import RelationReasoner
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence


class EvidenceWorker:
    """Runs `work` of a reasoner in a separate thread.

    `observe` returns the neighbour pairs at once. Predictions come later, through `deliver`, in the
    worker's thread. To run in one thread, call `observe` and `drain` of the reasoner instead.

    Args:
        reasoner: queues the clips; its counters report dropped clips.
        deliver: called with each prediction. An exception in it is reported, and the worker
            continues.
        report: called with one sentence on each error; default: the log.
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
        # A frame or a change of the graph came since the worker last ran out of ready clips.
        self._news = False
        # A daemon: a world model that never returns cannot keep the process alive.
        self._thread = threading.Thread(target=self._run, name="world-model", daemon=True)

    def start(self) -> None:
        """Start the thread; once."""
        self._thread.start()

    def observe(self, local: LocalGraph, rgb: Rgb) -> RelationEvidence:
        """Find the neighbour pairs of a frame; see `RelationReasoner.observe`."""
        evidence = self.reasoner.observe(local, rgb)
        self._wake()
        return evidence

    def learn(self, change: Callable[[], None]) -> None:
        """Change the graph by which clips are chosen; see `RelationReasoner.learn`."""
        self.reasoner.learn(change)
        self._wake()

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until all ready clips are encoded and delivered; False after the timeout."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._stopping or not (self._busy or self._news), timeout_s
            )

    def stop(self, timeout_s: float = 5.0) -> bool:
        """Drop all queued clips and end the thread.

        Returns:
            False if the world model still encodes its last clip after the timeout. The thread then
            ends as soon as the model returns, and delivers nothing.
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
            while not self._stopping and (evidence := self._work_safely()) is not None:
                self._deliver_safely(evidence)
            if self._stopping:
                return

    def _work_safely(self) -> RelationEvidence | None:
        try:
            return self.reasoner.work()
        except Exception as error:  # the next frame begins again; without a thread, none would
            self._report(f"a clip was not judged: {type(error).__name__}: {error}")
            return None

    def _deliver_safely(self, evidence: RelationEvidence) -> None:
        if self._stopping:
            return
        try:
            self._deliver(evidence)
        except Exception as error:  # an error in the receiver must not end this thread
            self._report(f"evidence was not delivered: {type(error).__name__}: {error}")
