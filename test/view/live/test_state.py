"""What a page of the live viewer is told, without a network: what changed, the past, and words."""

import base64
import json

import numpy as np
import pytest
from msgspec.structs import replace
from support.merging import local_graph
from support.view import box_at, make_edge, make_graph, make_node, random_graphs, updates_of

from deworldsg_ros.client.objects import scene_object
from deworldsg_ros.graph.provenance import TrailChange
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import DepthGrid
from deworldsg_ros.view.live.camera import CameraView, Crop
from deworldsg_ros.view.live.history import BLOCK, History
from deworldsg_ros.view.live.state import (
    CLOUDS_PERIOD_S,
    LiveState,
    PageView,
    scene_of,
)
from deworldsg_ros.view.page import in_words
from deworldsg_ros.wire import messages as wire

UP = (0.0, 0.0, 1.0)


def node(node_id, label="cup", center=(0.0, 0.0, 0.0), **fields):
    box = box_at(center, (0.2, 0.4, 0.6))
    return make_node(node_id, label, center, **{"box": box, "existence": 0.95, **fields})


class Page:
    """A page, as page.js keeps it."""

    def __init__(self, state):
        self.state, self.view, self.now_s = state, PageView(), 0.0
        self.nodes, self.edges, self.clouds, self.head, self.path = {}, {}, {}, {}, []
        self.camera, self.photos, self.images, self.moments = None, {}, [], {}
        self.surface, self.gone = None, []

    def look(self, after_s=CLOUDS_PERIOD_S):
        """Take the news; the keys that changed."""
        self.now_s += after_s
        recipe = self.state.recipe(self.view)
        if recipe is not None:
            self.state.remember(self.view.moment, scene_of(*recipe))
        messages = self.state.news(self.view, self.now_s)
        self.images += [item for item in messages if isinstance(item, bytes)]
        texts = [json.loads(item) for item in messages if isinstance(item, str)]
        assert len(texts) <= 1
        message = texts[0] if texts else {}
        for node_id in message.get("removed", ()):
            del self.nodes[node_id]
            self.clouds.pop(node_id, None)
            self.photos.pop(node_id, None)
        for pair in message.get("removedEdges", ()):
            del self.edges[tuple(pair)]
        self.nodes |= {item["id"]: item for item in message.get("nodes", ())}
        self.edges |= {(e["subject"], e["object"]): e for e in message.get("edges", ())}
        self.clouds |= {item["id"]: item for item in message.get("clouds", ())}
        for node_id in message.get("removedClouds", ()):
            del self.clouds[node_id]
        for node_id in message.get("removedPhotos", ()):
            del self.photos[node_id]
        self.photos |= dict(message.get("photos", ()))
        self.moments = message.get("moments", self.moments)
        if "surface" in message:
            self.surface = message["surface"]
            self.gone.append(self.surface["gone"])
        self.head = message.get("head", self.head)
        self.camera = message.get("camera", self.camera)
        if "path" in message:
            self.path = self.path[: message["from"]] + message["path"]
        return set(message)


def shows(page, graph):
    assert set(page.nodes) == {item.id for item in graph.nodes}
    assert {i: item["label"] for i, item in page.nodes.items()} == {
        n.id: n.label for n in graph.nodes
    }
    assert set(page.edges) == {(edge.subject, edge.object) for edge in graph.edges}


def test_an_empty_graph_says_why():
    state = LiveState("the camera is covered")
    page = Page(state)
    page.look()
    assert page.head["why"] == "the camera is covered" and not page.nodes
    state.why_empty = "it is dark"
    assert page.look() == {"head"} and page.head["why"] == "it is dark"


@pytest.mark.parametrize("seed", range(4))
def test_pages_that_look_often_or_seldom_have_the_newest_graph(seed):
    graphs = random_graphs(seed, 40, ["cup", "bowl", "chair"], [0.0, 1.0, 2.0])
    state = LiveState()
    often, seldom = Page(state), Page(state)
    for number, (graph, update) in enumerate(zip(graphs[1:], updates_of(graphs))):
        assert state.apply(update)
        often.look()
        shows(often, graph)
        if number % 13 == 12:
            seldom.look()
            shows(seldom, graph)
    late = Page(state)
    late.look()
    shows(late, graphs[-1])
    assert often.nodes == late.nodes and often.edges == late.edges
    assert often.look() == set()  # nothing changed, nothing is sent


