"""The database of a store: its tables, what fills them, and which Cypher is a question."""

from __future__ import annotations

import fcntl
import os
import re
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from deworldsg_ros.base.files import check_regular
from deworldsg_ros.client.boxes import box_of
from deworldsg_ros.client.changes import MOVED_M, MOVED_PART
from deworldsg_ros.client.objects import Point, Room
from deworldsg_ros.scene.errors import StoreError
from deworldsg_ros.wire import messages as wire

# --- Where each object was, and what it was called: a row for each time in which neither changed.

# End of a time that has not ended.
STILL_NS = 2**63 - 1


@dataclass(slots=True)
class Stay:
    """An object at one place, under one label.

    Attributes:
        key: number of this stay in the store.
        node: id of the object.
        label: most probable class.
        position_m: centre of the box; the mean of the surface if there is no box. World frame.
        size_m: of the box along its axes, the third one is up; 0 without a box.
        since_ns, until_ns: from when until when; `STILL_NS` = it is still there.
    """

    key: int
    node: int
    label: str
    position_m: Point
    size_m: Point
    since_ns: int
    until_ns: int = STILL_NS

    @property
    def is_current(self) -> bool:
        """Whether it has not ended."""
        return self.until_ns == STILL_NS

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; times in seconds, None = not ended."""
        return {
            "id": self.node,
            "label": self.label,
            "position_m": [round(value, 3) for value in self.position_m],
            "size_m": [round(value, 3) for value in self.size_m],
            "since_s": self.since_ns / 1e9,
            "until_s": None if self.is_current else self.until_ns / 1e9,
        }

    def is_left(self, node: wire.NodeState) -> bool:
        """Whether an object has moved or changed its label, as `deworldsg diff` decides."""
        if node.named and node.label != self.label:
            return True
        center, size = box_of(node)
        least = max(MOVED_M, MOVED_PART * max(*size, *self.size_m))
        x, y, z = (a - b for a, b in zip(center, self.position_m))
        return x * x + y * y + z * z > least * least


class History:
    """The stays of all objects, and what changed since `take`.

    Args:
        current: the stays that have not ended.
        next_key: number of the next stay.
    """

    def __init__(self, current: Iterable[Stay] = (), next_key: int = 1) -> None:
        self.current = {stay.node: stay for stay in current}
        self._next_key = next_key
        self._begun: dict[int, Stay] = {}
        self._ended: dict[int, int] = {}

    def see(self, node: wire.NodeState, stamp_ns: int) -> None:
        """Note an object at a time; times never go back."""
        stay = self.current.get(node.id)
        if stay is not None:
            if not stay.is_left(node):
                return
            self.end(node.id, stamp_ns)
        stay = Stay(self._next_key, node.id, node.label, *box_of(node), stamp_ns)
        self._next_key += 1
        self.current[node.id] = self._begun[stay.key] = stay

    def end(self, node_id: int, stamp_ns: int) -> None:
        """Note that an object is gone."""
        stay = self.current.pop(node_id, None)
        if stay is None:
            return
        if stay.key not in self._begun:
            self._ended[stay.key] = stamp_ns
        elif stay.since_ns == stamp_ns:
            del self._begun[stay.key]
        else:
            stay.until_ns = stamp_ns

    def take(self) -> tuple[list[Stay], dict[int, int]]:
        """The stays that began since the last call, and the ends of older ones by key."""
        taken = list(self._begun.values()), self._ended
        self._begun, self._ended = {}, {}
        return taken


# --- Which Cypher is a question: reading only holds for the database, not for other files.

FIRST_WORDS = ("MATCH", "OPTIONAL", "WITH", "UNWIND", "RETURN")
# They read or write files, change settings of the database, or change what is in it.
REFUSED_WORDS = frozenset(
    (
        "ALTER",
        "ATTACH",
        "CALL",
        "COPY",
        "CREATE",
        "DROP",
        "EXPORT",
        "IMPORT",
        "INSTALL",
        "LOAD",
        "USE",
    )
)

# What is in quotes is no word of the language, and no comment.
_QUOTED = r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|`[^`]*`"""
_COMMENT = r"/\*.*?\*/|//[^\r\n]*"
_QUOTED_OR_COMMENT = re.compile(f"(?P<quoted>{_QUOTED})|{_COMMENT}", re.DOTALL)
# As ladybug reads it: "1LOAD" is a number and a word.
_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def checked_question(cypher: str) -> str:
    """A question without its comments; only this text was checked, so it has to be the one to ask.

    Raises:
        StoreError: it is no question, but a statement that may use files or change something.
    """
    question = _QUOTED_OR_COMMENT.sub(lambda found: found["quoted"] or " ", cypher)
    plain = _QUOTED_OR_COMMENT.sub(" ", question)
    words = [word.upper() for word in _WORD.findall(plain)]
    first = words[0] if words else ""
    if first not in FIRST_WORDS:
        raise _refusal(f"it begins with '{first}': expected {', '.join(FIRST_WORDS)}")
    refused = sorted(REFUSED_WORDS.intersection(words))
    if refused:
        raise _refusal(f"{refused[0]} is no part of a question; a name can be in backticks")
    if ";" in plain.rstrip().removesuffix(";"):
        raise _refusal("it has more than one statement: ask one at a time")
    return question


