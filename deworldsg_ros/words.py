"""Text for people: counts with their noun, and the known name that a misspelt one may mean."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def counted(count: int, noun: str) -> str:
    """A count with its noun: ``1 frame``, ``2 frames``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def suggestion(name: str, known: Iterable[str]) -> str:
    """`` (did you mean X?)`` with the known name that is nearest; empty if none is near.

    Args:
        name: as it was written; ``section.field`` or a part of it.
        known: all names.
    """
    known = list(known)
    by_field = {item.rpartition(".")[2]: item for item in known}
    field = name.rpartition(".")[2]
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.7)
    # The right field in the wrong section, or without one.
    fields = difflib.get_close_matches(field, by_field, n=1, cutoff=0.6)
    if fields and (field in by_field or not near):
        near = [by_field[fields[0]]]
    return f" (did you mean {near[0]}?)" if near else ""
