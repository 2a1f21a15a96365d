"""Writes a store, and asks it: a journal of messages, and a database made of it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from datetime import datetime, time
from operator import attrgetter
from pathlib import Path
from typing import Any

import msgspec

from deworldsg_ros.base.files import FileLock, check_regular, paused_collector
from deworldsg_ros.base.words import stamp_ns_from_text
from deworldsg_ros.client.meanings import is_class
from deworldsg_ros.client.objects import Rooms
from deworldsg_ros.graph.graph_files import MAX_GRAPH_BYTES, read_content
from deworldsg_ros.scene.errors import RefusedInput, StoreError
from deworldsg_ros.scene.limits import APART_SESSION
from deworldsg_ros.store.database import (
    Database,
    Head,
    History,
    Rows,
    Stay,
    answer_apart,
    checked_question,
    opened,
    stay_of,
)
from deworldsg_ros.wire import messages as wire

# --- The messages of a store: one JSON document a line, in their order; only ever appended to.

# A whole graph, or the changes of one.
GraphMessage = wire.SceneGraphMessage | wire.SceneGraphUpdateMessage
# Of the end of the file that are searched at a time for the end of a line.
_BLOCK = 1 << 20
# How the line of an update begins.
_UPDATE = b'{"schema":' + msgspec.json.encode(wire.schema_of(wire.SceneGraphUpdateMessage))[:-1]
_UPDATE = _UPDATE.partition(b',"version"')[0]


class Journal:
    """The file of messages; the caller has the right to write it.

    Args:
        path: of the file; it is made if it is missing. A last line without an end, of a writer that
            was killed, is cut off.

    Raises:
        OSError: if the file cannot be made or read.
    """

    def __init__(self, path: Path) -> None:
        check_regular(path)
        self._file = path.open("ab")
        size, end = self.size, _end_of_lines(path)
        if end < size:
            self._mend(path, end)

    def _mend(self, path: Path, end: int) -> None:
        """Complete the last line, or drop it if a killed writer cut it off."""
        with path.open("rb") as file:
            if not file.read(64).lstrip().startswith(b"{"):
                raise StoreError(f"{path} has no messages of a store: expected JSON, one a line")
            file.seek(end)
            last = file.read()
        try:
            decode(last)
        except RefusedInput:
            self._file.truncate(end)
        else:
            self._file.write(b"\n")
            self._file.flush()

    @property
    def size(self) -> int:
        """Bytes of all messages."""
        return os.fstat(self._file.fileno()).st_size

    def append(self, content: bytes) -> None:
        """Add a message. It survives the end of this process, and after `sync` that of the machine.

        Raises:
            OSError: if it cannot be written; then the file is as before.
        """
        if b"\n" in content:  # between tokens only: JSON has no line breaks inside of strings
            content = content.replace(b"\n", b" ")
        size = self.size
        try:
            self._file.writelines((content, b"\n"))
            self._file.flush()
        except OSError:
            self._file.truncate(size)
            raise

    def sync(self) -> None:
        """Wait until the messages are on the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_messages(path: Path, start: int = 0) -> Iterator[tuple[GraphMessage, int]]:
    """The messages from a position on, each with the position after it.

    Raises:
        StoreError: for a line that is no message, with its position.
    """
    with path.open("rb") as file:
        file.seek(start)
        for line in file:
            end = start + len(line)
            if not line.endswith(b"\n"):
                return  # a writer is at work, or was killed
            try:
                yield decode(line), end
            except RefusedInput as refusal:
                raise StoreError(f"{path}, byte {start}: {refusal}") from refusal
            start = end


def decode(content: bytes) -> GraphMessage:
    """The whole graph or the update of a line; raises RefusedInput."""
    # Updates are written by `StoreWriter.add`, with their fields in the order of their type.
    if content.startswith(_UPDATE):
        return wire.decode(content, wire.SceneGraphUpdateMessage, MAX_GRAPH_BYTES)
    return wire.decode(content, wire.SceneGraphMessage, MAX_GRAPH_BYTES)


