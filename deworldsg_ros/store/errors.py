"""Errors of the store."""

from __future__ import annotations

from deworldsg_ros.scene.errors import DeWorldSGError


class StoreError(DeWorldSGError):
    """A store that cannot be opened or written, or a question that it cannot answer."""
