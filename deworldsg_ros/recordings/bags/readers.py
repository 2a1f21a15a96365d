"""The readers of rosbags, bounded: no small file of a bag runs for ever or fills the memory.

rosbags trusts its files. Here each file is checked when it is opened or read. Its name does not
matter, nor whether the folder or `metadata.yaml` names it.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Mapping
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from deworldsg_ros.recordings.bags.chunks import bound_decompression
from deworldsg_ros.recordings.bags.salvage_sqlite import open_database
from deworldsg_ros.recordings.errors import RecordingError

# rosbags keeps the chunks that overlap in time. Recorders write one after the other, of some MB.
MAX_BYTES_AT_ONCE = 1 << 30

bound_decompression()


class SqliteFile(Sqlite3Reader):
    """A .db3 file, if `open_database` takes it."""

    def __init__(self, path: Path) -> None:
        self._file = path
        # rosbags makes a URI of it: %2F, ? and # in a name would lead to another file.
        super().__init__(Path(path.resolve().as_uri().removeprefix("file://")))

    def open(self) -> None:
        """Open the file; errors also as `open_database`."""
        open_database(self._file).close()
        super().open()


class McapFile(McapReader):
    """An .mcap file, whose chunks are unpacked a few at a time."""

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Messages in order of time; RecordingError if too many chunks overlap in time."""
        ids = {connection.id for connection in connections}
        size = bytes_at_once(
            (chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size)
            for chunk in self.chunks
            if not ids.isdisjoint(chunk.channel_count)
        )
        if size > MAX_BYTES_AT_ONCE:
            raise RecordingError(
                f"recording {self.path}: its chunks overlap in time, and {size} bytes would be "
                f"unpacked at once: expected at most {MAX_BYTES_AT_ONCE}; sort it with `mcap sort`"
            )
        return super().messages(connections, start, stop)


def bytes_at_once(chunks: Iterable[tuple[int, int, int]]) -> int:
    """Largest sum of sizes of chunks (start time, end time, size) that have a time in common."""
    changes: list[tuple[int, bool, int]] = []
    for start, end, size in chunks:
        changes += [(start, False, size), (max(start, end), True, -size)]
    at_once = most = 0
    for _, _, change in sorted(changes):  # at one time, chunks begin before others end
        at_once += change
        most = max(most, at_once)
    return most


class _Folder(DirectoryReader):
    STORAGE_PLUGINS: Mapping[str, Any] = {"mcap": McapFile, "sqlite3": SqliteFile}


class BagReader(Reader):
    """rosbags' reader of a folder or a file, with the readers above."""

    STORAGE_PLUGINS: Mapping[str, Any] = {"dir": _Folder, ".mcap": McapFile, ".db3": SqliteFile}
