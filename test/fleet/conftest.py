"""A free endpoint for Zenoh."""

import pytest
from support.browser import free_port


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port()}"
