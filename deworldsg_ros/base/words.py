"""Text for people and from people: counts, misspelt names, text of others, numbers, stamps."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from decimal import Decimal, InvalidOperation

# --- Stamps in text files: decimal seconds.

# A ROS time has 32-bit seconds.
MAX_STAMP_S = 2**31


def stamp_ns_from_text(text: str) -> int:
    """Nanoseconds of decimal seconds, exactly; ValueError unless it is a number below 2^31."""
    try:
        seconds = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(f"stamp '{text[:40]}': expected seconds") from error
    # Compared first: as an integer, 1e9999999 has ten million digits.
    if not (seconds.is_finite() and seconds.copy_abs() < MAX_STAMP_S):
        raise ValueError(f"stamp '{text[:40]}': expected seconds below 2^31")
    return int(seconds * 10**9)


# --- Text for people and from people: counts, misspelt names, text of others, numbers.

# Control characters act on a terminal, line separators and overrides of the direction forge what is
# printed, half of a surrogate pair cannot be written, and XML has no place for the last two.
_ACTING = re.compile(
    "[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)
# Of a whole number as text: ids have 63 bits.
_MAX_DIGITS = 19


def counted(count: int, noun: str) -> str:
    """A count with its noun: ``1 frame``, ``2 frames``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def visible(text: str) -> str:
    """Text of a file or message for one line, with escapes for its control characters.

    The escapes are those of JSON, so that a line of JSON stays one.
    """
    return _ACTING.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def visible_lines(text: str) -> str:
    """As `visible`, for text that may have several lines."""
    return "\n".join(map(visible, text.split("\n")))


def whole_number(text: str) -> int | None:
    """The number that ASCII digits write; None for other text, and for more than 19 digits.

    ``isdigit`` and ``int`` alone disagree on text such as "²".
    """
    is_number = text.isascii() and text.isdecimal() and len(text) <= _MAX_DIGITS
    return int(text) if is_number else None


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
