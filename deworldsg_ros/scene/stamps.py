"""Stamps in text files: decimal seconds."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation

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
