"""What every recording is underneath: messages by role, in order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from deworldsg_ros.recordings.messages import Role, RoleMessage


class RawRoleMessage(NamedTuple):
    """One serialized message of a recording.

    `stamp_ns` is the time in its header, `log_time_ns` when it was recorded (for the pace).
    """

    role: Role
    msgtype: str
    stamp_ns: int
    log_time_ns: int
    data: bytes


@dataclass(frozen=True)
class UsedTopic:
    """Where the messages of a role come from: a topic of a bag, or files of a folder."""

    name: str
    msgtype: str
    count: int


class Source(Protocol):
    """A bag or a folder, open for reading.

    Attributes:
        name: what to call it.
        topics: where each role comes from.
        frame_count: number of RGB images, an estimate of the frames.
        drops: frames and messages left out while reading, by reason.
        losses: sentences on data that the recording has lost.
    """

    name: str
    topics: dict[Role, UsedTopic]
    frame_count: int
    drops: Counter[str]
    losses: list[str]

    @property
    def kind(self) -> str:
        """``rosbag2`` or the name of a data set."""
        ...

    def messages(self) -> Iterator[RoleMessage]:
        """Decoded messages in order of time."""
        ...

    def raw_messages(self) -> Iterator[RawRoleMessage]:
        """The same, serialized, for a replay."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...
