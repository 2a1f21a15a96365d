"""The live page: what its server computes and sends, and how soon a browser shows it.

    python bench/live_page.py [--quick]

The graph is a part of `building.py` with 60 surface points an object; a frame changes 12 objects
and 60 relations (`store.py`). The room is the shipped recording in its own time.
"""

from __future__ import annotations

import argparse
import random
import shutil
import statistics
import sys
import time
import zlib
from contextlib import closing
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import msgspec

from bench.building import EDGES_PER_NODE, building
from bench.figures import Figure, MissingError, Setup
from bench.store import frames
from deworldsg_ros.config import Config
from deworldsg_ros.graph.floor_plan import floor_plan
from deworldsg_ros.graph.surface import Surface
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.posing import PoseChoice, posed_frames
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.view.live.camera import CameraView
from deworldsg_ros.view.live.server import PERIOD_S
from deworldsg_ros.view.live.sources import open_sink, show_recording
from deworldsg_ros.view.live.state import LiveState, PageView
from deworldsg_ros.wire import messages as wire

ROOT = Path(__file__).resolve().parents[1]
NODES, POINTS, ROUNDS = 1000, 60, 60
# Software rendering of WebGL.
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
LIMIT_S = 60.0


def with_surfaces(nodes: int) -> wire.SceneGraphMessage:
    """A part of a building whose objects have surface points."""
    message = building(nodes)
    rng = random.Random(0)
    with_points = [
        msgspec.structs.replace(
            node,
            surface_points_m=[
                [value + rng.gauss(0.0, 0.1) for value in node.mean_m] for _ in range(POINTS)
            ],
        )
        for node in message.nodes
    ]
    return msgspec.structs.replace(message, nodes=with_points)


def sent_bytes(messages: list[str | bytes], packer: zlib._Compress) -> int:
    """What goes over the wire: texts are packed as websockets does."""
    count = 0
    for message in messages:
        content = message.encode() if isinstance(message, str) else message
        count += len(packer.compress(content)) + len(packer.flush(zlib.Z_SYNC_FLUSH))
    return count


def packer() -> zlib._Compress:
    """The compression of websockets: a window of 4 kB."""
    return zlib.compressobj(wbits=-12, memLevel=5)


def computed(quick: bool) -> list[Figure]:
    """Milliseconds and bytes of the server, without a browser."""
    count = 100 if quick else NODES
    message = with_surfaces(count)
    state, page, packed = LiveState(), PageView(), packer()
    state.reset(message)
    start = time.perf_counter()
    first = state.news(page, 0.0)
    first_ms = 1e3 * (time.perf_counter() - start)
    first_mb = sent_bytes(first, packed) / 1e6
    times, sizes = [], []
    for number, update in enumerate(frames(message, 1, 10 if quick else ROUNDS), 1):
        state.apply(update)
        start = time.perf_counter()
        news = state.news(page, 0.1 * number)
        times.append(1e3 * (time.perf_counter() - start))
        sizes.append(sent_bytes(news, packed))
    note = (
        f"{count} objects, {count * EDGES_PER_NODE} relations, {POINTS} points each; by the clock"
    )
    return [
        Figure("page_first_message", first_ms, "ms", note=note),
        Figure("page_first_message_size", first_mb, "MB", note=note),
        Figure("page_update", statistics.median(times), "ms", note=note),
        Figure("page_update_size", statistics.median(sizes) / 1e3, "kB", note=note),
    ]


class Meter:
    """Takes the shipped recording as a viewer does, and counts what one page would get of it."""

    def __init__(self) -> None:
        self.state, self.page, self.packed = LiveState(), PageView(), packer()
        self.sent, self.last_ns, self.first_ns = 0, 0, 0

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply an update."""
        return self.state.apply(update)

    def look(self, view: CameraView) -> None:
        """Take a frame, and send what is news at its time."""
        self.state.look(view)
        self.first_ns = self.first_ns or view.stamp_ns
        if view.stamp_ns - self.last_ns >= PERIOD_S * 1e9:
            self.last_ns = view.stamp_ns
            self.sent += sent_bytes(self.state.news(self.page, view.stamp_ns / 1e9), self.packed)


def room(quick: bool) -> list[Figure]:
    """Megabits a second that a page gets while the camera of the shipped recording moves; and
    what the room costs those who make it: its surface, a view at a time, and the floor plan.
    """
    config, meter = Config(), Meter()
    pipeline = Pipeline(config)
    with closing(open_source(ROOT / "bags" / "demo_room", inputs=config.inputs)) as source:
        recording = Recording(source, config.inputs)
        images = posed_frames(recording, PoseChoice(), lambda refusal: None)
        for number, _ in enumerate(show_recording(meter, pipeline, images, lambda refusal: None)):  # type: ignore[arg-type]
            if quick and number > 20:
                break
    seconds = (meter.last_ns - meter.first_ns) / 1e9
    note = "the shipped recording in its own time, with images; packed as on the wire"
    assert pipeline.builder is not None
    space, surface, times = pipeline.builder.space, Surface(), list[float]()
    for view in space.views():
        start = time.perf_counter()
        surface.add(*view)
        times.append(1e3 * (time.perf_counter() - start))
    start = time.perf_counter()
    floor_plan(space, (0.0, 0.0, 1.0), 1.5, surface)
    plan_ms = 1e3 * (time.perf_counter() - start)
    of = f"of {len(space)} views, {len(surface)} points; by the clock"
    return [
        Figure("page_traffic", 8e-6 * meter.sent / seconds, "Mbit/s", target=1.5, note=note),
        Figure("room_view", statistics.median(times), "ms", note=f"a view is added, {of}"),
        Figure("room_plan", plan_ms, "ms", note=f"the floor plan {of}"),
    ]


def shown(quick: bool) -> list[Figure]:
    """Seconds until a browser that renders in software shows a graph, and its draw calls."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise MissingError("playwright: pip install playwright") from error
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise MissingError("chromium")
    count = 100 if quick else NODES
    message = with_surfaces(count)
    times: list[float] = []
    with (
        closing(open_sink("127.0.0.1", 0, "", foxglove=False)) as viewer,
        sync_playwright() as playwright,
        closing(playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))) as browser,
    ):
        viewer.reset(message)
        calls = 0
        for _ in range(1 if quick else 4):
            page = browser.new_page(viewport={"width": 1200, "height": 760})
            start = time.perf_counter()
            page.goto(viewer.url)
            while not page.evaluate("nodes.size > 0 && layers.faces.visible"):
                if time.perf_counter() - start > LIMIT_S:
                    raise MissingError(f"the page shows nothing within {LIMIT_S:g} s")
                page.wait_for_timeout(10)
            times.append(time.perf_counter() - start)
            calls = page.evaluate("renderer.render(scene, camera), renderer.info.render.calls")
            page.close()
    note = (
        f"{count} objects, Chromium with software rendering, by the clock; median of {len(times)}"
    )
    return [
        Figure("page_first_picture", statistics.median(times), "s", target=4.0, note=note),
        Figure("page_draw_calls", float(calls), "calls", target=60.0, note=note),
    ]


def figures(setup: Setup) -> list[Figure]:
    """All figures of the live page."""
    return [*computed(setup.quick), *room(setup.quick), *shown(setup.quick)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small graphs")
    for figure in figures(Setup(quick=parser.parse_args().quick)):
        print(msgspec.json.encode(figure).decode())
