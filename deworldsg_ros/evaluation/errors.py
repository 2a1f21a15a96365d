"""Errors of the evaluation."""

from __future__ import annotations

from deworldsg_ros.scene.errors import DeWorldSGError


class EvaluationError(DeWorldSGError):
    """Predictions or options cannot be used. The message states the value and what was expected."""
