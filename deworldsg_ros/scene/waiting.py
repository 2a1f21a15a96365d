"""Work that waits: a call takes what waits longest, and more of it if much waits."""

from __future__ import annotations

from itertools import islice

# Work that waits is done after this many calls: messages lag by a second at 30 Hz.
MAX_CALLS = 32


def some_of(waiting: int, at_least: int) -> int:
    """How many of those that wait a call takes."""
    return max(at_least, waiting // MAX_CALLS)


def take_first(waiting: dict[int, None], at_most: int | None) -> list[int]:
    """Take the keys that a dictionary has had longest; None = all."""
    taken = list(islice(waiting, at_most))
    if len(taken) == len(waiting):
        waiting.clear()  # deleted keys would slow down the next search for the first ones
    else:
        for key in taken:
            del waiting[key]
    return taken
