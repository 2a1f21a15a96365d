"""Serialized messages of a rosbag2 bag, read within bounds; of a damaged one, its intact part."""

from __future__ import annotations

import contextlib
import os
import re
import sqlite3
import struct
import sys
import zlib
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, NamedTuple, cast

import lz4.frame
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, ReaderError, reader, storage_mcap
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from deworldsg_ros.base.files import check_yaml, confined, read_regular
from deworldsg_ros.scene.errors import RecordingError

# --- Decompression for bags, within bounds.
#
# rosbags hands the size that a chunk declares to its decompressors, and these ignore it; the size
# of a compressed message or file is not declared. 1 MB may unpack to gigabytes.
# `bound_decompression` replaces these decompressors.

# Recorders begin a new chunk after some MB. One message may be larger: a raw 8K image has 100 MB.
MAX_CHUNK_BYTES = 512 << 20
# Of a file that is compressed as a whole. Raw depth images take a tenth of their size.
MAX_FILE_RATIO = 100
# This much is read of any file: an almost empty database has a larger ratio.
MIN_FILE_BYTES = 64 << 20
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

# The zstd of Python 3.14, or its backport.
zstd: Any = cast(Any, storage_mcap).zstd


def decompress(compression: str, packed: bytes, size: int) -> bytes:
    """The content of a chunk; ValueError or an error of the decompressor if it is damaged."""
    return storage_mcap.DECOMPRESSORS[compression](packed, size)


def decompress_message(packed: bytes) -> bytes:
    """A message that is compressed by itself; errors as `decompress`."""
    decompressor = zstd.ZstdDecompressor()
    raw: bytes = decompressor.decompress(packed, max_length=MAX_CHUNK_BYTES + 1)
    if len(raw) > MAX_CHUNK_BYTES or not decompressor.eof:
        raise ValueError(f"a message is cut, or unpacks to more than {MAX_CHUNK_BYTES} bytes")
    return raw


class _File(zstd.ZstdFile):
    """A compressed file. It unpacks to `MAX_FILE_RATIO` times its size at most."""

    def __init__(self, file: BinaryIO, mode: str) -> None:
        super().__init__(file, mode)
        self._path = file.name
        packed = os.fstat(file.fileno()).st_size
        self._left = self._limit = max(MAX_FILE_RATIO * packed, MIN_FILE_BYTES)

    def read(self, size: int | None = -1) -> bytes:
        """The next bytes; RecordingError after too many."""
        data: bytes = super().read(size)
        self._left -= len(data)
        if self._left < 0:
            raise RecordingError(
                f"recording {self._path}: it unpacks to more than {self._limit} bytes; if you "
                "trust it, unpack it with `zstd -d`, and run `ros2 bag reindex` on the folder"
            )
        return data


def bound_decompression() -> None:
    """Let rosbags unpack no more than a chunk declares, and than the constants above."""
    storage_mcap.DECOMPRESSORS["lz4"] = partial(_bounded, lz4.frame.LZ4FrameDecompressor)
    storage_mcap.DECOMPRESSORS["zstd"] = partial(_bounded, zstd.ZstdDecompressor)
    # Of messages and of files: rosbags calls these two functions of the module.
    bounded = SimpleNamespace(decompress=decompress_message, open=_File)
    cast(Any, reader).zstd = bounded


def _bounded(make: Callable[[], Any], packed: bytes, size: int) -> bytes:
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes: expected at most {MAX_CHUNK_BYTES}")
    decompressor = make()
    # One byte more than declared shows that there is more.
    raw: bytes = decompressor.decompress(packed, max_length=size + 1)
    if len(raw) != size or not decompressor.eof:
        raise ValueError(f"a chunk unpacks to other than the {size} bytes that it declares")
    return raw


# --- Read the intact part of a damaged rosbag2 SQLite3 file: row by row, without its index.

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


# --- The readers of rosbags, bounded: no small file of a bag runs for ever or fills the memory.
#
# rosbags trusts its files. Here each file is checked when it is opened or read. Its name does not
# matter, nor whether the folder or `metadata.yaml` names it.

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


