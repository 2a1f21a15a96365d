"""The errors of the package: bad configuration raises, bad data is refused with a reason."""

from __future__ import annotations

# --- The errors of the package: bad configuration raises, bad data is refused with a reason.


class DeWorldSGError(Exception):
    """Base of every error that this package raises on purpose."""


class ConfigurationError(DeWorldSGError):
    """The configuration cannot be used; start-up is refused."""


class RefusedInput(DeWorldSGError):
    """A message or frame is refused; the node counts it under `reason` and continues.

    Attributes:
        reason: short snake_case name under which the refusal is counted, e.g. ``grid_mismatch``.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


# --- Errors of the client.


class ClientError(DeWorldSGError):
    """A question that the graph cannot answer: an unknown id, a pattern that cannot be read."""


class NoService(ClientError):
    """No node with a graph offers this service."""


# --- Errors of the evaluation.


class EvaluationError(DeWorldSGError):
    """Predictions or options cannot be used. The message states the value and what was expected."""


# --- Errors of recordings.


class RecordingError(DeWorldSGError):
    """A recording cannot be used; the text names the file, the problem and the expected content."""


# --- Errors of the store.


class StoreError(DeWorldSGError):
    """A store that cannot be opened or written, or a question that it cannot answer."""