def _refusal(problem: str) -> StoreError:
    return StoreError(f"the question cannot be answered: {problem}")


# --- The database of a store: its tables, and the statements that fill them.
#
# Labels and names only ever enter a statement as parameters.

# Of the tables below. A database of another version is made anew from the messages.
VERSION = 2
# The database uses less memory if the graph is small.
BUFFER_BYTES = 1 << 30
# A question that takes longer is ended, and so is one with more rows.
QUESTION_LIMIT_S, MOST_ROWS = 60.0, 100_000
# Memory of a question, beside that of the open database.
QUESTION_BYTES = 2 << 30
# More rows are loaded at once. That also joins the log with the database: a third of a second.
MANY_ROWS = 1000
# A writer has the database for some milliseconds every other second, and for seconds to rebuild it.
WAIT_S = 10.0

_BOX = {"x": "DOUBLE", "y": "DOUBLE", "z": "DOUBLE"} | {
    name: "DOUBLE" for name in ("size_x", "size_y", "size_z")
}
_OBJECT = {"id": "INT64", "label": "STRING", "probability": "DOUBLE", **_BOX} | {
    name: "INT64" for name in ("observations", "first_seen_ns", "last_seen_ns")
}
_ENDS = {"subject": "INT64", "object": "INT64"}
_RELATION = {
    "predicate": "STRING",
    "probability": "DOUBLE",
    "provenance": "STRING",
    "observations": "INT64",
}
_ROOM = {"id": "INT64", "label": "STRING", "probability": "DOUBLE", "storey": "INT64"} | {
    name: "DOUBLE" for name in ("area_m2", "x", "y", "z")
}
_STAY = {"key": "INT64", "id": "INT64", "label": "STRING", **_BOX} | {
    name: "INT64" for name in ("since_ns", "until_ns")
}
_HEAD = {"key": "INT64", "version": "INT64", "position": "INT64", "stamp_ns": "INT64"} | {
    "frame_id": "STRING",
    "session": "STRING",
    "sequence": "INT64",
}

# Values of the columns of a table, in their order.
_Row = tuple[Any, ...]
# What stands for a string in a row.
_Name = Callable[[str], Any]
_Item = TypeVar("_Item", wire.NodeState, wire.EdgeState, Stay)


