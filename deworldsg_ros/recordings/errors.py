"""Errors of recordings."""

from __future__ import annotations

from deworldsg_ros.scene.errors import DeWorldSGError


class RecordingError(DeWorldSGError):
    """A recording cannot be used; the text names the file, the problem and the expected content."""