class _RecordsOf:
    """An open file that refuses to read more than `MAX_CHUNK_BYTES`, whatever a record claims."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.seek, self.tell, self.close = file.seek, file.tell, file.close

    def read(self, size: int = -1) -> bytes:
        """The next bytes; ReaderError for more than `MAX_CHUNK_BYTES`."""
        if size > MAX_CHUNK_BYTES:
            raise ReaderError(f"a record of {size} bytes: expected at most {MAX_CHUNK_BYTES}")
        return self._file.read(size)


class McapFile(McapReader):
    """An .mcap file, whose chunks are unpacked a few at a time."""

    def _open(self) -> None:
        self.bio = cast(BinaryIO, _RecordsOf(cast(BinaryIO, self.bio)))
        super()._open()

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


# --- Read the intact part of a damaged MCAP file: record by record, without its index.
#
# The MCAP specification defines the layout: each record is an opcode, a length and a content.
# Messages may be inside chunks; a chunk is compressed as a whole.

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
OPCODES = range(0x01, 0x10)
OPCODES_IN_CHUNKS = (SCHEMA, CHANNEL, MESSAGE)
# Opcode (1 byte) and length of the content (8 bytes), before each record.
HEAD_BYTES = 9


class _Record(NamedTuple):
    """One record of a file; `is_cut`: the end of the file cuts its content."""

    start: int
    opcode: int
    content: bytes
    is_cut: bool


class _Tables:
    """Schemas and channels read so far."""

    def __init__(self) -> None:
        self.schemas: dict[int, str] = {}
        self.channels: dict[int, tuple[str, str]] = {}

    def take(self, opcode: int, content: bytes) -> Message | None:
        """Keep a schema or a channel; return a message as topic, type, time and data."""
        if opcode == SCHEMA:
            (key,) = struct.unpack_from("<H", content)
            self.schemas[key] = _string(content, 2)[0]
        elif opcode == CHANNEL:
            key, schema = struct.unpack_from("<HH", content)
            self.channels[key] = (_string(content, 4)[0], self.schemas.get(schema, ""))
        elif opcode == MESSAGE:
            key, _, log_time_ns = struct.unpack_from("<HIQ", content)
            if key in self.channels:
                return (*self.channels[key], log_time_ns, content[22:])
        return None


def salvage_mcap(path: Path, note: Callable[[str], None]) -> Iterator[Message]:
    """Yield (topic, type, log time in nanoseconds, CDR) of each readable message in file order.

    Args:
        path: the file.
        note: called with a sentence for each loss.
    """
    tables = _Tables()
    with path.open("rb") as file:
        if file.read(8) != MAGIC:
            note(f"{path.name} does not start like an MCAP file; nothing of it was read")
            return
        for record in _records(file, path, note):
            try:
                yield from _messages(record, tables)
            except Exception as error:  # of struct, unicode or a decompressor
                note(
                    f"{path.name}: the record at byte {record.start} is damaged and lost ({error})"
                )


def _records(file: BinaryIO, path: Path, note: Callable[[str], None]) -> Iterator[_Record]:
    """The records of a file, up to its end or to the first byte that starts no record."""
    size = path.stat().st_size
    while True:
        start = file.tell()
        head = file.read(HEAD_BYTES)
        opcode, length = struct.unpack("<BQ", head) if len(head) == HEAD_BYTES else (0, 0)
        if opcode == DATA_END:
            return
        left = max(size - start - HEAD_BYTES, 0)
        is_cut = length > left
        if is_cut or opcode not in OPCODES:
            note(f"{path.name} ends or breaks at byte {start} of {size}; the rest is lost")
        # The messages at the beginning of a chunk that is cut can still be read.
        if opcode not in OPCODES or (is_cut and opcode != CHUNK):
            return
        if length > MAX_CHUNK_BYTES:
            note(
                f"{path.name}: the record at byte {start} has {length} bytes and is left out: "
                f"expected at most {MAX_CHUNK_BYTES}"
            )
            file.seek(length, os.SEEK_CUR)
            continue
        yield _Record(start, opcode, file.read(min(length, left)), is_cut)
        if is_cut:
            return


def _messages(record: _Record, tables: _Tables) -> list[Message]:
    """Messages of a record: of a chunk all, of a message itself, of others none."""
    if record.opcode == CHUNK:
        return _chunk_messages(record.content, tables, record.is_cut)
    message = tables.take(record.opcode, record.content)
    return [] if message is None else [message]


def _chunk_messages(content: bytes, tables: _Tables, is_cut: bool) -> list[Message]:
    """Messages of a chunk in order of time; of a chunk that is cut, those before the cut."""
    _, _, raw_size, crc = struct.unpack_from("<QQQI", content)
    compression, offset = _string(content, 28)
    (packed_size,) = struct.unpack_from("<Q", content, offset)
    packed = content[offset + 8 : offset + 8 + packed_size]
    if is_cut and compression:
        return []
    raw = decompress(compression, packed, raw_size)
    if not is_cut and (len(raw) != raw_size or (crc and zlib.crc32(raw) != crc)):
        raise ValueError("checksum or length of the chunk is wrong")
    messages: list[Message] = []
    position = 0
    while position + HEAD_BYTES <= len(raw):
        opcode, length = struct.unpack_from("<BQ", raw, position)
        position += HEAD_BYTES
        # Megabytes of zeros, packed to nothing, would be as many empty records.
        if opcode not in OPCODES_IN_CHUNKS or position + length > len(raw):
            break
        message = tables.take(opcode, raw[position : position + length])
        if message is not None:
            messages.append(message)
        position += length
    return sorted(messages, key=lambda item: item[2])


def _string(content: bytes, offset: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, offset)
    end = offset + 4 + length
    return content[offset + 4 : end].decode(), end


# --- Serialized messages of a rosbag2 bag: a folder with metadata.yaml, or one .mcap or .db3
# file.
#
# rosbags reads an intact bag. If it fails (recording killed, disk full, file truncated), a salvage
# reader reads the intact part, and `losses` states in words that data was lost.

METADATA = "metadata.yaml"
# A topic takes about 1 kB, with its quality of service.
MAX_METADATA_BYTES = 32_000_000
SALVAGERS: dict[str, Callable[..., Iterator[tuple[str, str, int, bytes]]]] = {
    ".mcap": salvage_mcap,
    ".db3": salvage_sqlite,
}


@dataclass(frozen=True, order=True)
class Topic:
    """A topic of a bag."""

    name: str
    msgtype: str
    count: int

    @property
    def key(self) -> tuple[str, str]:
        """Name and type."""
        return self.name, self.msgtype


class RawMessage(NamedTuple):
    """A serialized message of a bag; `log_time_ns` is its time of recording."""

    topic: str
    msgtype: str
    log_time_ns: int
    data: bytes


class RawBag:
    """One rosbag2 bag, open for reading.

    Attributes:
        path: of the bag.
        topics: its topics, sorted by name.
        losses: sentences about lost data; reading messages may add some.

    Raises:
        RecordingError: for a path that is no bag, or without a readable message.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.losses: list[str] = []
        self._reader: BagReader | None = None
        _check_links(path)
        try:
            _check_files(path)
            reader = BagReader(path)
            reader.open()
            topics = [_topic(connection) for connection in reader.connections]
        except FileNotFoundError:
            self._open_damaged(None if path.is_dir() else f"{path} does not exist")
        except RecordingError:
            raise
        except Exception as error:  # rosbags passes struct, yaml and index errors on
            self._open_damaged(_one_line(error))
        else:
            self._reader = reader
            self.topics = sorted(topics)

    def _open_damaged(self, cause: str | None) -> None:
        """Count the readable messages; `cause`: error of rosbags, None = no metadata.yaml."""
        if not self.path.exists():
            raise RecordingError(f"recording {self.path}: there is no such file or folder")
        if not self.files:
            raise RecordingError(
                f"recording {self.path}: there is no .mcap or .db3 file; expected a rosbag2 folder "
                "with its metadata.yaml, or one of these files"
            )
        if cause is None:
            self.losses.append("metadata.yaml is missing; the files were read without it")
        else:
            self.losses.append(f"the bag is damaged ({cause}); its intact part was read")
        counts: dict[tuple[str, str], int] = {}
        for topic, msgtype, _, _ in self._salvage(self.losses):
            counts[topic, msgtype] = counts.get((topic, msgtype), 0) + 1
        if not counts:
            raise RecordingError(
                f"recording {self.path}: no message could be read ({'; '.join(self.losses)})"
            )
        self.topics = sorted(Topic(*key, count) for key, count in counts.items())

    @property
    def files(self) -> list[Path]:
        """Storage files of the bag."""
        if self.path.is_file():
            return [self.path] if self.path.suffix in SALVAGERS else []
        return storage_files(self.path)

    def messages(self, topics: Collection[tuple[str, str]]) -> Iterator[RawMessage]:
        """Messages of the topics, (name, type), in the order in which they were recorded.

        Raises:
            RecordingError: for a file that would take too much memory.
        """
        keys = frozenset(topics)
        if self._reader is None:
            yield from (RawMessage(*item) for item in self._salvage([]) if item[:2] in keys)
            return
        connections = [c for c in self._reader.connections if (c.topic, c.msgtype) in keys]
        if not connections:
            return
        last_time_ns, topics_at_last_time = -1, set[tuple[str, str]]()
        try:
            for connection, time_ns, data in self._reader.messages(connections):
                if not (isinstance(time_ns, int) and isinstance(data, bytes)):
                    raise ReaderError(f"a message of {connection.topic} is no message")
                yield RawMessage(connection.topic, connection.msgtype, time_ns, data)
                if time_ns != last_time_ns:
                    last_time_ns, topics_at_last_time = time_ns, set()
                topics_at_last_time.add((connection.topic, connection.msgtype))
        except (GeneratorExit, RecordingError):
            raise
        except Exception as error:  # a damaged chunk: its decompressor raises any type
            self._note(f"the bag is damaged ({_one_line(error)}); its intact part was read")
            for item in self._salvage(self.losses):
                topic, time_ns = item[:2], item[2]
                known = time_ns < last_time_ns or (
                    time_ns == last_time_ns and topic in topics_at_last_time
                )
                if topic in keys and not known:
                    yield RawMessage(*item)

    def _salvage(self, losses: list[str]) -> Iterator[tuple[str, str, int, bytes]]:
        def note(text: str) -> None:
            if text not in losses:
                losses.append(text)

        for file in self.files:
            for topic, msgtype, time_ns, data in SALVAGERS[file.suffix](file, note):
                # CDR starts with a zero.
                if data.startswith(ZSTD_MAGIC):
                    try:
                        data = decompress_message(data)
                    except Exception as error:  # the decompressor raises any type
                        note(f"{file.name}: compressed messages are damaged and lost ({error})")
                        continue
                yield topic, msgtype, time_ns, data

    def _note(self, text: str) -> None:
        if text not in self.losses:
            self.losses.append(text)

    def close(self) -> None:
        """Close the files."""
        if self._reader is not None:
            # rosbags fails here on metadata with values of other types.
            with contextlib.suppress(AttributeError, TypeError):
                self._reader.close()
            self._reader = None


