"""What a replay tells the program that started it: a JSON line an event, on its standard output."""

from typing import Union

import msgspec


class Waiting(msgspec.Struct, tag=True, frozen=True):
    """Not everybody is there yet: what is missing, in words."""

    missing: list[str]


class Started(msgspec.Struct, tag=True, frozen=True):
    """Everybody is there; `frames` RGB images will be published."""

    frames: int


class Progress(msgspec.Struct, tag=True, frozen=True):
    """Frames published and answered so far; nodes in the graph."""

    published: int
    answered: int
    nodes: int


class Saved(msgspec.Struct, tag=True, frozen=True):
    """Whether the graph node saved its graph, and what it said."""

    success: bool
    message: str


class Finished(msgspec.Struct, tag=True, frozen=True):
    """The end: counts, what each node told in /diagnostics, what the recording had lost.

    `poses` are T_world_camera of the lifted frames, 16 values each, row by row.
    """

    published: int
    answered: int
    unanswered: int
    drained: bool
    diagnostics: dict[str, dict[str, str]]
    drops: dict[str, int]
    losses: list[str]
    poses: list[list[float]]


Event = Union[Waiting, Started, Progress, Saved, Finished]


def encode(event: Event) -> str:
    """One line, without its end."""
    return msgspec.json.encode(event).decode()


def decode(line: str) -> Event:
    """Event of a line; raises msgspec.MsgspecError for anything else."""
    return msgspec.json.decode(line, type=Event)
