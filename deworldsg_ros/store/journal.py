"""The messages of a store: one JSON document a line, in their order; only ever appended to."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import msgspec

from deworldsg_ros.scene import wire
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.graph_file import MAX_GRAPH_BYTES
from deworldsg_ros.store.errors import StoreError

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
        self._file = path.open("ab")
        self._file.truncate(_end_of_lines(path))

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
