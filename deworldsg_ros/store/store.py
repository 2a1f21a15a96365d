"""Writes a store, and asks it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from deworldsg_ros.client.words import is_class
from deworldsg_ros.files import FileLock
from deworldsg_ros.parsing import paused_collector
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.graph_file import MAX_GRAPH_BYTES, read_content
from deworldsg_ros.store.batch import Batch
from deworldsg_ros.store.database import Database, Head, Rows, opened, stay_of
from deworldsg_ros.store.errors import StoreError
from deworldsg_ros.store.history import History, Stay
from deworldsg_ros.store.journal import GraphMessage, Journal, read_messages
from deworldsg_ros.store.question import checked_question

MESSAGES_FILE, DATABASE_FILE = "messages.jsonl", "graph.lbug"
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
                    yield database
                    return
            # If a writer is at work, the database is a moment old.
            with suppress(BlockingIOError), StoreWriter(self._path.parent):
                pass

    def ask(self, cypher: str, parameters: Mapping[str, Any] | None = None) -> Rows:
        """Answer a question in Cypher; it cannot change the database, nor use other files.

        Args:
            cypher: with the tables Object, Relation and Stay (docs/dev/store.md).
            parameters: values of its ``$names``.

        Raises:
            StoreError: if it cannot be answered.
        """
        question = checked_question(cypher)
        with self.opened() as database:
            try:
                return database.run(question, parameters)
            except RuntimeError as error:
                problem = str(error).splitlines()[0]
                raise StoreError(f"the question cannot be answered: {problem}") from error

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

    @property
    def head(self) -> Head:
        """What the database contains."""
        with self.opened() as database:
            return database.head() or Head()

    def _is_complete(self, database: Database) -> bool:
        head = database.head()
        return head is not None and head.position == self._messages.stat().st_size


class StoreWriter:
    """Adds to a store; use it in a `with` block. One process at a time can.

    A message is safe in the file of messages when `add` returns; `commit` brings the database up to
    date. If a writer is killed, the next one, or the next question, completes the database.

    Args:
        folder: of the store; it is made if it is missing.

    Raises:
        OSError: if it cannot be written, or another process writes it.
        StoreError: if a line of its messages is damaged.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path, self._messages = folder / DATABASE_FILE, folder / MESSAGES_FILE
        self._lock = FileLock(self._messages)
        try:
            self._journal = Journal(self._messages)
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
        with paused_collector(), opened(self._path, read_only=False) as database:
            self._write(database)

    def rebuild(self) -> None:
        """Make the database anew from the messages."""
        for path in self._path.parent.glob(f"{self._path.name}*"):
            path.unlink()
        self._load()

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
        for path in self._path.parent.glob(f"{self._path.name}*"):
            path.unlink()
        with opened(self._path, read_only=False) as database:
            with database.transaction():
                database.make_tables()
            self._continue(database)

    def _continue(self, database: Database) -> bool:
        """Read the head and the stays, and catch up; False if it is no database of a store."""
        head = database.head()
        if head is None or head.position > self._journal.size:
            return False
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
