"""The live viewer in a headless browser. Pictures go to $DEWORLDSG_SCREENSHOTS, if it is set."""

from __future__ import annotations

import os
import time
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from support.browser import browser, opened_page
from support.view import make_edge, make_graph, make_node, make_room

pytest.importorskip("viser", reason="needs viser")
from deworldsg_ros.view.live.server import Viewer

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
# Software rendering on a busy machine takes seconds a frame.
LIMIT_MS = 120_000


@pytest.fixture(scope="module")
def chromium():
    with browser() as opened:
        yield opened


@contextmanager
def shown(chromium, graph, name, width=1200, height=760):
    """The page of a graph, its viewer, and a picture at the end."""
    with closing(Viewer("127.0.0.1", 8080, "the lens is covered")) as viewer:
        if graph is not None:
            viewer.reset(graph)
        with opened_page(chromium, viewer.url, width, height) as page:
            page.set_default_timeout(LIMIT_MS)
            page.wait_for_selector("canvas")
            yield page, viewer
            folder = os.environ.get("DEWORLDSG_SCREENSHOTS")
            if folder:
                time.sleep(40)  # glyphs of the labels come one after the other
                page.screenshot(path=Path(folder) / f"{name}.png", timeout=LIMIT_MS)


def cup_on_table():
    nodes = [
        make_node(1, "dining table", (0, 0, 0.4), np.diag([0.2, 0.1, 0.02])),
        make_node(2, "cup", (0, 0, 0.9), np.diag([0.01, 0.01, 0.01])),
    ]
    return make_graph(nodes, [make_edge(2, 1, "on"), make_edge(1, 2, "near")])


def test_updates_and_the_selected_object_reach_the_page(chromium):
    with shown(chromium, cup_on_table(), "room") as (page, viewer):
        page.get_by_text("2 objects, 2 relations").wait_for()
        viewer._select(1)
        page.get_by_text("dining table #1", exact=True).wait_for()
        viewer.reset(make_graph(cup_on_table().nodes, []))
        page.get_by_text("2 objects, 0 relations").wait_for()


def test_an_empty_graph_says_why(chromium):
    with shown(chromium, None, "empty") as (page, _):
        page.get_by_text("the lens is covered").wait_for()


@pytest.mark.parametrize("name", ["thousand", "phone"])
def test_many_objects_and_small_screens(chromium, name):
    size = (390, 780) if name == "phone" else (1200, 760)
    with shown(chromium, make_room(1000 if name == "thousand" else 37), name, *size) as (page, _):
        if name == "thousand":
            page.get_by_text("1000 objects").wait_for()


def test_filters_hide(chromium):
    with shown(chromium, cup_on_table(), "filters") as (page, _):
        page.get_by_text("shown: 2 and 1;").wait_for()  # near is hidden
        page.get_by_text("Filter").click()
        page.get_by_text("Predicates").click()
        page.get_by_label("near (1)").check()
        page.get_by_text("shown: 2 and 2;").wait_for()
        page.get_by_text("Classes").click()
        page.get_by_label("cup (1)").uncheck()
        page.get_by_text("shown: 1 and 0;").wait_for()
