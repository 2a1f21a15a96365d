"""Times as people write them."""

from __future__ import annotations

import re
from datetime import datetime, time

from deworldsg_ros.scene.stamps import stamp_ns_from_text
from deworldsg_ros.store.errors import StoreError

_AGO = re.compile(r"([\d.]+)\s*(s|min|h|d)\s+ago")
_UNIT_S = {"s": 1, "min": 60, "h": 3600, "d": 86400}
EXAMPLES = "10:00, 2026-03-01T10:00, '5 min ago' or the seconds of a stamp"


def time_ns_from_text(text: str, newest_ns: int) -> int:
    """Nanoseconds of a time on the clock of the graph's stamps.

    Args:
        text: seconds of a stamp; a date and time of ISO 8601, of the machine's time zone if it has
            none; a time of the day on which the graph is newest; or ``5 min ago``, counted from the
            newest stamp.
        newest_ns: the newest stamp of the graph.

    Raises:
        StoreError: for other text.
    """
    text = text.strip()
    try:
        ago = _AGO.fullmatch(text)
        if ago is not None:
            return newest_ns - stamp_ns_from_text(ago[1]) * _UNIT_S[ago[2]]
        if re.fullmatch(r"[\d.]+", text):
            return stamp_ns_from_text(text)
        if re.fullmatch(r"\d{1,2}:\d\d(:\d\d)?", text):
            day = datetime.fromtimestamp(newest_ns // 10**9)
            moment = datetime.combine(
                day, time.fromisoformat(text.rjust(8 if text[5:] else 5, "0"))
            )
        else:
            moment = datetime.fromisoformat(text)
        return round(moment.timestamp() * 1e6) * 1000
    except (ValueError, OverflowError) as error:
        raise StoreError(f"time '{text[:40]}': expected {EXAMPLES}") from error
