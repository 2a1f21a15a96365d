"""The global graph of a node, in a thread of its own: merged, published, saved."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from deworldsg_ros.base.array_file import Arrays
from deworldsg_ros.base.files import write_atomically
from deworldsg_ros.base.words import counted
from deworldsg_ros.config import Config
from deworldsg_ros.graph.embeddings import embeddings_path, write_embeddings
from deworldsg_ros.graph.floor_plan import FoundThings
from deworldsg_ros.graph.provenance import path_beside, space_path, write_seen, write_space
from deworldsg_ros.graph.rooms import RoomMap
from deworldsg_ros.graph_builder import GraphBuilder, warm_up
from deworldsg_ros.map_file import (
    RESERVED_IDS,
    Continued,
    apart_of,
    check_paths,
    claim_map,
    continue_map,
    copy_state,
    first_id,
    write_first_id,
    write_map,
    write_state,
)
from deworldsg_ros.ros.graph_output import (
    UPDATES_TOPIC,
    EmbeddingTopic,
    MakeMarkers,
    Rivals,
    RoomFinder,
    RoomTopics,
    WholeGraph,
)
from deworldsg_ros.ros.health import HIDDEN
from deworldsg_ros.ros.node import StageNode
from deworldsg_ros.ros.options import Parameters
from deworldsg_ros.ros.threads import UpdateTimes, Worker
from deworldsg_ros.ros.transforms import Correct, Corrections
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.scene.frame_graph import LocalGraph, RelationEvidence, Vocabulary
from deworldsg_ros.scene.limits import APART_SESSION
from deworldsg_ros.streams.assembler import PendingEvidence
from deworldsg_ros.streams.poses import ClockGate, jump_text
from deworldsg_ros.wire import messages as wire

if TYPE_CHECKING:
    from deworldsg_ros.relocalisation import Found, Returning
    from deworldsg_ros.ros.transforms import MapTransform

# --- The map file of a node: continued at the start, written while the node works and at its end.

# Of the graph's thread: 34 nodes take 5 ms, so a large graph is copied less often.
MAX_SHARE = 0.02
# Longest time in which a disk may take a checkpoint, before the map itself is written.
SLOW_DISK_S = 20.0
APART = "the graph is not yet found in it"
# A checkpoint that failed is tried again after this time, also if the graph does not change.
RETRY_S = 10.0


class MapKeeper:
    """Owns a map file; no other process may write it until `close`.

    A node that is killed has lost at most the last period: its graph is copied in the graph's
    thread, and written in another. Ids that it had published are not given to other nodes: they are
    reserved on the disk before.

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
        self._look_again_s: float | None = None  # None = the last checkpoint was written
        self._copying_s = 0.0
        self._problem = ""
        self._unreserved_id = 0
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
        """Seconds until `checkpoint` is due, 0 = now; None without a change."""
        due_s = [at_s for at_s in (self._due_s, self._look_again_s) if at_s is not None]
        return max(0.0, min(due_s) - now_s) if due_s else None

    def checkpoint(self, builder: GraphBuilder) -> None:
        """Copy the graph, and write the map in the background; also if the last one failed."""
        now_s = time.monotonic()
        is_writing, failed = not self._worker.wait_idle(0.0), bool(self._problem)
        self._look_again_s = now_s + RETRY_S if is_writing or failed else None
        if failed or (self._due_s is not None and self._due_s <= now_s):
            self._due_s, self._look_again_s = None, now_s + RETRY_S
            self._worker.submit(copy_state(builder))
            self._copying_s = time.monotonic() - now_s

    @property
    def first_id(self) -> int:
        """The first id that no node of this map was ever published with."""
        return first_id(self.path)

    def reserve(self, next_id: int) -> None:
        """Call this before ids below `next_id` are published."""
        if next_id > self._unreserved_id:
            # Also after a failure: a full disk is not asked again for each node.
            self._unreserved_id = next_id + RESERVED_IDS
            try:
                write_first_id(self.path, self._unreserved_id)
            except ConfigurationError as error:
                self._node.drop("ids_not_reserved", str(error))

    def release(self, next_id: int) -> None:
        """Say that no id from `next_id` on was published; the map has been written."""
        with suppress(ConfigurationError):  # then some ids are left out
            write_first_id(self.path, next_id)

    def problems(self) -> list[str]:
        """Why the map is not written, in words."""
        return [f"{self._problem}; tried again every {RETRY_S:g} s"] if self._problem else []

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
        self._due_s = self._look_again_s = None
        self._problem = ""
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
                self._problem = str(error)
                self._node.drop("map_not_written", str(error))
            else:
                self._problem = ""