def test_only_what_changed_is_sent():
    nodes = [node(i, center=(i, 0, 0)) for i in range(1, 101)]
    state = LiveState()
    before = make_graph(nodes)
    state.reset(before)
    page = Page(state)
    page.look()
    moved = [*nodes[:-1], node(100, "bowl", center=(100, 1, 0))]
    assert state.apply(*updates_of([before, make_graph(moved, sequence=2)]))
    message = json.loads(state.news(page.view, page.now_s)[0])
    assert [item["id"] for item in message["nodes"]] == [100]
    assert set(message) == {"head", "moments", "nodes"}  # another colour


def test_each_page_goes_back_in_time_on_its_own():
    graphs = random_graphs(3, 30, ["cup", "bowl"], [0.0, 1.0, 2.0])
    state = LiveState()
    for update in updates_of(graphs):
        state.apply(update)
    now, then = Page(state), Page(state)
    now.look(), then.look()
    then.view.moment = 9
    then.look(), now.look()
    shows(then, graphs[10])
    shows(now, graphs[-1])
    assert then.moments["shown"] == 9 and now.moments["shown"] is None
    assert then.moments["last"] == 29
    then.view.moment = None
    then.look()
    shows(then, graphs[-1])
    assert then.nodes == now.nodes


def test_values_are_in_axes_with_up_as_z_and_follow_a_new_up():
    state = LiveState()
    item = node(1, center=(0.0, 2.0, 0.0), points=[(0.1, 2.0, 0.0)])
    state.reset(make_graph([item], up=[0.0, 1.0, 0.0]))
    page = Page(state)
    page.look()
    assert page.nodes[1]["centre"] == [0.0, 0.0, 2.0] and page.nodes[1]["position"] == [
        0.0,
        2.0,
        0.0,
    ]
    cloud = page.clouds[1]
    steps = np.frombuffer(base64.b64decode(cloud["mm"]), "<i2")
    np.testing.assert_allclose(np.array(cloud["from"]) + steps / 1000, (0.1, 0.0, 2.0), atol=1e-3)
    state.reset(make_graph([item], up=[0.0, 0.0, 1.0], sequence=2))
    page.look()
    assert page.nodes[1]["centre"] == [0.0, 2.0, 0.0]


def view_at(stamp_ns, x, **fields):
    T = np.eye(4)
    T[0, 3] = x
    return CameraView(stamp_ns, T, np.zeros((48, 64, 3), np.uint8), **fields)


def test_the_way_of_the_camera_its_place_and_its_image():
    state = LiveState()
    page = Page(state)
    for number in range(5):
        state.look(view_at(10**9 * number, number))
        page.look()
        assert page.camera["centre"] == [number, 0, 0] and len(page.path) == number + 1
    assert len(page.images) == 5 and page.images[0].startswith(b"\xff\xd8")
    state.look(view_at(5 * 10**9, 4.0))  # it stands still
    assert page.look() == {"camera"} and len(page.images) == 6
    page.view.wants_images = False
    state.look(view_at(6 * 10**9, 5.0))
    assert page.look() == {"camera", "path", "from"} and len(page.images) == 6


def test_a_long_way_is_made_shorter_and_a_page_gets_it_anew(monkeypatch):
    monkeypatch.setattr("deworldsg_ros.view.live.state.MOST_PLACES", 8)
    state = LiveState()
    page = Page(state)
    for number in range(30):
        state.look(view_at(number, number))
        page.look()
        assert len(page.path) <= 8 and page.path[0] == [0, 0, 0]
        assert page.path == sorted(page.path)


