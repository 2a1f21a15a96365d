"""The live page in a headless browser: what changes, the past, two pages, a lost connection."""

import json
from contextlib import closing, contextmanager

import msgspec
import numpy as np
import pytest
from support.browser import browser, free_port, opened_page, pixels_of, until
from support.view import make_edge, make_graph, make_node, updates_of

from deworldsg_ros.view.live.camera import CameraView
from deworldsg_ros.view.live.server import Viewer

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def chromium():
    with browser() as opened:
        yield opened


def cup_and_table(sequence=1):
    nodes = [
        make_node(1, "dining table", (0, 0, 0.4), np.diag([0.03, 0.03, 0.01])),
        make_node(2, "cup", (1.2, 0, 0.5), np.diag([0.02, 0.02, 0.03])),
    ]
    edges = [make_edge(2, 1, "beside"), make_edge(1, 2, "near")]
    return make_graph(nodes, edges, sequence=sequence)


@contextmanager
def shown(chromium, graph, width=1200, height=760, port=None):
    """A viewer, and a page of it with this graph."""
    with closing(Viewer("127.0.0.1", port or free_port(), "the camera is covered")) as viewer:
        viewer.reset(graph)
        with opened_page(chromium, viewer.url, width, height) as page:
            has(page, len(graph.nodes))
            yield viewer, page


def has(page, count):
    until(page, f"nodes.size === {count}", f"{count} objects")


def labels(page):
    page.wait_for_timeout(500)
    return set(page.locator("#labels span").all_inner_texts())


def test_what_changes_is_drawn_and_a_choice_stays(chromium):
    first = make_graph(cup_and_table().nodes[:1])
    with shown(chromium, first) as (viewer, page):
        page.locator("#list li.object", has_text="dining table 1").click()
        assert viewer.apply(*updates_of([first, cup_and_table(2)]))
        has(page, 2)
        assert labels(page) >= {"dining table 1", "beside"}  # near the chosen object
        card = page.locator("#card")
        assert card.locator("h2").inner_text().startswith("dining table 1")
        relation = card.locator("summary", has_text="cup 2 is beside dining table 1")
        relation.click()
        card.get_by_text("holds with 80%").wait_for()
        assert viewer.apply(*updates_of([cup_and_table(2), make_graph([], sequence=3)]))
        has(page, 0)
        page.locator("#empty", has_text="the camera is covered").wait_for()


def test_time_goes_back_for_one_page_and_not_for_another(chromium):
    first = make_graph(cup_and_table().nodes[:1])
    with shown(chromium, first) as (viewer, one), opened_page(chromium, viewer.url) as two:
        assert viewer.apply(*updates_of([first, cup_and_table(2)]))
        has(one, 2), has(two, 2)
        one.locator("#moment").press("Home")
        has(one, 1)
        one.get_by_text("ago").wait_for()
        two.locator("#list li.object", has_text="cup 2").click()
        assert two.evaluate("[nodes.size, chosen]") == [2, 2]
        assert one.evaluate("chosen") is None
        one.locator("#newest").click()
        has(one, 2)


def test_filters_hide_classes_relations_and_what_is_not_sure(chromium):
    graph = cup_and_table()
    graph.nodes[1] = msgspec.structs.replace(graph.nodes[1], existence=0.5)
    with shown(chromium, graph) as (_, page):
        predicates = "visibleEdges().map(edge => edge.predicate)"
        assert page.evaluate(predicates) == []  # that the cup is beside it is below 50 %
        page.locator("#least-relation").fill("20")
        assert page.evaluate(predicates) == ["beside"]  # near is hidden at first
        assert "cup? 2" in labels(page)
        page.locator("#predicates label", has_text="near").click()
        assert page.evaluate(predicates) == ["beside", "near"]
        page.locator("#least-object").fill("60")
        assert page.evaluate(predicates) == [] and labels(page) == {"dining table 1"}
        page.locator("#least-object").fill("0")
        page.locator("#list li.class", has_text="dining table").locator("input").uncheck()
        assert labels(page) == {"cup? 2"}


def test_the_image_the_way_and_the_view_of_the_camera(chromium):
    with shown(chromium, cup_and_table()) as (viewer, page):
        for number in range(3):
            T = np.eye(4)
            T[:3, 3] = number, -2, 1
            T[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # it looks along +y
            viewer.look(CameraView(number, T, np.full((48, 64, 3), 90, np.uint8)))
            until(page, f"path.length === {number + 1} && eye.centre[0] === {number}", "a frame")
        until(page, "!byId('camera').hidden && byId('camera').naturalWidth === 64", "the image")
        page.locator("#switches label", has_text="follow").click()
        until(page, "Math.abs(camera.position.y + 3.2) < 0.1", "a view from behind the camera")
        page.locator("#switches label", has_text="camera").click()
        assert page.locator("#camera").is_hidden()


def test_a_page_comes_back_when_its_server_does(chromium):
    port = free_port()
    with closing(Viewer("127.0.0.1", port, "")) as viewer:
        viewer.reset(cup_and_table())
        path = viewer.guard._path
        context = chromium.new_context()
        page = context.new_page()
        page.goto(viewer.url)
        has(page, 2)
    page.get_by_text("connection is lost").wait_for()
    with closing(Viewer("127.0.0.1", port, "")) as viewer:
        viewer.guard._path = path  # as if it were the same one
        viewer.reset(make_graph(cup_and_table().nodes[:1]))
        has(page, 1)
        page.locator("#lost").wait_for(state="hidden")
    context.close()


@pytest.mark.parametrize(("width", "dark"), [(390, False), (1200, True)])
def test_a_phone_and_a_dark_screen(chromium, width, dark):
    with closing(Viewer("127.0.0.1", free_port(), "")) as viewer:
        viewer.reset(cup_and_table())
        with opened_page(chromium, viewer.url, width, 780, dark=dark) as page:
            has(page, 2)
            assert {"dining table 1", "cup 2"} <= labels(page)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            if width < 800:
                side = page.locator("#side").bounding_box()
                assert side["y"] > 0.75 * 780, "the panel leaves the scene visible"
                page.locator("header").click()
                page.locator("#search").wait_for()
            image = pixels_of(page.locator("#view").screenshot())
            assert (image[-1, -1].sum() < 200) == dark


def test_a_thousand_objects_are_a_few_draw_calls(chromium):
    rng = np.random.default_rng(0)
    places = rng.uniform((-10, -10, 0), (10, 10, 2), (1000, 3))
    names = ["cup", "bowl", "chair", "book"]
    points = rng.normal(size=(60, 3)) * 0.1
    nodes = [
        make_node(i + 1, names[i % 4], place, points=points + place)
        for i, place in enumerate(places)
    ]
    edges = [make_edge(i, i + 1, "on") for i in range(1, 1000)]
    with shown(chromium, make_graph(nodes, edges)) as (_, page):
        until(page, "clouds.size === 1000", "the surfaces")
        page.wait_for_timeout(1000)
        calls = page.evaluate("renderer.render(scene, camera), renderer.info.render.calls")
        assert 3 <= calls <= 60
        assert page.evaluate("visibleEdges().length") == 999
        assert json.loads(page.evaluate("JSON.stringify([...nodes.keys()].length)")) == 1000
