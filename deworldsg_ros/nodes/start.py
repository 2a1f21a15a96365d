"""Start of a node's process: a signal during the imports ends it with exit code 0."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from typing import NoReturn


def start(name: str) -> NoReturn:
    """Run the node of a module of this package; end the process with its exit code."""
    for number in (signal.SIGINT, signal.SIGTERM):
        # Nothing is open yet. The node installs its own handlers.
        signal.signal(number, lambda *_: os._exit(0))
    sys.exit(importlib.import_module(f"{__package__}.{name}").main())
