"""A headless Chromium for tests of pages; the first use installs it where it can.

Software rendering takes seconds a frame on a busy machine. So `Screen` looks again until what is
expected is there.
"""

import io
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deworldsg_ros.view.colours import class_colours, to_rgb

# Software rendering of WebGL; no request to any host but the page's.
FLAGS = (
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
INSTALL_LIMIT_S = 300
LIMIT_S = 120.0
# Colours that look the same: lines are blended with what is behind them.
SAME = 30


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


class Screen:
    """The page of a live viewer, whose graph has the classes `labels`."""

    def __init__(self, page: Any, viewer: Any, labels: list[str]) -> None:
        self.page, self.viewer = page, viewer
        self._colours = class_colours(labels)

    def until(self, holds: Callable[[], bool], what: str) -> None:
        end_s = time.monotonic() + LIMIT_S
        while not holds():
            assert time.monotonic() < end_s, what
            self.page.wait_for_timeout(200)

    def pixels(self) -> np.ndarray:
        """The scene (H, W, 3), without the panel at its right."""
        shot = self.page.screenshot(timeout=1000 * LIMIT_S)
        return pixels_of(shot)[:, : int(self.camera.width)]

    @property
    def camera(self) -> Any:
        from deworldsg_ros.view.live.scene import camera_of

        (client,) = self.viewer._server.get_clients().values()
        return camera_of(client)

    def _shows(self, label: str) -> bool:
        away = self.pixels() - 255 * np.array(to_rgb(self._colours[label]))
        return bool(np.abs(away).max(axis=2).min() < SAME)

    def draws(self, *labels: str) -> None:
        """Wait until objects of just these classes are drawn, in their colours."""
        self.until(lambda: set(filter(self._shows, self._colours)) == set(labels), f"only {labels}")

    def says(self, text: str) -> None:
        self.page.get_by_text(text).first.wait_for()

    def open(self, *folders: str) -> None:
        for folder in folders:
            self.page.get_by_text(folder, exact=True).first.click()

    def click_at(self, point: Any) -> None:
        (place,), _ = self.camera.project(np.array([point], float))
        self.page.mouse.click(*place.tolist())


def free_port() -> int:
    """A free port of this machine."""
    with closing(socket.create_server(("127.0.0.1", 0))) as holder:
        return int(holder.getsockname()[1])


@contextmanager
def shown_viewer(
    of: Any, graph: Any, labels: list[str], width: int = 900, height: int = 600
) -> Iterator[Screen]:
    """The page of a live viewer of a graph with these classes."""
    from deworldsg_ros.view.live.server import Viewer

    with closing(Viewer("127.0.0.1", free_port(), "")) as viewer:
        viewer.reset(graph)
        with opened_page(of, viewer.url, width, height) as page:
            page.set_default_timeout(1000 * LIMIT_S)
            page.wait_for_selector("canvas")
            yield Screen(page, viewer, labels)
