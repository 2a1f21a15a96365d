"""The embedded world model: it judges the fused geometry of pairs in the graph (`PairTable`)."""

from __future__ import annotations

from deworldsg_ros.config import RelationsConfig


def build(config: RelationsConfig, device: str) -> None:
    """No model of clips: it needs no images."""
    del config, device
