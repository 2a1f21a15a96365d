"""The errors of the package: bad configuration raises, bad data is refused with a reason."""

from __future__ import annotations


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
