"""Errors of the client."""

from __future__ import annotations

from deworldsg_ros.scene.errors import DeWorldSGError


class ClientError(DeWorldSGError):
    """A question that the graph cannot answer: an unknown id, a pattern that cannot be read."""


class NoService(ClientError):
    """No node with a graph offers this service."""