@dataclass
class Head:
    """Content of the database.

    Attributes:
        position: in the file of messages; all before it is in the database.
        stamp_ns: of the newest message.
        frame_id: the world frame; empty = no message yet.
        session: of the newest message; empty = of a file.
        sequence: number of the newest message in its session.
    """

    position: int = 0
    stamp_ns: int = 0
    frame_id: str = ""
    session: str = ""
    sequence: int = 0


@dataclass(frozen=True)
class Rows:
    """The answer to a question: names of the columns, and the rows."""

    columns: list[str]
    rows: list[list[Any]]


# Of ladybug: C++ exceptions, also those of a damaged file.
_ERRORS = (RuntimeError, ValueError, TypeError, OverflowError, MemoryError, IndexError)


@contextmanager
def _of_ladybug() -> Iterator[None]:
    """All errors of ladybug as RuntimeError."""
    try:
        yield
    except _ERRORS as error:
        raise RuntimeError(str(error).strip() or repr(error)) from error


class Database:
    """An open database; use it within `opened`."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection

    def run(self, cypher: str, parameters: Mapping[str, Any] | None = None) -> Rows:
        """Run a statement; raises RuntimeError of ladybug."""
        with _of_ladybug():
            result = self._connection.execute(cypher, dict(parameters or {}))
            with closing(result):
                return Rows(result.get_column_names(), result.get_all())

    def answer(self, question: str, parameters: Mapping[str, Any] | None = None) -> Rows:
        """Answer a question of at most `MOST_ROWS`.

        Raises:
            StoreError: if it has more, or cannot be answered.
        """
        try:
            result = self._connection.execute(question, dict(parameters or {}))
            with closing(result):
                if result.get_num_tuples() > MOST_ROWS:
                    raise _refusal(
                        f"it has {result.get_num_tuples()} rows; expected at most {MOST_ROWS}, as "
                        "with LIMIT"
                    )
                return Rows(result.get_column_names(), result.get_all())
        except _ERRORS as error:
            raise _refusal((str(error).strip() or repr(error)).splitlines()[0]) from error

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """All statements of the block, or none."""
        self.run("BEGIN TRANSACTION")
        try:
            yield
        except BaseException:
            with suppress(RuntimeError):  # a statement that failed has ended it
                self.run("ROLLBACK")
            raise
        self.run("COMMIT")

    def make_tables(self) -> None:
        """Make the tables of an empty database."""
        for name, columns in (("Stay", _STAY), ("Head", _HEAD)):
            self.run(f"CREATE NODE TABLE {name}({_typed(columns)}, PRIMARY KEY (key))")
        self.run("CREATE (:Head {key: 0, version: $version})", {"version": VERSION})
        self._make_graph_tables()
        self.write_head(Head())

    def head(self) -> Head | None:
        """Content of the database; None = nothing, or it is of another version."""
        names = [name for name in _HEAD if name != "key"]
        try:
            found = self.run("MATCH (h:Head) RETURN " + ", ".join(f"h.{name}" for name in names))
        except RuntimeError:
            return None
        version, *values = found.rows[0] if found.rows else [None]
        return Head(*values) if version == VERSION else None

    def write_head(self, head: Head) -> None:
        """Note what is in the database."""
        values = vars(head)
        changes = ", ".join(f"h.{name} = ${name}" for name in values)
        self.run(f"MATCH (h:Head) SET {changes}", values)

    def current_stays(self) -> list[Stay]:
        """The stays that have not ended."""
        columns = ", ".join(f"s.{name}" for name in _STAY)
        found = self.run(f"MATCH (s:Stay) WHERE s.until_ns = $e RETURN {columns}", {"e": STILL_NS})
        return [stay_of(row) for row in found.rows]

    def next_key(self) -> int:
        """Number of the next stay."""
        last = self.run("MATCH (s:Stay) RETURN max(s.key)").rows[0][0]
        return (last or 0) + 1

    def replace_graph(
        self, nodes: Mapping[int, wire.NodeState], edges: Iterable[wire.EdgeState]
    ) -> None:
        """Replace all objects and relations. A relation without both of its objects is left out."""
        for table in ("Relation", "Inside", "Doorway", "Object", "Room"):
            self.run(f"DROP TABLE {table}")
        self._make_graph_tables()
        self._copy("Object", _OBJECT, nodes.values(), _object_row)
        related = (edge for edge in edges if edge.subject in nodes and edge.object in nodes)
        self._copy("Relation", {**_ENDS, **_RELATION}, related, _edge_row)

    def replace_rooms(self, rooms: Iterable[Room]) -> None:
        """Replace all rooms, their doorways, and which objects are inside of them."""
        self.run("MATCH (r:Room) DETACH DELETE r")
        rooms = list(rooms)
        rows = [dict(zip(_ROOM, _room_row(room))) for room in rooms]
        self._each(_creation("Room", _ROOM), rows)
        self._each(
            "MATCH (o:Object {id: row.node}) WITH o, row MATCH (r:Room {id: row.room}) "
            "CREATE (o)-[:Inside {probability: row.share}]->(r)",
            [
                {"node": node_id, "room": room.id, "share": share}
                for room in rooms
                for node_id, share in room.objects.items()
            ],
        )
        self._each(
            "MATCH (a:Room {id: row.a}) WITH a, row MATCH (b:Room {id: row.b}) "
            "CREATE (a)-[:Doorway {width_m: row.width_m}]->(b)",
            [
                {"a": room.id, "b": door.to, "width_m": door.width_m}
                for room in rooms
                for door in room.doorways
            ],
        )

    def remove(self, nodes: Iterable[int], edges: Iterable[tuple[int, int]]) -> None:
        """Remove relations, and objects with theirs; those that are not there are no error."""
        for a, b in edges:
            cypher = "MATCH (:Object {id: $a})-[r:Relation]->(o:Object) WHERE o.id = $b DELETE r"
            self.run(cypher, {"a": a, "b": b})
        self._each("MATCH (o:Object {id: row.id}) DETACH DELETE o", [{"id": i} for i in nodes])

    def put(
        self,
        new: Sequence[wire.NodeState],
        changed: Sequence[wire.NodeState],
        edges: Sequence[wire.EdgeState],
    ) -> None:
        """Add or change objects and relations."""
        self._each(_creation("Object", _OBJECT), _dicts(_OBJECT, new, _object_row))
        changes = ", ".join(f"o.{name} = row.{name}" for name in _OBJECT if name != "id")
        cypher = f"MATCH (o:Object {{id: row.id}}) SET {changes}"
        self._each(cypher, _dicts(_OBJECT, changed, _object_row))
        changes = ", ".join(f"r.{name} = row.{name}" for name in _RELATION)
        # In this form, both ends are found by their key; `MATCH (a), (b)` would scan all objects.
        cypher = (
            "MATCH (a:Object {id: row.subject}) WITH a, row MATCH (b:Object {id: row.object}) "
            f"WITH a, b, row MERGE (a)-[r:Relation]->(b) SET {changes}"
        )
        self._each(cypher, _dicts((*_ENDS, *_RELATION), edges, _edge_row))

    def put_stays(self, begun: Sequence[Stay], ended: Mapping[int, int]) -> None:
        """Add stays, and end older ones by key."""
        if len(begun) > MANY_ROWS:
            self._copy("Stay", _STAY, begun, _stay_row)
        else:
            self._each(_creation("Stay", _STAY), _dicts(_STAY, begun, _stay_row))
        cypher = "MATCH (s:Stay {key: row.key}) SET s.until_ns = row.until_ns"
        self._each(cypher, [{"key": key, "until_ns": end} for key, end in ended.items()])

    def _make_graph_tables(self) -> None:
        self.run(f"CREATE NODE TABLE Object({_typed(_OBJECT)}, PRIMARY KEY (id))")
        self.run(f"CREATE REL TABLE Relation(FROM Object TO Object, {_typed(_RELATION)})")
        self.run(f"CREATE NODE TABLE Room({_typed(_ROOM)}, PRIMARY KEY (id))")
        self.run("CREATE REL TABLE Inside(FROM Object TO Room, probability DOUBLE)")
        self.run("CREATE REL TABLE Doorway(FROM Room TO Room, width_m DOUBLE)")

    def _each(self, cypher: str, rows: Sequence[Mapping[str, Any]]) -> None:
        if rows:
            self.run(f"UNWIND $rows AS row {cypher}", {"rows": rows})

    def _copy(
        self,
        table: str,
        columns: Mapping[str, str],
        items: Iterable[_Item],
        row: Callable[[_Item, _Name], _Row],
    ) -> None:
        """Load rows at once. Strings go as one list of parameters, and their numbers as a file."""
        names = _Numbers()
        number = names.__getitem__
        rows = [row(item, number) for item in items]
        if not rows:
            return
        # JSON of numbers without its brackets is CSV.
        content = msgspec.json.encode(rows)[2:-2].replace(b"],[", b"\n")
        typed = _typed({i: "INT64" if kind == "STRING" else kind for i, kind in columns.items()})
        found = ", ".join(
            f"list_extract($names, {name})" if kind == "STRING" else name
            for name, kind in columns.items()
        )
        with os.fdopen(os.memfd_create("rows"), "wb") as file:
            file.write(content)
            file.flush()
            self.run(
                f"COPY {table} FROM (LOAD WITH HEADERS ({typed}) FROM '/proc/self/fd/"
                f"{file.fileno()}' (HEADER=false, FILE_FORMAT='csv') RETURN {found})",
                {"names": list(names)},
            )


class _Numbers(dict[str, int]):
    """Numbers strings from 1 on, in the order in which they are asked for."""

    def __missing__(self, name: str) -> int:
        self[name] = number = len(self) + 1
        return number


@contextmanager
def opened(path: Path, *, read_only: bool) -> Iterator[Database]:
    """Open a database, which is made if it is missing.

    Several processes can read it at a time; or one writes it, and the others wait.

    Raises:
        StoreError: the extra is not installed, or another process does not end its work in time.
        OSError: for a file that is none, such as a pipe.
        RuntimeError: of ladybug, e.g. if the database is damaged; also if a writer was killed.
    """
    try:
        import ladybug
    except ImportError as error:
        raise StoreError(
            "the store needs the package ladybug: pip install 'deworldsg_ros[store]'"
        ) from error
    check_regular(path)
    with _access(path.with_suffix(".lock"), fcntl.LOCK_SH if read_only else fcntl.LOCK_EX):
        # After a kill, ladybug can restore a part of a transaction only.
        being_written = path.with_name(f"{path.name}.writing")
        if being_written.exists():
            raise RuntimeError("a writer was killed")
        if not read_only:
            being_written.touch()
        with _of_ladybug():
            database = ladybug.Database(path, buffer_pool_size=BUFFER_BYTES, read_only=read_only)
            connected = ladybug.Connection(database)
        with closing(database), closing(connected) as connection:
            if not read_only:
                # Changes stay in the log beside the database until there are many: joining them
                # takes a third of a second.
                connection.execute("CALL force_checkpoint_on_close=false")
            yield Database(connection)
        if not read_only:
            being_written.unlink()


def answer_apart(path: Path, question: str, parameters: Mapping[str, Any]) -> Rows:
    """Answer a question in a process of its own, within `QUESTION_LIMIT_S` and `QUESTION_BYTES`.

    Ladybug looks at its own limits in some of its operators only, and nested questions end it.

    Raises:
        StoreError: if it takes more, or cannot be answered.
    """
    try:
        asked = msgspec.msgpack.encode((str(path), question, dict(parameters)))
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise _refusal(f"a parameter is no plain value: {error}") from error
    ask = f"from {__name__} import answer_asked; answer_asked()"
    paths = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        ended = subprocess.run(
            [sys.executable, "-c", ask],
            input=asked,
            capture_output=True,
            timeout=QUESTION_LIMIT_S,
            env={**os.environ, **paths},
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise _refusal(f"it takes more than {QUESTION_LIMIT_S:g} s") from error
    if ended.returncode:
        raise _refusal(f"the database ended ({ended.returncode}): ask something simpler")
    answer = msgspec.msgpack.decode(ended.stdout, type=str | Rows)
    if isinstance(answer, str):
        raise StoreError(answer)
    return answer


def answer_asked() -> None:
    """The other side of `answer_apart`."""
    path, question, parameters = msgspec.msgpack.decode(sys.stdin.buffer.read())
    try:
        with opened(Path(path), read_only=True) as database:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            most = pages * resource.getpagesize() + QUESTION_BYTES
            hard = resource.getrlimit(resource.RLIMIT_AS)[1]  # a user may have set a smaller one
            most = most if hard == resource.RLIM_INFINITY else min(most, hard)
            resource.setrlimit(resource.RLIMIT_AS, (most, hard))
            found = database.answer(question, parameters)
        content = msgspec.msgpack.encode(found, enc_hook=str)
    except (StoreError, OSError, RuntimeError, MemoryError) as error:
        said = str(error) or "the question cannot be answered: it takes too much"
        content = msgspec.msgpack.encode(said)
    sys.stdout.buffer.write(content)


def stay_of(row: Sequence[Any]) -> Stay:
    """The stay of a row of the table, all columns in their order."""
    key, node, label, x, y, z, a, b, c, since_ns, until_ns = row
    return Stay(key, node, label, (x, y, z), (a, b, c), since_ns, until_ns)


def _object_row(node: wire.NodeState, name: _Name) -> _Row:
    center, size = box_of(node)
    share = next((item.probability for item in node.classes if item.label == node.label), 0.0)
    share = share if node.named else 1.0
    existence = node.existence if isinstance(node.existence, float) else 1.0
    first, last = wire.ns_from_stamp(node.first_seen), wire.ns_from_stamp(node.last_seen)
    return (
        node.id, name(node.label), share * existence, *center, *size, node.observations, first, last
    )  # fmt: skip


def _room_row(room: Room) -> _Row:
    return room.id, room.label, room.probability, room.storey, room.area_m2, *room.center_m


def _edge_row(edge: wire.EdgeState, name: _Name) -> _Row:
    return (
        edge.subject,
        edge.object,
        name(edge.predicate),
        edge.probability,
        name(edge.provenance),
        edge.observations,
    )


def _stay_row(stay: Stay, name: _Name) -> _Row:
    where = (*stay.position_m, *stay.size_m)
    return stay.key, stay.node, name(stay.label), *where, stay.since_ns, stay.until_ns


def _typed(columns: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {kind}" for name, kind in columns.items())


def _creation(table: str, columns: Iterable[str]) -> str:
    return f"CREATE (:{table} {{{', '.join(f'{name}: row.{name}' for name in columns)}}})"


def _dicts(
    names: Iterable[str], items: Iterable[_Item], row: Callable[[_Item, _Name], _Row]
) -> list[dict[str, Any]]:
    names = list(names)
    return [dict(zip(names, row(item, str))) for item in items]


@contextmanager
def _access(path: Path, kind: int) -> Iterator[None]:
    """Hold a lock beside the database; ladybug's own lets a reader open it beside a writer."""
    check_regular(path)
    with path.open("ab") as file:
        end_s = time.monotonic() + WAIT_S
        while True:
            try:
                fcntl.flock(file, kind | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() > end_s:
                    message = f"store {path.parent}: another process has used it for {WAIT_S:g} s"
                    raise StoreError(f"{message}; try again later") from error
                time.sleep(0.01)
        yield