# --- The files of a node's graph: its map, and the JSON that ~/save writes.


class GraphFiles:
    """Reads and writes the files that the parameters name.

    Args:
        node: for its parameters, the log and the counts.

    Attributes:
        map: None without a map.
        is_apart: whether the graph is not yet found in the map, which stays as it is.

    Raises:
        ConfigurationError: if the map file cannot be written, or is that of `save_path`.
    """

    def __init__(self, node: StageNode) -> None:
        self._node = node
        self.is_apart = False
        options = node.parameters.node
        self._save_path = Path(options.save_path).absolute()
        if options.relocalise and not options.map_path:
            raise ConfigurationError("relocalise is true: expected a map_path to be found in")
        self.map: MapKeeper | None = None
        if options.map_path:
            self._check_paths(Path(options.map_path))
            self.map = MapKeeper(node, Path(options.map_path).absolute(), options.map_period_s)

    def _check_paths(self, map_path: Path) -> None:
        path = self._save_path
        beside = [
            ("its frames", path_beside(path)),
            ("its space", space_path(path)),
            ("its embeddings", embeddings_path(path)),
        ]
        check_paths(map_path, [("save_path", path), *beside])

    def continued_map(self) -> Continued | None:
        """The graph of the map file, if there is one; raises ConfigurationError if it has none."""
        continued = None if self.map is None else self.map.continued(self._node.parameters)
        if continued is not None:
            log = self._node.get_logger()
            log.info(continued.message) if continued.newest else log.warning(continued.message)
        return continued

    def save(self, builder: GraphBuilder | None) -> tuple[bool, str]:
        """Write the whole graph, with surface points, as JSON; and the map file.

        Returns:
            whether everything was written, and a sentence.
        """
        if builder is None:
            return False, "no graph yet: no local graph has arrived"
        message = builder.full()
        try:
            self._save_path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._save_path, wire.encode(message))
            stamp_ns = wire.ns_from_stamp(message.stamp)
            write_seen(self._save_path, stamp_ns, builder.frames.all(builder.graph))
            write_space(self._save_path, builder.space)
            write_embeddings(self._save_path, stamp_ns, builder.graph.embeddings)
        except OSError as error:
            return False, f"{self._save_path}: {error}"
        nodes, edges = counted(len(message.nodes), "node"), counted(len(message.edges), "edge")
        said = f"{self._save_path}: {nodes}, {edges}"
        if self.map is None:
            return True, said
        if self.is_apart:
            return True, f"{said}; map {self.map.path}: unchanged, {APART}"
        saved, about_map = self.map.save(builder)
        return saved, f"{said}; {about_map}"

    def changed(self) -> None:
        """Note that the graph differs from the last checkpoint of the map."""
        if self.map is not None and not self.is_apart:
            self.map.changed()

    def wait_s(self, now_s: float) -> float | None:
        """Seconds until the next checkpoint is due, 0 = now; None = there is none."""
        return None if self.map is None else self.map.wait_s(now_s)

    def checkpoint(self, builder: GraphBuilder | None) -> None:
        """Copy the graph, and write the map in the background."""
        if self.map is not None and builder is not None:
            self.map.checkpoint(builder)

    def close(self, builder: GraphBuilder | None, *, busy: bool) -> None:
        """Write the map, unless its graph is busy, and log it."""
        if self.map is None:
            return
        written, message = False, f"map {self.map.path}: not written, the graph is busy"
        if self.is_apart:
            written, message = False, f"map {self.map.path}: unchanged, {APART}"
            if builder is not None and not busy:
                message += f"; {self._write_apart(builder, self.map.path)}"
        elif not busy:
            written, message = self.map.save(builder)
        if written and builder is not None:
            self.map.release(builder.graph.next_id)
        self.map.close()
        log = self._node.get_logger()
        log.info(message) if written else log.warning(message)

    def _write_apart(self, builder: GraphBuilder, map_path: Path) -> str:
        path = apart_of(map_path)
        try:
            write_map(builder, path)
        except ConfigurationError as error:
            return str(error)
        return f"the new graph is {path}: {counted(builder.confirmed, 'node')}"


# --- The global graph of a node, in a thread of its own: merged, published, saved.
#
# Diagnostics and signals are served by the executor's thread, so they do not wait for the graph.

