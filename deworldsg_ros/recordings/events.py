"""Events that a replay reports to the program that started it: one JSON line each, on stdout."""

from typing import Union

import msgspec


class Waiting(msgspec.Struct, tag=True, frozen=True):
    """The replay waits for the nodes: the missing ones, in words."""

    missing: list[str]


class Started(msgspec.Struct, tag=True, frozen=True):
    """All nodes are ready; `frames` RGB images will be published."""

    frames: int


class Progress(msgspec.Struct, tag=True, frozen=True):
    """Frames published and processed so far, and nodes in the graph."""

    published: int
    processed: int
    nodes: int


class Saved(msgspec.Struct, tag=True, frozen=True):
    """Reply of the graph node to the request to save its graph."""

    success: bool
    message: str


class Finished(msgspec.Struct, tag=True, frozen=True):
    """The end: counts, the /diagnostics of each node, drops and losses of the recording.

    `poses` are T_world_camera of the lifted frames, 16 values each, row by row.
    """

    published: int
    processed: int
    without_result: int
    drained: bool
    diagnostics: dict[str, dict[str, str]]
    drops: dict[str, int]
    losses: list[str]
    poses: list[list[float]]


Event = Union[Waiting, Started, Progress, Saved, Finished]


def encode(event: Event) -> str:
    """One line, without a line break."""
    return msgspec.json.encode(event).decode()


def decode(line: str) -> Event:
    """Event of a line; raises msgspec.MsgspecError for any other line."""
    return msgspec.json.decode(line, type=Event)