def test_what_was_hidden_by_a_look_back_comes_again():
    state = LiveState()
    points = [(0, 0, 0)]
    first, second = node(1, points=points), node(2, center=(1, 0, 0), points=points)
    graphs = [make_graph([first]), make_graph([first, second], sequence=2)]
    state.reset(graphs[0])
    page = Page(state)
    state.apply(*updates_of(graphs))
    page.look()
    assert set(page.clouds) == {1, 2}
    for moment in (0, None):
        page.view.moment = moment
        page.look(after_s=0.1)
    page.look()
    assert set(page.clouds) == set(page.nodes) == {1, 2}


def test_another_session_has_other_objects_under_the_same_ids():
    state = LiveState()
    state.reset(make_graph([node(1)], session="a"))
    state.crops._put(1, Crop(1.0, 5, b"jpeg"))
    state._points[1] = np.ones((3, 3), np.float32)
    page = Page(state)
    page.look()
    assert page.photos == {1: 5} and set(page.clouds) == {1}
    state.reset(make_graph([node(1, "sofa")], session="b"))
    page.look()
    assert page.photos == {} and page.clouds == {} and page.nodes[1]["label"] == "sofa"


def test_an_object_that_cannot_be_shown_is_left_out_and_the_others_are_not(caplog):
    state = LiveState()
    odd = node(2)
    odd = replace(odd, box=replace(odd.box, size_m=[float("nan")] * 3))
    turned = node(3)
    turned = replace(turned, box=replace(turned.box, orientation_xyzw=[0, 0, 0, 0.98995]))
    state.reset(make_graph([node(1), odd, turned]))
    page = Page(state)
    page.look()
    page.look()
    assert {1, 3} <= set(page.nodes)
    state.reset(make_graph([node(1)], sequence=2))
    page.look()
    assert set(page.nodes) == {1}


def grid_of(depth_m):
    camera = Intrinsics(480.0, 480.0, 320.0, 240.0, 640, 480)
    return DepthGrid(np.full((60, 80), round(1000 * depth_m), np.uint16), 8, camera)


def test_the_room_is_sent_once_and_what_went_is_told():
    state = LiveState()
    page, nothing = Page(state), (np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 4)))
    rgb = np.full((480, 640, 3), (200, 10, 10), np.uint8)

    def look(stamp_ns, x, depth_m):
        T = np.eye(4)
        T[0, 3] = x
        local = local_graph(stamp_ns, *nothing, depth_grid=grid_of(depth_m), T_world_camera=T)
        state.look(CameraView(stamp_ns, T, rgb, local=local))
        page.look()
        return page.surface

    first = look(1, 0.0, 2.0)
    assert first["from"] == 0 and not first["gone"]
    steps = np.frombuffer(base64.b64decode(first["steps"]), "<i2").reshape(-1, 3)
    places = np.array(first["origin"]) + first["step"] * steps
    assert len(places) == 60 * 80 and np.allclose(places[:, 2], 2.0, atol=0.002)
    colours = np.frombuffer(base64.b64decode(first["rgb"]), np.uint8).reshape(-1, 3)
    assert (colours == (200, 10, 10)).all()
    page.surface = None
    assert look(2, 0.01, 2.0) is None  # like the first view
    more = look(3, 0.5, 2.0)
    assert more["from"] == 4800 and 0 < len(base64.b64decode(more["rgb"])) < 3 * 4800
    for number in range(4):  # the wall is taken away
        far = look(4 + number, 1.0 + 0.3 * number, 6.0)
    assert far["from"] > 4800 and sum(map(len, page.gone)) > 1000
    late = Page(state)
    late.look()
    assert late.surface["from"] == 0 and sorted(late.surface["gone"]) == sorted(sum(page.gone, []))
    state.reset(make_graph([], session="another"))
    page.look()
    assert page.surface == {"from": 0, "gone": []}


