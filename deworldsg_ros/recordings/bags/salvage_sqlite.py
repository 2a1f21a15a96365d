"""Read the intact part of a damaged rosbag2 SQLite3 file: row by row, without its index."""

from __future__ import annotations

import re
import sqlite3
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from deworldsg_ros.recordings.bags.chunks import MAX_CHUNK_BYTES
from deworldsg_ros.recordings.errors import RecordingError

Message = tuple[str, str, int, bytes]

# The rows of a damaged page raise one by one. A page of 4 KiB has fewer rows: after this many in
# succession, the rest of the file is lost.
MAX_BROKEN_ROWS = 200


def salvage_sqlite(path: Path, note: Callable[[str], None]) -> Iterator[Message]:
    """Yield (topic, type, log time in nanoseconds, CDR) of each readable row in file order.

    Args:
        path: the file.
        note: called with a sentence for each loss.
    """
    try:
        database = open_database(path)
    except sqlite3.DatabaseError as error:
        note(f"{path.name} cannot be read as a database ({error}); nothing of it was read")
        return
    try:
        topics = {
            key: (name, msgtype)
            for key, name, msgtype in database.execute("SELECT id, name, type FROM topics")
            if isinstance(name, str) and isinstance(msgtype, str)
        }
        yield from _rows(database, topics, path, note)
    except sqlite3.DatabaseError as error:
        note(f"{path.name} cannot be read as a database ({error}); nothing of it was read")
    finally:
        database.close()


def open_database(path: Path) -> sqlite3.Connection:
    """Open a file for reading, if it stores all that it contains.

    Raises:
        RecordingError: it has a view, a trigger, a virtual table or a generated column. These
            compute rows and values: a query of 8 KB may never end.
        sqlite3.DatabaseError: it cannot be read.
    """
    database = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
    try:
        if sys.version_info >= (3, 11):
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_CHUNK_BYTES)
        # Without this, SQLite refuses a file that is shorter than its header declares.
        database.execute("PRAGMA writable_schema = ON")
        for name, sql in database.execute("SELECT name, sql FROM sqlite_master"):
            if not _is_stored(sql):
                raise RecordingError(
                    f"recording {path}: {repr(name)[:80]} is computed, by a view, a trigger, a "
                    "virtual table or a generated column: expected tables and indexes only"
                )
    except BaseException:
        database.close()
        raise
    return database


def _is_stored(sql: object) -> bool:
    """Whether the SQL of an item of the schema makes a plain table or an index.

    SQLite goes by the SQL, and not by the type beside it. Views and generated columns have an AS.
    """
    if sql is None:  # an index that SQLite made itself
        return True
    if not isinstance(sql, str) or re.search(r"\bAS\b", sql, re.IGNORECASE):
        return False
    return sql.startswith(("CREATE TABLE ", "CREATE INDEX ", "CREATE UNIQUE INDEX "))


def _rows(
    database: sqlite3.Connection,
    topics: dict[int, tuple[str, str]],
    path: Path,
    note: Callable[[str], None],
) -> Iterator[Message]:
    row_id = broken = lost = 0
    while broken < MAX_BROKEN_ROWS:
        try:
            for key, topic, time_ns, data in database.execute(
                "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id",
                (row_id,),
            ):
                if key <= row_id:
                    raise sqlite3.DatabaseError("rows are out of order")
                row_id, lost, broken = key, lost + broken, 0
                if topic in topics and isinstance(time_ns, int) and isinstance(data, bytes):
                    yield (*topics[topic], time_ns, data)
            break
        except sqlite3.DatabaseError:
            broken += 1
            row_id += 1
    if lost or broken:
        note(
            f"{path.name}: {lost} damaged messages were skipped"
            + (", and the rest of the file is lost" if broken else "")
        )
