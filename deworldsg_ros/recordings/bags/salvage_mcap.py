"""Read the intact part of a damaged MCAP file: record by record, without its index.

The MCAP specification defines the layout: each record is an opcode, a length and a content.
Messages may be inside chunks; a chunk is compressed as a whole.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from deworldsg_ros.recordings.bags.chunks import decompress

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
OPCODES = range(0x01, 0x10)
OPCODES_IN_CHUNKS = (SCHEMA, CHANNEL, MESSAGE)
# Opcode (1 byte) and length of the content (8 bytes), before each record.
HEAD_BYTES = 9

Message = tuple[str, str, int, bytes]


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
