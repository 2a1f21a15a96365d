"""What becomes of an exception in the thread of the page, which goes on."""

from __future__ import annotations

import logging
from collections.abc import Callable

OnError = Callable[[Exception], None]


class LogOnce:
    """Logs the first exception of each type: a step of the page may fail ten times a second."""

    def __init__(self) -> None:
        self._types: set[type[Exception]] = set()

    def __call__(self, error: Exception) -> None:
        """Log an exception with its traceback."""
        if type(error) not in self._types:
            self._types.add(type(error))
            logging.getLogger(__name__).error("the page goes on after an error", exc_info=error)