def test_a_correction_moves_the_room_and_the_way_since_its_stamp():
    state = LiveState()
    page, nothing = Page(state), (np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 4)))
    rgb = np.zeros((480, 640, 3), np.uint8)
    for stamp_ns, x in ((1, 0.0), (2, 10.0)):
        T = np.eye(4)
        T[0, 3] = x
        local = local_graph(stamp_ns, *nothing, depth_grid=grid_of(2.0), T_world_camera=T)
        state.look(CameraView(stamp_ns, T, rgb, local=local))
    page.look()
    T_correction = np.eye(4)
    T_correction[1, 3] = 1.0
    state.correct(
        TrailChange(np.array([1, 2]), *[np.stack([np.eye(4), np.eye(4), T_correction])] * 2)
    )
    page.look()
    assert page.path == [[0, 0, 0], [10, 1, 0]]
    surface = page.surface
    assert surface["from"] == 0
    steps = np.frombuffer(base64.b64decode(surface["steps"]), "<i2").reshape(-1, 3)
    places = np.array(surface["origin"]) + surface["step"] * steps
    moved = places[:, 0] > 5
    assert moved.sum() == 4800 == (~moved).sum()
    assert places[moved, 1].mean() - places[~moved, 1].mean() == pytest.approx(1.0, abs=0.01)


def test_a_relation_is_explained():
    state = LiveState()
    state.reset(make_graph([node(1), node(2, "table")], [make_edge(1, 2)]))
    assert any("80%" in line for line in state.why(1, 2))
    assert state.why(2, 1) == state.why(7, 8) == []


def test_a_predicate_keeps_its_colour_while_others_become_more_frequent():
    state = LiveState()
    nodes = [node(i) for i in range(1, 5)]
    state.reset(make_graph(nodes, [make_edge(1, 2, "on")]))
    page = Page(state)
    page.look()
    first = page.head["tints"]["on"]
    state.reset(make_graph(nodes, [make_edge(1, i, "behind") for i in (2, 3, 4)], sequence=2))
    page.look()
    assert page.head["tints"]["on"] == first != page.head["tints"]["behind"]


# --- the past ----------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 7, BLOCK, 4 * BLOCK])
def test_each_moment_is_the_graph_of_its_update_and_the_oldest_are_forgotten(count):
    graphs = random_graphs(count, count, ["cup"], [0.0, 1.0])
    history = History(most_bytes=100_000)
    for update in updates_of(graphs):
        assert history.apply(update)
        assert history.size_bytes <= 100_000
    assert history.last == count - 1
    assert (history.first == 0) == (count <= BLOCK)
    assert history.last - history.first >= BLOCK or history.first == 0
    for moment in {history.first, (history.first + count) // 2, count - 1}:
        assert history.at(moment).replica().message() == graphs[moment + 1]
    assert history.at(0).replica().message() == graphs[history.first + 1]
    assert history.newest.message() == graphs[-1]


def test_a_gap_in_the_history_is_refused_and_a_snapshot_closes_it():
    history = History()
    assert history.last == -1 and history.at(0) is None
    graphs = random_graphs(0, 3, ["cup"], [0.0])
    first, _, third = updates_of(graphs)
    history.apply(first)
    with pytest.raises(RefusedInput, match="lost_updates|reset"):
        history.apply(third)
    history.reset(graphs[3])
    assert [history.at(moment).replica().sequence for moment in (0, 1)] == [1, 3]


# --- details of an object ----------------------------------------------------------------------


def item(*classes, remainder=0.0, entropy=None):
    beliefs = [wire.Belief(label, probability) for label, probability in classes]
    fields = {"classes": beliefs, "remainder": remainder, "entropy_nats": entropy}
    return scene_object(make_node(13, classes[0][0] if classes else "cup", **fields), "map", UP)


@pytest.mark.parametrize(
    ("classes", "remainder", "words"),
    [
        ([], 0.0, "cup"),
        ([("cup", 0.97), ("bowl", 0.03)], 0.0, "cup"),
        ([("cup", 0.8), ("orange", 0.2)], 0.0, "cup, or perhaps an orange"),
        ([("cup", 0.5), ("bowl", 0.45)], 0.05, "cup or bowl"),
        ([("cup", 0.2), ("bowl", 0.2), ("vase", 0.2)], 0.4,
         "cup or bowl or vase, or something else"),
        ([("cup", 0.7)], 0.3, "cup, or perhaps something else"),
    ],
)  # fmt: skip
def test_doubt_is_said_in_words(classes, remainder, words):
    assert in_words(item(*classes, remainder=remainder)) == words
