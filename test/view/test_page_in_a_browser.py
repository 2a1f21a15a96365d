"""The page of a graph in a real browser: what is drawn, and what clicks, keys and filters do."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.browser import browser, opened_page, pixels_of, until
from support.merging import local_graph
from support.spaces import BLOCK, BLOCK_RGB, seen_room
from support.view import SAVED, box_at, make_edge, make_graph, make_node

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.frame_graph import DepthGrid
from deworldsg_ros.view import page
from deworldsg_ros.wire import messages as wire

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def chromium():
    with browser() as opened:
        yield opened


def url_of(graph: wire.SceneGraphMessage, folder: Path) -> str:
    path = folder / "graph.html"
    page.write(graph, path, camera_path_world=np.array([[0, 0, 1.0], [1, 0, 1.0]]))
    return path.as_uri()


def pixels(shown: Any) -> np.ndarray:
    """The 3D view (H, W, 3)."""
    shown.wait_for_timeout(300)
    return pixels_of(shown.locator("#view").screenshot())


def drawn(image: np.ndarray) -> float:
    """Share of pixels that are not the background."""
    return float((np.abs(image - image[-1, -1]).sum(axis=2) > 30).mean())


def visible_arrows(shown: Any) -> list[str]:
    return shown.evaluate("visibleEdges().map(edge => edge.predicate)")


def test_a_room_is_drawn_with_boxes_labels_and_relations_but_not_near(chromium, tmp_path):
    room = SceneGraph.load(SAVED)
    with opened_page(chromium, url_of(room.message, tmp_path)) as shown:
        assert drawn(pixels(shown)) > 0.05
        assert shown.locator("#title").inner_text().startswith("34 objects")
        labels = shown.locator("#labels span").all_inner_texts()
        assert len(labels) > 10 and any(text.startswith("dining table") for text in labels)
        predicates = set(visible_arrows(shown))
        assert "on" in predicates and "near" not in predicates
        shown.locator("#predicates label", has_text="near").click()
        assert "near" in visible_arrows(shown)


def test_a_click_shows_an_object_and_escape_lets_go(chromium, tmp_path):
    nodes = [make_node(1, "cup", (0, 0, 1)), make_node(2, "table", (1, 0, 0))]
    edges = [make_edge(1, 2, "on", 0.8), make_edge(2, 1, "under", 0.9)]
    with opened_page(chromium, url_of(make_graph(nodes, edges), tmp_path)) as shown:
        until(shown, "middles.length === 2", "two arrows")
        middles = shown.evaluate("middles.map(([, place]) => place.toArray())")
        assert np.linalg.norm(np.subtract(*middles)) > 0.1, "opposite edges are apart"
        shown.locator("#list li.object", has_text="cup 1").click()
        until(shown, "byId('card').innerText.includes('cup 1 is on table 2')", "a line")
        card = shown.locator("#card").inner_text()
        assert "cup 1 is on table 2" in card and "65" in card and "seen in" in card
        # A predicate that is hidden stays hidden, whatever is selected.
        shown.locator("#predicates label", has_text="on").click()
        assert visible_arrows(shown) == ["under"]
        until(shown, "!byId('card').innerText.includes('cup 1 is on table 2')", "no such line")
        shown.keyboard.press("Escape")
        shown.locator("#card", has_text="Esc").wait_for()
        place = shown.evaluate(
            "(() => { const v = new THREE.Vector3(...nodes.get(2).centre).project(camera);"
            "return [(v.x + 1) / 2 * view.clientWidth, (1 - v.y) / 2 * view.clientHeight]; })()"
        )
        shown.mouse.click(*place)
        shown.locator("#card h2", has_text="table 2").wait_for()


def test_the_sliders_hide_what_is_less_probable(chromium, tmp_path):
    existences = {1: 1.0, 2: 1.0, 3: 0.4}
    nodes = [make_node(i, "cup", (i, 0, 0), existence=e) for i, e in existences.items()]
    edges = [make_edge(1, 2, "on", 0.65), make_edge(2, 3, "on", 0.95)]
    with opened_page(chromium, url_of(make_graph(nodes, edges), tmp_path)) as shown:
        assert len(visible_arrows(shown)) == 1, "cup 3 may not be there"
        shown.locator("#least-relation").fill("30")
        assert len(visible_arrows(shown)) == 2
        shown.locator("#least-object").fill("50")
        assert len(visible_arrows(shown)) == 1
        shown.locator("#least-relation").fill("60")
        assert visible_arrows(shown) == []
        assert shown.evaluate("visibleNodes().length") == 2


@pytest.mark.parametrize(("width", "dark"), [(390, False), (1200, True)])
def test_a_phone_and_a_dark_screen(chromium, tmp_path, width, dark):
    url = url_of(SceneGraph.load(SAVED).message, tmp_path)
    with opened_page(chromium, url, width, dark=dark) as shown:
        image = pixels(shown)
        assert drawn(image) > 0.05
        assert (image[-1, -1].sum() < 200) == dark
        assert shown.evaluate("document.documentElement.scrollWidth") <= width
        side = shown.locator("#side").bounding_box()
        assert side["x"] + side["width"] <= width and side["height"] > 90


def test_an_empty_graph_says_why(chromium, tmp_path):
    with opened_page(chromium, url_of(make_graph(), tmp_path)) as shown:
        assert "Nothing was detected" in shown.locator("#empty").inner_text()
    hidden = [wire.HiddenNode("cup", [0, 0, 0], 0.2, 1, "seen in too few frames")] * 3
    with opened_page(chromium, url_of(make_graph(hidden=hidden), tmp_path)) as shown:
        assert "3: seen in too few frames" in shown.locator("#empty").inner_text()


def test_the_room_is_drawn_and_steps_back_behind_a_chosen_object(chromium, tmp_path):
    space = SeenSpace()
    camera = Intrinsics(480.0, 480.0, 320.0, 240.0, 640, 480)
    rgb = np.full((60, 80, 3), (180, 20, 20), np.uint8)
    grid = DepthGrid(np.full((60, 80), 2000, np.uint16), 8, camera, None, rgb)
    nothing = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 4))
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # it looks along +y
    space.note(local_graph(1, *nothing, depth_grid=grid, T_world_camera=T))
    path = tmp_path / "graph.html"
    page.write(make_graph([make_node(1, "cup", (0, 1.9, 0))]), path, space=space)
    with opened_page(chromium, path.as_uri()) as shown:
        until(shown, "layers.room.visible && room.places.length === 3 * 4800", "the room")
        shown.evaluate("camera.position.set(0, -1, 0.2), controls.target.set(0, 2, 0)")
        shown.evaluate("hiddenKinds.add('boxes'), controls.update(), draw('choice')")
        red = np.abs(pixels(shown) - (180, 20, 20)).max(axis=2) < 40
        assert red.mean() > 0.03
        shown.evaluate("camera.position.set(0, 5, 0.2), controls.update(), draw()")
        assert (np.abs(pixels(shown) - (180, 20, 20)).max(axis=2) < 40).mean() < 0.01  # from behind
        rows = shown.evaluate("layers.room.geometry.attributes.position.count")
        shown.evaluate(
            "addToRoom({ from: rows, gone: [0, 7], steps: '' }), draw('room')".replace(
                "rows", str(rows)
            )
        )
        until(shown, f"layers.room.geometry.attributes.position.count === {rows - 2}", "fewer")
        shown.evaluate("choose(1)")
        until(shown, "layers.room.material.opacity < 0.5", "it steps back")
        shown.locator("#switches label", has_text="room").click()
        until(shown, "!layers.room.visible", "it is hidden")


def test_an_object_is_cut_out_of_the_room_and_stands_out_when_chosen(chromium, tmp_path):
    path, (low, high) = tmp_path / "graph.html", np.array(BLOCK)
    box = box_at((low + high) / 2, high - low)
    nodes = [make_node(7, "box", box=box), make_node(8, "cup", (-1.5, 1.0, 0.5))]
    page.write(make_graph(nodes), path, space=seen_room())

    def reds(shown):
        """Share of the picture that is the block's, in its full colour."""
        return (np.abs(pixels(shown) - BLOCK_RGB).max(axis=2) < 40).mean()

    count = "layers.room.geometry.attributes.position.count"
    with opened_page(chromium, path.as_uri()) as shown:
        until(shown, f"layers.room.visible && {count} > 1000", "the room")
        rows = shown.evaluate(count)
        look = (
            "camera.position.set(-1.5, -0.2, 1.4), controls.target.set(0.8, 0, 0.4), "
            "controls.update(), draw('choice')"
        )
        shown.evaluate(f"hiddenKinds.add('boxes').add('labels'), {look}")
        before = reds(shown)
        assert before > 0.02
        shown.evaluate(f"choose(8), {look}")
        assert reds(shown) < 0.3 * before  # it steps back with the room
        shown.evaluate(f"choose(7), {look}")
        assert reds(shown) > 0.8 * before  # and stays as it is when it is the chosen one
        shown.locator("#card a", has_text="cut it out").click()
        until(shown, f"{count} < {rows} - 100", "a room without the block")
        assert reds(shown) < 0.1 * before
        shown.locator("#card a", has_text="put it back").click()
        until(shown, f"{count} === {rows}", "the whole room")
        shown.evaluate("choose(null)")
        shown.locator("#list li.class", has_text="box").locator("input").click()
        until(shown, f"{count} < {rows} - 100", "a room without boxes")


