"""No world model: neighbour pairs are found, no clip is queued, edges are visual only."""

from __future__ import annotations

from deworldsg_ros.config import RelationsConfig


def build(config: RelationsConfig) -> None:
    """There is none."""
    del config
