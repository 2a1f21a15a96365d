"""Serialized messages of a rosbag2 bag: a folder with metadata.yaml, or one .mcap or .db3 file.

rosbags reads an intact bag. If it fails (recording killed, disk full, file truncated), a salvage
reader reads the intact part, and `losses` states in words that data was lost.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import Connection
from rosbags.rosbag2 import ReaderError

from deworldsg_ros.files import confined, read_regular
from deworldsg_ros.parsing import check_yaml
from deworldsg_ros.recordings.bags.chunks import ZSTD_MAGIC, decompress_message
from deworldsg_ros.recordings.bags.readers import BagReader
from deworldsg_ros.recordings.bags.salvage_mcap import salvage_mcap
from deworldsg_ros.recordings.bags.salvage_sqlite import salvage_sqlite
from deworldsg_ros.recordings.errors import RecordingError

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
