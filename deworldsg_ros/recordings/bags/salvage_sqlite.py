"""Read the intact part of a damaged rosbag2 SQLite3 file: row by row, without its index."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

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
    database = sqlite3.connect(f"file:{path.resolve()}?immutable=1", uri=True)
    try:
        # Without this, SQLite refuses a file that is shorter than its header declares.
        database.execute("PRAGMA writable_schema = ON")
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