def _end_of_lines(path: Path) -> int:
    """Position after the last line that is whole."""
    with path.open("rb") as file:
        end = file.seek(0, os.SEEK_END)
        while end:
            start = max(0, end - _BLOCK)
            file.seek(start)
            found = file.read(end - start).rfind(b"\n")
            if found >= 0:
                return start + found + 1
            end = start
    return 0


# --- Messages that are not in the database yet, joined into one change of it.


class Batch:
    """The changes since the last `clear`.

    Args:
        head: what the database contains.
        history: the stays of the objects in the database.

    Attributes:
        head: what it will contain.
    """

    def __init__(self, head: Head, history: History) -> None:
        self.head = head
        self._history = history
        self._stored = set(history.current)
        self.clear()

    def __bool__(self) -> bool:
        return self._changed

    def clear(self) -> None:
        """Forget the changes: they are in the database."""
        self._changed = self._is_whole = False
        self._nodes: dict[int, wire.NodeState | None] = {}
        self._edges: dict[tuple[int, int], wire.EdgeState | None] = {}
        self._rooms: Rooms | None = None

    def follows(self, message: GraphMessage) -> bool:
        """Whether a message is the next one; False if it is known. Raises as `StoreWriter.add`."""
        head, session = self.head, _session(message)
        is_known = session == head.session and message.sequence <= head.sequence
        # A graph that waits to be found in its map has another frame, and ids that do not last.
        if (session and is_known) or session.startswith(APART_SESSION):
            return False
        if message.nodes and head.frame_id not in ("", message.frame_id):
            raise RefusedInput(
                "wrong_frame", f"graph is in frame '{message.frame_id}': expected '{head.frame_id}'"
            )
        if isinstance(message, wire.SceneGraphUpdateMessage) and not self._begins(message):
            if session == head.session and _before(message) <= head.sequence:
                return True
            raise RefusedInput(
                "lost_updates",
                f"update {message.sequence} of session '{session}' after {head.sequence} of "
                f"'{head.session}': expected the next one, or the whole graph",
            )
        stamp_ns = wire.ns_from_stamp(message.stamp)
        if stamp_ns < head.stamp_ns:
            raise RefusedInput(
                "old_graph",
                f"graph of {stamp_ns / 1e9:.3f} s is older than the newest one of the store, "
                f"{head.stamp_ns / 1e9:.3f} s: expected graphs in the order of their time",
            )
        return True

    def add(self, message: GraphMessage) -> None:
        """Add the next message."""
        # Within a session, a late frame may have an earlier stamp.
        stamp_ns = max(wire.ns_from_stamp(message.stamp), self.head.stamp_ns)
        removed = set()
        if self._begins(message):
            self._is_whole = True
            self._nodes, self._edges, self._rooms = {}, {}, Rooms()
            removed = set(self._history.current) - {node.id for node in message.nodes}
        if isinstance(message, wire.SceneGraphUpdateMessage):
            removed.update(node.id for node in message.removed_nodes)
            for pair in message.removed_edges:
                self._edges[pair.subject, pair.object] = None
        for node_id in removed:
            self._history.end(node_id, stamp_ns)
            self._nodes[node_id] = None
        for node in message.nodes:
            self._history.see(node, stamp_ns)
            self._nodes[node.id] = node
        self._edges.update(zip(map(attrgetter("subject", "object"), message.edges), message.edges))
        if isinstance(message.rooms, list):
            self._rooms = Rooms.of_message(message.rooms)
        self.head = Head(
            self.head.position,
            stamp_ns,
            message.frame_id,
            _session(message),
            message.sequence,
        )
        self._changed = True

    def write(self, database: Database) -> None:
        """Write the changes; the caller has begun a transaction."""
        nodes = {i: node for i, node in self._nodes.items() if node is not None}
        edges = [edge for edge in self._edges.values() if edge is not None]
        if self._is_whole:
            database.replace_graph(nodes, edges)
            self._stored = set(nodes)
        else:
            gone = self._nodes.keys() - nodes.keys()
            cut = [pair for pair, edge in self._edges.items() if edge is None]
            database.remove(gone & self._stored, cut)
            new = [node for i, node in nodes.items() if i not in self._stored]
            changed = [node for i, node in nodes.items() if i in self._stored]
            database.put(new, changed, edges)
            self._stored = (self._stored - gone) | nodes.keys()
        if self._rooms is not None:
            database.replace_rooms(self._rooms)
        database.put_stays(*self._history.take())
        database.write_head(replace(self.head))

    def _begins(self, message: GraphMessage) -> bool:
        """Whether a message replaces the graph: a whole one, or the first update of a session."""
        if isinstance(message, wire.SceneGraphMessage) or message.since == 0:
            return True
        return _before(message) == 0 and _session(message) != self.head.session


