"""Errors of recordings."""

from __future__ import annotations

from deworldsg_ros.scene.errors import DeWorldSGError


class RecordingError(DeWorldSGError):
    """A recording cannot be used: the text says what was looked for, where, and what was seen."""