def test_names_are_text_whatever_they_contain(chromium, tmp_path):
    names = ["</script><script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "__proto__",
             "constructor", "&lt;", "%s"]  # fmt: skip
    nodes = [make_node(i, label, (i, 0, 0)) for i, label in enumerate(names, 1)]
    edges = [make_edge(1, i, label) for i, label in enumerate(names[1:], 2)]
    with opened_page(chromium, url_of(make_graph(nodes, edges), tmp_path)) as shown:
        shown.evaluate("choose(1)")
        shown.locator("#card h2", has_text=names[0]).wait_for()
        assert shown.locator("#card summary").count() == len(edges)
        assert len(shown.locator("#list li.object").all_inner_texts()) == len(names)
        assert (
            shown.evaluate("document.images.length + (hiddenClasses.size)") == 1
        )  # the hidden one


def test_rooms_have_outlines_names_and_their_objects(chromium, tmp_path):
    graph = make_graph([make_node(1, "cup", (1.0, 1.0, 0.5))])
    corners = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 3.0, 0.0], [0.0, 3.0, 0.0]]
    kinds, inside = [wire.Belief("kitchen", 0.6)], [wire.RoomObject(1, 0.9)]
    graph.rooms = [wire.RoomState(7, "kitchen", kinds, 0, corners, 12.0, [], inside)]
    with opened_page(chromium, url_of(graph, tmp_path)) as shown:
        shown.wait_for_timeout(300)
        labels = shown.locator("#labels .place").all_inner_texts()
        assert labels == ["kitchen (room 7)?"]  # of 60 %
        shown.evaluate("choose(1)")
        until(shown, "document.querySelector('#card dl') !== null", "the card")
        assert "kitchen (room 7)?, 90 %" in shown.locator("#card").inner_text().replace("\xa0", " ")
        with_rooms = drawn(pixels(shown))
        shown.locator("#switches label", has_text="outlines").click()
        until(shown, "document.querySelectorAll('#labels .place').length === 0", "no names")
        assert drawn(pixels(shown)) < with_rooms
