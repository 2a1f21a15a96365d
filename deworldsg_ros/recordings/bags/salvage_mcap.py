"""Read what is left of a damaged MCAP file: record by record, without its index.

The layout is that of the MCAP specification: every record is an opcode, a length and a content;
messages may lie inside chunks, which are compressed as a whole.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
OPCODES = range(0x01, 0x10)

Message = tuple[str, str, int, bytes]


class _Tables:
    """Schemas and channels met so far."""

    def __init__(self) -> None:
        self.schemas: dict[int, str] = {}
        self.channels: dict[int, tuple[str, str]] = {}

    def take(self, opcode: int, content: bytes) -> Message | None:
        """Learn from a schema or channel; give a message as topic, type, time and data."""
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
    """Give (topic, type, log time in nanoseconds, CDR) of each readable message in file order.

    Args:
        path: the file.
        note: is told, in a sentence, of each loss.
    """
    tables = _Tables()
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(8) != MAGIC:
            note(f"{path.name} does not start like an MCAP file; nothing of it was read")
            return
        while True:
            start = file.tell()
            head = file.read(9)
            opcode, length = struct.unpack("<BQ", head) if len(head) == 9 else (0, 0)
            if opcode == DATA_END:
                return
            is_cut = length > size - start - 9
            if is_cut or opcode not in OPCODES:
                note(f"{path.name} ends or breaks at byte {start} of {size}; what follows is lost")
            if opcode not in OPCODES or (is_cut and opcode != CHUNK):
                return
            content = file.read(length)
            try:
                if opcode == CHUNK:
                    yield from _chunk_messages(content, tables, is_cut)
                elif (message := tables.take(opcode, content)) is not None:
                    yield message
            except Exception as error:  # struct, unicode, or whatever a decompressor raises
                note(f"{path.name}: the record at byte {start} is damaged and lost ({error})")
            if is_cut:
                return


def _chunk_messages(content: bytes, tables: _Tables, is_cut: bool) -> list[Message]:
    """Messages of a chunk; of one that the end of the file cuts, those before the cut."""
    _, _, raw_size, crc = struct.unpack_from("<QQQI", content)
    compression, offset = _string(content, 28)
    (packed_size,) = struct.unpack_from("<Q", content, offset)
    packed = content[offset + 8 : offset + 8 + packed_size]
    if is_cut and compression:
        return []
    raw = DECOMPRESSORS[compression](packed, raw_size)
    if not is_cut and (len(raw) != raw_size or (crc and zlib.crc32(raw) != crc)):
        raise ValueError("checksum or length of the chunk is wrong")
    messages: list[Message] = []
    position = 0
    while position + 9 <= len(raw):
        opcode, length = struct.unpack_from("<BQ", raw, position)
        if position + 9 + length > len(raw):
            break
        message = tables.take(opcode, raw[position + 9 : position + 9 + length])
        if message is not None:
            messages.append(message)
        position += 9 + length
    return sorted(messages, key=lambda item: item[2])


def _string(content: bytes, offset: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, offset)
    end = offset + 4 + length
    return content[offset + 4 : end].decode(), end
