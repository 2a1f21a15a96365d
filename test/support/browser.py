"""A headless Chromium for tests of pages; the first use installs it where it can."""

import io
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
from PIL import Image

# Software rendering of WebGL; no request to any host but the page's.
FLAGS = (
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
INSTALL_LIMIT_S = 300
LIMIT_S = 120.0


def chromium() -> str:
    """Path of Chromium; installs Debian's package as root, else skips the test."""
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None and os.geteuid() == 0 and shutil.which("apt-get"):
        for words in (["update"], ["install", "--yes", "--no-install-recommends", "chromium"]):
            subprocess.run(
                ["apt-get", "--quiet", *words],
                env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"},
                capture_output=True,
                timeout=INSTALL_LIMIT_S,
                check=False,
            )
        path = shutil.which("chromium")
    if path is None:
        pytest.skip("Chromium is not installed, and apt-get cannot install it here")
    return path


@contextmanager
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    path = chromium()
    with api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        try:
            yield opened
        finally:
            opened.close()


@contextmanager
def opened_page(
    of: Any, url: str, width: int = 1200, height: int = 760, *, dark: bool = False
) -> Iterator[Any]:
    """A page of a browser; errors of its scripts fail the test."""
    context = of.new_context(
        viewport={"width": width, "height": height}, color_scheme="dark" if dark else "light"
    )
    page = context.new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
    page.goto(url)
    try:
        yield page
        assert errors == []
    finally:
        context.close()


def pixels_of(shot: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def free_port() -> int:
    """A free port of this machine."""
    with closing(socket.create_server(("127.0.0.1", 0))) as holder:
        return int(holder.getsockname()[1])


def until(page: Any, script: str, what: str) -> None:
    """Wait until an expression of the page is true. The page's own rules forbid it to wait."""
    end_s = time.monotonic() + LIMIT_S
    while not page.evaluate(script):
        assert time.monotonic() < end_s, f"{what}: {script}"
        page.wait_for_timeout(50)
