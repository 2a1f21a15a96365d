"""No world model: neighbour pairs without clips; edges have visual evidence only."""

from __future__ import annotations

from deworldsg_ros.config import RelationsConfig


def build(config: RelationsConfig, device: str) -> None:
    """No world model."""
    del config, device
