"""A source of messages by role: the common interface of bags and folders."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from deworldsg_ros.recordings.messages import Role, RoleMessage, encode


class RawRoleMessage(NamedTuple):
    """One serialized message of a recording.

    `stamp_ns` is the time in its header; `log_time_ns` is the time of recording, for the replay.
    """

    role: Role
    msgtype: str
    stamp_ns: int
    log_time_ns: int
    data: bytes


def serialize(item: RoleMessage, log_time_ns: int | None = None) -> RawRoleMessage:
    """A message as CDR bytes; without a time of recording, its stamp is used."""
    data = encode(item.message, item.msgtype)
    log_time_ns = item.stamp_ns if log_time_ns is None else log_time_ns
    return RawRoleMessage(item.role, item.msgtype, item.stamp_ns, log_time_ns, data)


@dataclass(frozen=True)
class UsedTopic:
    """Origin of the messages of a role: a topic of a bag, or files of a folder."""

    name: str
    msgtype: str
    count: int


class Source(Protocol):
    """A bag or a folder, open for reading.

    Attributes:
        name: of the bag or folder, for messages to the user.
        topics: origin of each role.
        frame_count: number of RGB images, an estimate of the frames.
        drops: frames and messages left out so far, by reason.
        losses: sentences about data that the recording has lost.
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
        """The same messages, serialized, for a replay."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...
