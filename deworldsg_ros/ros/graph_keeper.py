"""The global graph of a node, in a thread of its own: merged, published, saved.

Diagnostics and signals are served by the executor's thread, so they do not wait for the graph.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from geometry_msgs.msg import PoseStamped

from deworldsg_ros.graph_builder import GraphBuilder, warm_up
from deworldsg_ros.ros.graph_files import GraphFiles
from deworldsg_ros.ros.health import HIDDEN
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.options import Parameters
from deworldsg_ros.ros.pose_corrections import CORRECTION_TOPIC, PoseCorrections
from deworldsg_ros.ros.qos import reliable
from deworldsg_ros.ros.update_times import UpdateTimes
from deworldsg_ros.ros.whole_graph import MakeMarkers, WholeGraph
from deworldsg_ros.ros.worker import Worker
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence
from deworldsg_ros.streams.clock_gate import ClockGate, jump_text
from deworldsg_ros.streams.pending import PendingEvidence

# Local graphs and evidence that may wait: a second of both at 30 Hz. A graph takes milliseconds a
# frame, so they wait only while kernels are compiled or a file is written.
QUEUE_JOBS = 60


class _Job(NamedTuple):
    """A call for the graph's thread, when it was submitted, and the call if it is dropped."""

    run: Callable[[], None]
    submitted_s: float
    dropped: Callable[[], None]