def _before(update: wire.SceneGraphUpdateMessage) -> int:
    """Number of the update that this one follows."""
    return update.sequence - 1 if isinstance(update.since, msgspec.UnsetType) else update.since


def _session(message: GraphMessage) -> str:
    return "" if isinstance(message.session, msgspec.UnsetType) else message.session


# --- Times as people write them.

_AGO = re.compile(r"([\d.]+)\s*(s|min|h|d)\s+ago")
_UNIT_S = {"s": 1, "min": 60, "h": 3600, "d": 86400}
EXAMPLES = "now, 10:00, 2026-03-01T10:00, '5 min ago' or the seconds of a stamp"


def clock_text(time_ns: int) -> str:
    """Nanoseconds as a date and time in the machine's time zone."""
    return datetime.fromtimestamp(time_ns // 10**9).strftime("%Y-%m-%d %H:%M:%S")


def time_ns_from_text(text: str, newest_ns: int) -> int:
    """Nanoseconds of a time on the clock of the graph's stamps.

    Args:
        text: seconds of a stamp; a date and time of ISO 8601, of the machine's time zone if it has
            none; a time of the day on which the graph is newest; ``now``, the newest stamp; or
            ``5 min ago``, counted from it.
        newest_ns: the newest stamp of the graph.

    Raises:
        StoreError: for other text.
    """
    time_ns = _time_ns(text.strip(), newest_ns)
    if time_ns >= 2**63:
        raise StoreError(f"time '{text[:40]}': expected one before 2262")
    return max(time_ns, 0)


def _time_ns(text: str, newest_ns: int) -> int:
    if text == "now":
        return newest_ns
    try:
        ago = _AGO.fullmatch(text)
        if ago is not None:
            return newest_ns - stamp_ns_from_text(ago[1]) * _UNIT_S[ago[2]]
        if re.fullmatch(r"[\d.]+", text):
            return stamp_ns_from_text(text)
        if re.fullmatch(r"\d{1,2}:\d\d(:\d\d)?", text):
            day = datetime.fromtimestamp(newest_ns // 10**9)
            moment = datetime.combine(
                day, time.fromisoformat(text.rjust(8 if text[5:] else 5, "0"))
            )
        else:
            moment = datetime.fromisoformat(text)
        return round(moment.timestamp() * 1e6) * 1000
    except (ValueError, OverflowError) as error:
        raise StoreError(f"time '{text[:40]}': expected {EXAMPLES}") from error


# --- Writes a store, and asks it.

MESSAGES_FILE, DATABASE_FILE = "messages.jsonl", "graph.lbug"
# Of the files beside it.
_OF_DATABASE = (".wal", ".shadow", ".tmp", ".writing", ".checkpoint")
# Messages that go to the database at a time when it is made anew.
_MESSAGES_AT_A_TIME = 500


class Store:
    """A graph and its history, to ask.

    Args:
        folder: of the store.

    Raises:
        StoreError: if there is no store.
    """

    def __init__(self, folder: Path) -> None:
        if not (folder / MESSAGES_FILE).is_file():
            raise StoreError(
                f"no store in {folder}: make one with `deworldsg store add {folder} GRAPH`"
            )
        self._path, self._messages = folder / DATABASE_FILE, folder / MESSAGES_FILE

    @contextmanager
    def opened(self) -> Iterator[Database]:
        """Open the database, for many questions; writers wait meanwhile.

        It is completed first, or made anew if it is damaged, unless a writer is at work.

        Raises:
            StoreError: if it cannot be opened.
        """
        for attempt in range(2):
            with ExitStack() as stack:
                try:
                    database = stack.enter_context(opened(self._path, read_only=True))
                    is_complete = self._is_complete(database)
                except RuntimeError as error:
                    if attempt:
                        raise StoreError(f"{self._path} cannot be read: {error}") from error
                    is_complete = False
                if attempt or is_complete:
                    with _of_database(self._path, "read"):
                        yield database
                    return
            # If a writer is at work, the database is a moment old.
            with suppress(BlockingIOError), StoreWriter(self._path.parent):
                pass

    def ask(self, cypher: str, parameters: Mapping[str, Any] | None = None) -> Rows:
        """Answer a question in Cypher; it cannot change the database, nor use other files.

        Each question has a process of its own, which takes most of a second to start.

        Args:
            cypher: with the tables of docs/store.md.
            parameters: values of its ``$names``.

        Raises:
            StoreError: if it cannot be answered.
        """
        question = checked_question(cypher)
        with self.opened():
            return answer_apart(self._path, question, parameters or {})

    def at(self, time_ns: int, label: str | None = None) -> list[Stay]:
        """Where objects were at a time, by label and id.

        Args:
            time_ns: on the clock of the graph's stamps.
            label: class; "table" means "dining table" too; None = all.
        """
        with self.opened() as database:
            known = [row[0] for row in database.run("MATCH (s:Stay) RETURN DISTINCT s.label").rows]
            labels = [name for name in known if label is None or is_class(label, name)]
            found = database.run(
                "MATCH (s:Stay) WHERE s.since_ns <= $time AND s.until_ns > $time AND "
                "list_contains($labels, s.label) RETURN s.key, s.id, s.label, s.x, s.y, s.z, "
                "s.size_x, s.size_y, s.size_z, s.since_ns, s.until_ns ORDER BY s.label, s.id",
                {"time": time_ns, "labels": labels or [""]},
            )
        return [stay_of(row) for row in found.rows]

    def why_nothing(self, time_ns: int, label: str | None = None) -> str:
        """Why `at` has no answer: the history begins later, or nothing was called so."""
        with self.opened() as database:
            found = database.run(
                "MATCH (s:Stay) RETURN s.label, min(s.since_ns), max(s.until_ns) ORDER BY s.label"
            ).rows
        if not found:
            return "the store has no objects"
        begin_ns = min(row[1] for row in found)
        if time_ns < begin_ns:
            return f"the history begins at {clock_text(begin_ns)}, with the first graph added"
        asked = [row for row in found if label is None or is_class(label, row[0])]
        if not asked:
            return f"no {label} was ever there; there were {', '.join(row[0] for row in found)}"
        begin_ns, end_ns = min(row[1] for row in asked), max(row[2] for row in asked)
        what = label or "object"
        if time_ns < begin_ns:
            return f"the first {what} came at {clock_text(begin_ns)}"
        if time_ns >= end_ns:
            return f"the last {what} was gone at {clock_text(end_ns)}"
        return f"no {what} was there then, but before and after"

    @property
    def head(self) -> Head:
        """Content of the database."""
        with self.opened() as database:
            return database.head() or Head()

    def _is_complete(self, database: Database) -> bool:
        head = database.head()
        return head is not None and head.position == self._messages.stat().st_size


@contextmanager
def _of_database(path: Path, done: str) -> Iterator[None]:
    """Errors of the database, as of a full disk or a damaged file, in one sentence."""
    try:
        yield
    except RuntimeError as error:
        problem = (str(error).strip() or repr(error)).splitlines()[0]
        raise StoreError(
            f"{path} cannot be {done}: {problem}; {MESSAGES_FILE} has all messages: make room on "
            f"the disk if it is full, then `deworldsg store rebuild {path.parent}`"
        ) from error


class StoreWriter:
    """Adds to a store; use it in a `with` block. One process at a time can.

    A message is safe in the file of messages when `add` returns; `commit` brings the database up to
    date. If a writer is killed, the next one, or the next question, completes the database.

    Args:
        folder: of the store; it is made if it is missing.
        anew: whether the database is made anew from the messages.

    Raises:
        OSError: if it cannot be written, or another process writes it.
        StoreError: if a line of its messages is damaged, or lines are missing.
    """

    def __init__(self, folder: Path, *, anew: bool = False) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path, self._messages = folder / DATABASE_FILE, folder / MESSAGES_FILE
        self._lock = FileLock(self._messages)
        try:
            self._journal = Journal(self._messages)
            if anew:
                for _ in read_messages(self._messages):  # all of them, before the database goes
                    pass
                self._remove()
            self._load()
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> StoreWriter:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self.commit()
        finally:
            self._journal.close()
            self._lock.release()

    def add_file(self, path: Path) -> bool:
        """Add the graph of a file, or of the folder of a run; as `add`."""
        content = read_content(path)
        with paused_collector():
            return self._add(wire.decode(content, wire.SceneGraphMessage, MAX_GRAPH_BYTES), content)

    def add(self, message: GraphMessage) -> bool:
        """Add a whole graph, or the next update; False for one that the store has already.

        Raises:
            RefusedInput: ``lost_updates`` if updates before this one are missing: a whole graph has
                to be next. ``old_graph`` for a graph that is older than the newest one.
                ``wrong_frame``.
            OSError: if it cannot be written.
        """
        return self._add(message, wire.encode(message).encode())

    def commit(self) -> None:
        """Bring the database up to date."""
        if not self._batch:
            return
        self._journal.sync()
        with (
            _of_database(self._path, "written"),
            paused_collector(),
            opened(self._path, read_only=False) as database,
        ):
            self._write(database)

    def _remove(self) -> None:
        """Remove the files of the database, and no others beside them."""
        for path in self._path.parent.glob(f"{self._path.name}*"):
            rest = path.name.removeprefix(self._path.name)
            if not rest or rest.startswith(_OF_DATABASE):
                path.unlink()

    def _add(self, message: GraphMessage, content: bytes) -> bool:
        is_new = self._batch.follows(message)
        if is_new:
            self._journal.append(content)
            self._batch.add(message)
            self._batch.head.position = self._journal.size
        return is_new

    def _load(self) -> None:
        """Continue the database; what it lacks comes from the messages."""
        try:
            with opened(self._path, read_only=False) as database:
                if self._continue(database):
                    return
        except RuntimeError:
            pass  # it is damaged, or of another version of ladybug
        self._remove()
        with (
            _of_database(self._path, "written"),
            opened(self._path, read_only=False) as database,
        ):
            with database.transaction():
                database.make_tables()
            self._continue(database)

    def _continue(self, database: Database) -> bool:
        """Read the head and the stays, and catch up; False if it is no database of a store."""
        head = database.head()
        if head is None:
            return False
        if head.position > self._journal.size:
            raise StoreError(
                f"{self._messages} has {self._journal.size} bytes, and the database knows "
                f"{head.position}: it was cut; `deworldsg store rebuild {self._path.parent}` makes "
                "the database of what is left"
            )
        history = History(database.current_stays(), database.next_key())
        self._batch = Batch(head, history)
        with paused_collector():
            for number, (message, end) in enumerate(read_messages(self._messages, head.position)):
                if self._batch.follows(message):
                    self._batch.add(message)
                self._batch.head.position = end
                if number % _MESSAGES_AT_A_TIME == _MESSAGES_AT_A_TIME - 1:
                    self._write(database)
            self._write(database)
        return True

    def _write(self, database: Database) -> None:
        with database.transaction():
            self._batch.write(database)
        self._batch.clear()
