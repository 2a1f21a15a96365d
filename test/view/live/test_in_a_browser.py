"""The live viewer in a headless browser: what is drawn, and what clicks and filters do."""

import msgspec
import numpy as np
import pytest
from support.browser import browser, shown_viewer
from support.view import make_edge, make_graph, make_node, updates_of

pytest.importorskip("viser", reason="needs viser")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
LABELS = ["dining table", "cup"]


@pytest.fixture(scope="module")
def chromium():
    with browser() as opened:
        yield opened


def cup_and_table():
    nodes = [
        make_node(1, "dining table", (0, 0, 0.4), np.diag([0.03, 0.03, 0.01])),
        make_node(2, "cup", (1.2, 0, 0.5), np.diag([0.02, 0.02, 0.03])),
    ]
    return make_graph(nodes, [make_edge(2, 1, "beside"), make_edge(1, 2, "near")])


def test_boxes_have_the_colours_of_their_classes_and_clicks_open_objects(chromium):
    with shown_viewer(chromium, cup_and_table(), LABELS) as screen:
        screen.says("2 objects, 2 relations")
        screen.draws(*LABELS)
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
    with shown_viewer(chromium, graph, LABELS) as screen:
        screen.says("shown: 2 objects, 1 relation (near is hidden)")
        screen.open("Filter", "Predicates")
        screen.page.get_by_label("near (1)").check()
        screen.says("shown: 2 objects, 2 relations")
        screen.page.get_by_label("beside (1)").uncheck()
        screen.says("shown: 2 objects, 1 relation (beside is hidden)")
        screen.open("Classes")
        screen.page.get_by_label("dining table (1)").uncheck()
        screen.draws("cup")
        screen.page.get_by_label("dining table (1)").check()
        screen.draws(*LABELS)
        least, least_relation = screen.page.get_by_role("slider").all()[-2:]
        least.press("End")
        screen.draws()
        least.press("Home")
        screen.draws(*LABELS)
        least_relation.press("End")
        screen.says("shown: 2 objects, 0 relations")


def test_updates_are_drawn_and_the_slider_shows_an_older_graph(chromium):
    whole = msgspec.structs.replace(cup_and_table(), sequence=2)
    first = make_graph(whole.nodes[:1])
    with shown_viewer(chromium, first, LABELS) as screen:
        screen.draws("dining table")
        assert screen.viewer.apply(*updates_of([first, whole]))
        screen.draws(*LABELS)
        screen.page.get_by_role("slider").first.press("Home")
        screen.says("1 object, 0 relations")
        screen.draws("dining table")
        screen.page.get_by_role("button", name="Back to the newest").click()
        screen.draws(*LABELS)


def test_everything_is_in_view_in_a_dark_page_and_on_a_phone(chromium):
    with shown_viewer(chromium, cup_and_table(), LABELS, 390, 780) as screen:
        screen.draws(*LABELS)
        assert screen.page.evaluate("document.documentElement.scrollWidth") <= 390
        panel = screen.page.get_by_text("2 objects, 2 relations").bounding_box()
        lowest = [node.mean_m for node in cup_and_table().nodes]
        places, _ = screen.camera.project(np.array(lowest))
        assert (places[:, 1] < panel["y"]).all(), "the panel covers the objects"
    with shown_viewer(chromium, cup_and_table(), LABELS) as screen:
        screen.draws(*LABELS)
        screen.open("Show")
        screen.page.get_by_label("Dark", exact=True).check()
        screen.until(lambda: np.median(screen.pixels()) < 60, "the background is dark")
