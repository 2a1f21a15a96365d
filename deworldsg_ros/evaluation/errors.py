"""Errors of the evaluation."""

from __future__ import annotations

from deworldsg_ros.scene.errors import DeWorldSGError


class EvaluationError(DeWorldSGError):
    """Predictions or options cannot be used: the text says what was seen and what was wanted."""
