"""The live viewer in a headless browser: what is drawn, and what clicks and filters do.

Software rendering takes seconds a frame on a busy machine. So each test looks again until what it
expects is there.
"""

import io
import time
from contextlib import closing, contextmanager

import msgspec
import numpy as np
import pytest
from PIL import Image
from support.browser import browser, opened_page
from support.view import make_edge, make_graph, make_node, updates_of

from deworldsg_ros.view.colours import class_colours, to_rgb

pytest.importorskip("viser", reason="needs viser")
from deworldsg_ros.view.live.scene import camera_of
from deworldsg_ros.view.live.server import Viewer

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
LIMIT_S = 120.0
# Colours that look the same: lines are blended with what is behind them.
SAME = 30
COLOURS = class_colours(["dining table", "cup"])


@pytest.fixture(scope="module")
def chromium():
    with browser() as opened:
        yield opened


class Screen:
    """The page of a viewer."""

    def __init__(self, page, viewer):
        self.page, self.viewer = page, viewer

    def until(self, holds, what):
        """Wait until a condition holds."""
        end_s = time.monotonic() + LIMIT_S
        while not holds():
            assert time.monotonic() < end_s, what
            self.page.wait_for_timeout(200)

    def pixels(self):
        """The scene (H, W, 3), without the panel at its right."""
        shot = self.page.screenshot(timeout=1000 * LIMIT_S)
        image = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(float)
        return image[:, : int(self.camera.width)]

    @property
    def camera(self):
        (client,) = self.viewer._server.get_clients().values()
        return camera_of(client)

    def shows(self, label):
        """Whether a pixel has the colour of a class."""
        away = self.pixels() - 255 * np.array(to_rgb(COLOURS[label]))
        return np.abs(away).max(axis=2).min() < SAME

    def draws(self, *labels):
        """Wait until objects of just these classes are drawn."""
        self.until(lambda: set(filter(self.shows, COLOURS)) == set(labels), f"only {labels}")

    def says(self, text):
        """Wait until the panel has a text."""
        self.page.get_by_text(text).first.wait_for()

    def open(self, *folders):
        """Open folders of the panel."""
        for folder in folders:
            self.page.get_by_text(folder, exact=True).first.click()

    def click_at(self, point):
        """Click a point (3,) of the world."""
        (place,), _ = self.camera.project(np.array([point], float))
        self.page.mouse.click(*place.tolist())


@contextmanager
def shown(chromium, graph, width=900, height=600):
    """The page of a graph."""
    with closing(Viewer("127.0.0.1", 8380, "the lens is covered")) as viewer:
        if graph is not None:
            viewer.reset(graph)
        with opened_page(chromium, viewer.url, width, height) as page:
            page.set_default_timeout(1000 * LIMIT_S)
            page.wait_for_selector("canvas")
            yield Screen(page, viewer)


def cup_and_table():
    nodes = [
        make_node(1, "dining table", (0, 0, 0.4), np.diag([0.03, 0.03, 0.01])),
        make_node(2, "cup", (1.2, 0, 0.5), np.diag([0.02, 0.02, 0.03])),
    ]
    return make_graph(nodes, [make_edge(2, 1, "beside"), make_edge(1, 2, "near")])


def test_boxes_have_the_colours_of_their_classes_and_clicks_open_objects(chromium):
    with shown(chromium, cup_and_table()) as screen:
        screen.says("2 objects, 2 relations")
        screen.draws("dining table", "cup")
        for node in cup_and_table().nodes:
            heading = screen.page.get_by_text(f"{node.label} #{node.id}", exact=True)

            def opened(node=node, heading=heading):
                screen.click_at(node.mean_m)
                screen.page.wait_for_timeout(500)
                return heading.is_visible()

            screen.until(opened, f"a click opens {node.label}")
        screen.says("beside dining table #1")
        screen.page.get_by_role("button", name="Deselect").click()
        heading.wait_for(state="hidden")


def test_filters_take_objects_and_relations_out_of_the_drawing(chromium):
    graph = cup_and_table()
    graph.nodes[1] = msgspec.structs.replace(graph.nodes[1], existence=0.5)
    with shown(chromium, graph) as screen:
        screen.says("shown: 2 objects, 1 relation (near is hidden)")
        screen.open("Filter", "Predicates")
        screen.page.get_by_label("near (1)").check()
        screen.says("shown: 2 objects, 2 relations")
        screen.page.get_by_label("beside (1)").uncheck()
        screen.says("shown: 2 objects, 1 relation (beside is hidden)")
        screen.open("Predicates", "Classes")
        screen.page.get_by_label("dining table (1)").uncheck()
        screen.draws("cup")
        screen.page.get_by_label("dining table (1)").check()
        screen.draws("dining table", "cup")
        least, least_relation = screen.page.get_by_role("slider").all()[-2:]
        least.press("End")
        screen.draws()
        least.press("Home")
        screen.draws("dining table", "cup")
        least_relation.press("End")
        screen.says("shown: 2 objects, 0 relations")


def test_updates_are_drawn_and_the_slider_shows_an_older_graph(chromium):
    whole = msgspec.structs.replace(cup_and_table(), sequence=2)
    first = make_graph(whole.nodes[:1])
    with shown(chromium, first) as screen:
        screen.draws("dining table")
        assert screen.viewer.apply(*updates_of([first, whole]))
        screen.draws("dining table", "cup")
        screen.page.get_by_role("slider").first.press("Home")
        screen.says("1 object, 0 relations")
        screen.draws("dining table")
        screen.page.get_by_role("button", name="Back to the newest").click()
        screen.draws("dining table", "cup")


def test_everything_is_in_view_in_a_dark_page_and_on_a_phone(chromium):
    with shown(chromium, cup_and_table(), 390, 780) as screen:
        screen.draws("dining table", "cup")
        assert screen.page.evaluate("document.documentElement.scrollWidth") <= 390
        panel = screen.page.get_by_text("2 objects, 2 relations").bounding_box()
        lowest = [node.mean_m for node in cup_and_table().nodes]
        places, _ = screen.camera.project(np.array(lowest))
        assert (places[:, 1] < panel["y"]).all(), "the panel covers the objects"
    with shown(chromium, cup_and_table()) as screen:
        screen.draws("dining table", "cup")
        screen.open("Show")
        screen.page.get_by_label("Dark", exact=True).check()
        screen.until(lambda: np.median(screen.pixels()) < 60, "the background is dark")