# Local graphs and evidence that may wait: a second of both at 30 Hz. A graph takes milliseconds a
# frame, so they wait only while kernels are compiled or a file is written.
QUEUE_JOBS = 60

MakeBuilder = Callable[[Vocabulary, str], GraphBuilder]


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
        self._corrections = self._moved = 0
        self._values: dict[str, str] = {}
        self._times = UpdateTimes(self._node.parameters.output.rate_hz)
        self._running_s = 0.0  # when the job that runs now was submitted
        self._publish_update = node.json_publisher(UPDATES_TOPIC, 50)
        self._map_transform: MapTransform
        self._rivals = Rivals(node, lambda: self._session, lambda: self.submit(self._tell_again))
        self._whole = WholeGraph(node, markers)
        self._embeddings = EmbeddingTopic(node)
        self._room = RoomTopics(node)
        self._rooms = RoomFinder(
            node, lambda *found: self.submit(lambda: self._set_rooms(*found), lambda: None)
        )
        self.files = GraphFiles(node)
        # None until a map or the first local graph gives the world frame and the vocabulary.
        continued = self.files.continued_map()
        self._builder = None if continued is None else continued.builder
        self._returning: Returning | None = None
        if node.parameters.node.relocalise:
            self._begin_apart(self._builder)
            continued = None
        self._worker = Worker(
            "graph", self._run, size=QUEUE_JOBS, on_overrun=_drop, after=self._publish
        )
        if continued is not None:
            now_s = time.monotonic()
            self.submit(lambda: self._times.changed(now_s, now_s))
        Corrections(
            node, self._world_frame, lambda correct: self.submit(lambda: self._correct(correct))
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
        self._room.close()
        self._rooms.close()
        self.files.close(self._builder, busy=not ended)

    def problems(self) -> list[str]:
        """What is wrong with the map, and on the topics, in words."""
        of_map = [] if self.files.map is None else self.files.map.problems()
        if self._returning is not None and self._returning.waits:
            of_map.append(f"to be found in the map {self._returning.status}")
        return [*of_map, *self._rivals.problems()]

    def values(self) -> dict[str, str]:
        """The size of the graph, for /diagnostics."""
        if not self._values:
            return {}
        return {
            **self._values,
            "graph queue": str(self._worker.waiting),
            "evidence waiting": str(len(self._pending)),
            "pose corrections": str(self._corrections),
            "nodes moved by corrections": str(self._moved),
            **({} if self._returning is None else {"found in the map": self._returning.status}),
        }

    # The methods below run in the graph's thread.

    @property
    def builder(self) -> GraphBuilder | None:
        """The graph; None before the first frame."""
        return self._builder

    @property
    def returning(self) -> Returning | None:
        """The map in which the graph waits to be found, or was; None without `relocalise`."""
        return self._returning

    @property
    def session(self) -> str:
        """Of the messages: ids of another one may name other objects."""
        return self._session

    def replace(self, builder: GraphBuilder) -> None:
        """Continue with another graph: clients see a new session."""
        if self._builder is not None:
            builder.graph.skip_to(self._builder.graph.next_id)
            builder.place_as(self._builder)
        self._builder, self._session = builder, secrets.token_hex(8)
        self._returning, self.files.is_apart = None, False
        self.newest_ns, self._clock, self._pending = 0, ClockGate(), PendingEvidence()
        self._whole.changed(not builder.confirmed)  # objects appear with their first update
        self.changed()

    def changed(self) -> None:
        """Publish what a call has changed in the graph."""
        self.files.changed()
        self._times.changed(self._running_s, time.monotonic())

    def integrate(self, local: LocalGraph) -> None:
        """Merge a local graph; one whose stamp jumps is held back until the next one."""
        admitted, lost = self._clock.admit(local.stamp_ns, local)
        for lost_ns in lost:
            self._node.drop("time_jump", jump_text("local graph", lost_ns))
        for _, item in admitted:
            with self._node.refusing():
                self._merge(item)

    def _merge(self, local: LocalGraph) -> None:
        """Merge a local graph, and the evidence that waited for it."""
        returning = self._returning
        if self._builder is None:
            begin: MakeBuilder = partial(GraphBuilder, self._node.parameters)
            begin = begin if returning is None else returning.begin
            self._builder = begin(local.vocabulary, local.frame_id)
            if returning is not None and returning.found is not None:
                self._tell_place(returning.found, local.stamp_ns)
            if self.files.map is not None:  # no map, but a run before may have published some
                self._builder.graph.skip_to(self.files.map.first_id)
        self._builder.integrate(local)
        for reason, message in self._builder.refused.items():
            self._node.drop(reason, message)
        if local.stamp_ns < self.newest_ns:
            self._node.drop("time_jump", jump_text("local graph", self.newest_ns))
            lost = self._pending.clear()
            if lost:
                self._node.drop("unmatched_evidence", "the clock was set back", lost)
        self.newest_ns = local.stamp_ns
        self.changed()
        if returning is not None and returning.waits:
            self._look_for_map(returning, local)
        for evidence in self._pending.take(local.stamp_ns):
            with self._node.refusing():
                self._add_evidence(self._builder, evidence)

    def add_evidence(self, evidence: RelationEvidence) -> None:
        """Add evidence; keep it if its local graph has not arrived."""
        if self._builder is None or evidence.stamp_ns > self.newest_ns:
            self._pending.add(evidence)
            return
        self._add_evidence(self._builder, evidence)
        self._times.changed(self._running_s, time.monotonic(), can_wait=True)

    def _set_rooms(
        self,
        builder: GraphBuilder,
        before: RoomMap,
        rooms: RoomMap,
        states: list[wire.RoomState],
        things: FoundThings,
    ) -> None:
        """Take rooms and things that were found, unless the graph or a name is another one now."""
        if builder is self._builder and builder.rooms is before:
            builder.set_rooms(rooms, states)
            builder.add_things(things)
            self._times.changed(self._running_s, time.monotonic(), can_wait=True)

    def _correct(self, correct: Correct) -> None:
        assert self._builder is not None
        change = correct(self._builder.trail)
        if change is not None:
            self._moved += self._builder.follow(change)
            self._corrections += 1
            if self._returning is not None:
                self._returning.follow(change)
            self.changed()

    def _add_evidence(self, builder: GraphBuilder, evidence: RelationEvidence) -> None:
        builder.add_evidence(evidence)
        if self._returning is not None and self._returning.waits:
            self._returning.note_evidence(evidence)

    def _begin_apart(self, of_map: GraphBuilder | None) -> None:
        """Let a new graph wait until it is found in the map; without a map, it begins one."""
        # Rare, and it needs the client.
        from deworldsg_ros.relocalisation import Returning
        from deworldsg_ros.ros.transforms import MapTransform

        self._returning = Returning(self._node.parameters, of_map)
        self._map_transform = MapTransform(self._node)
        self._builder, self.files.is_apart = None, self._returning.waits
        if self.files.is_apart:
            self._session = APART_SESSION + self._session

    def _look_for_map(self, returning: Returning, local: LocalGraph) -> None:
        """Continue the map if the graph is found in it: for clients, a new session."""
        assert self._builder is not None
        continued = returning.note(self._builder, local)
        if continued is None or returning.found is None:
            return
        self._builder, self._session = continued, secrets.token_hex(8)
        self.files.is_apart = False
        self._node.get_logger().info(f"found in the map {returning.status}")
        for reason, count in returning.refused.items():
            self._node.drop(reason, "a frame from before the graph was found in the map", count)
        self._tell_place(returning.found, local.stamp_ns)
        self._whole.changed(not continued.confirmed)
        self.changed()

    def _tell_place(self, found: Found, stamp_ns: int) -> None:
        assert self._builder is not None
        frames = self._builder.graph.frame_id, self._builder.poses_frame
        self._map_transform.publish(stamp_ns, *frames, found.T_map_world)

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
        with self._node.refusing():
            self._embeddings.publish(self._builder, self._session, now_s)
        with self._node.refusing():
            self._room.publish(self._builder, now_s)
        with self._node.refusing():
            self._rooms.look(self._builder, now_s)
        parts = (
            *(self._times, self._whole, self.files),
            *(self._embeddings, self._room, self._rooms),
        )
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
        if self.files.map is not None:
            self.files.map.reserve(self._builder.graph.next_id)
        update.session = self._session
        self._publish_update(update)
        self._whole.changed()
        self.files.changed()
        self._on_update(update, time.monotonic() - changed_s)

    def _tell_again(self) -> None:
        if self._builder is not None:
            self._whole.changed()

    def _publish_whole(self) -> None:
        assert self._builder is not None
        snapshot = self._builder.snapshot()
        snapshot.session = self._session
        self._whole.publish(snapshot, time.monotonic())
        self._values = _sizes(snapshot, self._builder.hidden)

    # The methods below run in the executor's thread.

    def _world_frame(self) -> str:
        return "" if self._builder is None else self._builder.poses_frame

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