class GraphKeeper:
    """Owns the `GraphBuilder` of a node; only its own thread uses it.

    Args:
        node: publishes the graph, and counts.
        markers: the markers of a snapshot (`view.markers`).
        on_update: called in the graph's thread with each update, and the seconds since the first
            of its messages arrived.

    Attributes:
        newest_ns: stamp of the newest merged frame; 0 = none.
        files: the map, and the JSON file.

    Raises:
        ConfigurationError: for a map file that cannot be read or written.
    """

    def __init__(
        self,
        node: StageNode,
        markers: MakeMarkers,
        on_update: Callable[[wire.SceneGraphUpdateMessage, float], None],
    ) -> None:
        self._node = node
        self._on_update = on_update
        warm_up(node.parameters)
        self._pending = PendingEvidence()
        self.newest_ns = 0
        self._clock: ClockGate[LocalGraph] = ClockGate()
        # A continued map is a new session, too: its sequence numbers start again.
        self._session = secrets.token_hex(8)
        self._corrections = PoseCorrections()
        self._values: dict[str, str] = {}
        self._times = UpdateTimes(self._node.parameters.output.rate_hz)
        self._running_s = 0.0  # when the job that runs now was submitted
        self._publish_update = node.json_publisher("scene_graph/updates", 50)
        self._whole = WholeGraph(node, markers)
        self.files = GraphFiles(node)
        # None until a map or the first local graph gives the world frame and the vocabulary.
        continued = self.files.continued_map()
        self._builder = None if continued is None else continued.builder
        self._worker = Worker(
            "graph", self._run, size=QUEUE_JOBS, on_overrun=_drop, after=self._publish
        )
        if continued is not None:
            now_s = time.monotonic()
            self.submit(lambda: self._times.changed(now_s, now_s))
        node.create_subscription(
            PoseStamped, CORRECTION_TOPIC, node.guarded(self._receive_correction), reliable(10)
        )

    def submit(self, job: Callable[[], None], dropped: Callable[[], None] | None = None) -> None:
        """Call a function in the graph's thread, after the earlier ones; does not block.

        Args:
            job: may raise RefusedInput.
            dropped: called instead if too many wait; default: count an overrun.
        """
        self._worker.submit(_Job(job, time.monotonic(), dropped or self._count_overrun))

    def submit_evidence(self, job: Callable[[], None]) -> None:
        """The same for evidence: the graph has its frame without it."""
        self.submit(job, lambda: self._count_overrun("evidence_overrun"))

    def configure(self, parameters: Parameters) -> None:
        """Use other thresholds and another rate from now on; `submit` it."""
        self._times.limit(parameters.output.rate_hz)
        if self._builder is not None:
            self._builder.configure(parameters)

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until all jobs are done; False on timeout."""
        return self._worker.wait_idle(timeout_s)

    def close(self) -> None:
        """End the threads, then write the map file."""
        ended = self._worker.stop()
        self._whole.close()
        self.files.close(self._builder, busy=not ended)

    def values(self) -> dict[str, str]:
        """The size of the graph, for /diagnostics."""
        if not self._values:
            return {}
        return {
            **self._values,
            "graph queue": str(self._worker.waiting),
            "evidence waiting": str(len(self._pending)),
            **self._corrections.values(),
        }

    # The methods below run in the graph's thread.

    @property
    def builder(self) -> GraphBuilder | None:
        """The graph; None before the first frame."""
        return self._builder

    def replace(self, builder: GraphBuilder) -> None:
        """Continue with another graph: clients see a new session."""
        self._builder, self._session = builder, secrets.token_hex(8)
        self.newest_ns, self._clock, self._pending = 0, ClockGate(), PendingEvidence()
        self._whole.changed(not builder.confirmed)  # objects appear with their first update
        self.changed()

    def changed(self) -> None:
        """Publish what a call has changed in the graph."""
        self.files.changed()
        self._times.changed(self._running_s, time.monotonic())

    def integrate(self, local: LocalGraph) -> None:
        """Merge a local graph; one whose stamp jumps is held back until the next one."""
        admitted, lost_ns = self._clock.admit(local.stamp_ns, local)
        if lost_ns is not None:
            self._node.drop("time_jump", jump_text("local graph", lost_ns))
        for _, item in admitted:
            with self._node.refusing():
                self._merge(item)

    def _merge(self, local: LocalGraph) -> None:
        """Merge a local graph, and the evidence that waited for it."""
        if self._builder is None:
            self._builder = GraphBuilder(self._node.parameters, local.vocabulary, local.frame_id)
        self._builder.integrate(local)
        if local.stamp_ns < self.newest_ns:
            self._node.drop("time_jump", jump_text("local graph", self.newest_ns))
            lost = self._pending.clear()
            if lost:
                self._node.drop("unmatched_evidence", "the clock was set back", lost)
        self.newest_ns = local.stamp_ns
        self.changed()
        for evidence in self._pending.take(local.stamp_ns):
            with self._node.refusing():
                self._builder.add_evidence(evidence)

    def add_evidence(self, evidence: RelationEvidence) -> None:
        """Add evidence; keep it if its local graph has not arrived."""
        if self._builder is None or evidence.stamp_ns > self.newest_ns:
            self._pending.add(evidence)
            return
        self._builder.add_evidence(evidence)
        self._times.changed(self._running_s, time.monotonic(), can_wait=True)

    def _correct(self, message: Any) -> None:
        self._corrections.apply(message, self._builder)
        self._times.changed(self._running_s, time.monotonic())

    def _run(self, job: _Job) -> None:
        self._running_s = job.submitted_s
        with self._node.refusing():
            job.run()

    def _publish(self) -> float | None:
        """Publish what is due; returns the seconds until something else is."""
        if self._times.wait_s(time.monotonic()) == 0.0:
            with self._node.refusing():
                self._publish_changes()
        if self._whole.wait_s(time.monotonic()) == 0.0:
            with self._node.refusing():
                self._publish_whole()
        if self.files.wait_s(time.monotonic()) == 0.0:
            with self._node.refusing():
                self.files.checkpoint(self._builder)
        now_s = time.monotonic()
        parts = (self._times, self._whole, self.files)
        waits = (part.wait_s(now_s) for part in parts)
        return min((wait_s for wait_s in waits if wait_s is not None), default=None)

    def _publish_changes(self) -> None:
        now_s, changed_s = time.monotonic(), self._times.taken()
        assert self._builder is not None
        update = self._builder.update()
        if update is not None:
            self._times.book(now_s)
        if self._builder.waiting:
            # Edges wait for the next update, also if no frame comes. Parts of a map do not wait.
            self._times.changed(now_s, now_s, can_wait=update is not None)
        if update is None:
            return
        update.session = self._session
        self._publish_update(update)
        self._whole.changed()
        self.files.changed()
        self._on_update(update, time.monotonic() - changed_s)

    def _publish_whole(self) -> None:
        assert self._builder is not None
        snapshot = self._builder.snapshot()
        snapshot.session = self._session
        self._whole.publish(snapshot, time.monotonic())
        self._values = _sizes(snapshot, self._builder.hidden)

    # The methods below run in the executor's thread.

    def _receive_correction(self, message: Any) -> None:
        self._node.health.received(CORRECTION_TOPIC)
        self.submit(lambda: self._correct(message))

    def _count_overrun(self, reason: str = "overrun") -> None:
        self._node.drop(reason, f"more messages arrive than are merged: {QUEUE_JOBS} waited")


def _drop(job: _Job) -> None:
    job.dropped()


def _sizes(snapshot: wire.SceneGraphMessage, hidden: dict[str, int]) -> dict[str, str]:
    """The size of the graph, for /diagnostics."""
    return {
        "nodes": str(len(snapshot.nodes)),
        **{f"{HIDDEN}{why}": str(count) for why, count in hidden.items()},
        "edges": str(len(snapshot.edges)),
        "sequence": str(snapshot.sequence),
    }
