"""A free endpoint for Zenoh."""

from __future__ import annotations

import socket

import pytest


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"