def _check_files(path: Path) -> None:
    """Refuse what rosbags would wait for, or could not end: pipes, devices, deep YAML."""
    for file in [path] if path.is_file() else path.glob("*"):
        if not (file.is_file() or file.is_dir()):
            raise RecordingError(
                f"recording {path}: {file.name} is a pipe or a device: expected a regular file"
            )
    if (path / METADATA).is_file():
        content = read_regular(path / METADATA, MAX_METADATA_BYTES)
        check_yaml(content)


def _topic(connection: Connection) -> Topic:
    """The topic of a connection, whose values metadata.yaml may give any type."""
    topic = Topic(connection.topic, connection.msgtype, connection.msgcount)
    if not (isinstance(topic.name, str) and isinstance(topic.msgtype, str)):
        raise ReaderError(f"topic {topic.name!r} of type {topic.msgtype!r}: expected names")
    if not (isinstance(topic.count, int) and 0 <= topic.count < 2**63):
        raise ReaderError(f"topic {topic.name} has {topic.count!r} messages: expected a number")
    return topic


def storage_files(folder: Path) -> list[Path]:
    """The .mcap or .db3 files of a bag folder; none if they are not parts of one bag.

    rosbag2 names the parts of a split bag NAME_0, NAME_1, …
    """
    found = sorted(
        (file for file in folder.iterdir() if file.suffix in SALVAGERS),
        # NAME_2 comes before NAME_10.
        key=lambda file: (len(file.name), file.name),
    )
    bags = {(re.sub(r"_\d+\Z", "", file.stem), file.suffix) for file in found}
    return found if len(bags) == 1 else []


def _check_links(folder: Path) -> None:
    """Raise RecordingError if a file of a bag is a link to another place."""
    if folder.is_dir():
        for file in folder.iterdir():
            try:
                confined(folder, file.name)
            except OSError as error:
                raise RecordingError(f"recording {file}: {error.strerror}") from error


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split()).rstrip(".")
    return text if isinstance(error, ReaderError) and text else f"{type(error).__name__}: {text}"
