"""What the live viewer shows, without a browser: drawing, labels, details, and the past."""

import math

import numpy as np
import pytest
from support.view import box_at, make_edge, make_graph, make_node, random_graphs, updates_of

from deworldsg_ros.client.objects import relation_of, scene_object
from deworldsg_ros.scene.arrays import shared_areas
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.view.live import scene
from deworldsg_ros.view.live.details import in_words, object_html, uncertainty
from deworldsg_ros.view.live.drawing import Filter, Label
from deworldsg_ros.view.live.state import BLOCK, History, LiveState
from deworldsg_ros.wire import messages as wire

UP = (0.0, 0.0, 1.0)


def node(node_id, label="cup", center=(0.0, 0.0, 0.0), turned=0.0, **fields):
    box = box_at(center, (0.2, 0.4, 0.6), turned)
    return make_node(node_id, label, center, **{"box": box, "existence": 0.95, **fields})


def state_of(nodes, edges=(), **chosen):
    state = LiveState(**chosen)
    state.reset(make_graph(nodes, edges))
    return state, state.draw()


def follow(state, before, after, **fields):
    """Apply the update from one list of nodes to the next."""
    graphs = [make_graph(before), make_graph(after, sequence=2, **fields)]
    state.apply(*updates_of(graphs))
    return state.draw()


def test_an_empty_graph_says_why():
    state, drawing = state_of([], why_empty="the camera is covered")
    assert len(drawing.ids) == len(drawing.outlines) == len(drawing.arrows) == 0
    assert not drawing.labels
    assert state.summary(drawing) == ["no objects", "the camera is covered"]
    assert state.bounds() is None


def test_boxes_have_the_corners_of_the_message_and_ellipsoids_the_size_of_the_covariance():
    _, drawing = state_of([node(1, center=(1, 2, 3), turned=np.pi / 2)])
    assert len(drawing.outlines) == 12
    # Turned by 90 degrees, the length of 0.2 m is along y.
    corners = drawing.outlines.reshape(-1, 3)
    np.testing.assert_allclose(np.ptp(corners, axis=0), (0.4, 0.2, 0.6), atol=1e-9)
    lengths = np.linalg.norm(np.diff(drawing.outlines, axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(np.sort(lengths), np.repeat((0.2, 0.4, 0.6), 4), atol=1e-9)
    _, drawing = state_of([node(1)], shape="ellipsoids")
    assert len(drawing.outlines) == 0
    # make_node: variances of 0.04, 0.01 and 0.0025 square metres; diameters of 4 deviations.
    np.testing.assert_allclose(np.sort(drawing.scales[0]), (0.2, 0.4, 0.8), atol=1e-9)


@pytest.mark.parametrize(
    ("chosen", "ids", "arrows", "lines"),
    [
        ({}, [1, 2, 3], 1, 0),
        ({"hidden_predicates": frozenset()}, [1, 2, 3], 1, 1),  # one line for both directions
        ({"hidden_predicates": frozenset({"on"})}, [1, 2, 3], 0, 1),
        ({"hidden_classes": frozenset({"bowl"})}, [1, 3], 0, 0),
        ({"min_probability": 0.99}, [], 0, 0),
        ({"min_relation": 0.81}, [1, 2, 3], 0, 0),
    ],
)
def test_filters_hide_objects_and_relations_and_near_at_first(chosen, ids, arrows, lines):
    nodes = [node(1), node(2, "bowl", (1, 0, 0)), node(3, center=(0, 0, 1))]
    edges = [make_edge(1, 3, "near"), make_edge(3, 1, "near"), make_edge(1, 2, "on")]
    _, drawing = state_of(nodes, edges, filter=Filter(**chosen))
    assert sorted(drawing.ids.tolist()) == ids
    assert (len(drawing.arrows), len(drawing.lines)) == (arrows, lines)


def test_arrows_end_at_boxes_and_opposite_ones_are_apart():
    nodes = [node(1), node(2, center=(2, 0, 0))]
    _, drawing = state_of(nodes, [make_edge(1, 2, "behind")])
    np.testing.assert_allclose(drawing.arrows[0], [(0, 0, 0), (1.9, 0, 0)], atol=1e-9)
    _, drawing = state_of(nodes, [make_edge(1, 2, "in front of"), make_edge(2, 1, "behind")])
    there, back = drawing.arrows
    assert np.linalg.norm(there.mean(axis=0) - back.mean(axis=0)) > 0.05


def test_a_selected_object_is_emphasised_and_forgotten_when_it_goes():
    nodes = [node(1), node(2, center=(1, 0, 0)), node(3, center=(0, 1, 0))]
    state, drawing = state_of(nodes, [make_edge(1, 2), make_edge(3, 2)], selected=1)
    assert drawing.opacities.argmax() == drawing.ids.tolist().index(1)
    assert (drawing.arrow_colours[0] != drawing.arrow_colours[1]).any()
    assert max(drawing.labels, key=lambda label: label.weight).key == "object 1"
    follow(state, nodes, nodes[1:])
    assert state.selected is None


def test_surface_points_have_the_colours_of_their_classes():
    nodes = [node(1, points=[(0, 0, 0), (0.1, 0, 0)]), node(2, "bowl", points=[(1, 0, 0)])]
    state, _ = state_of(nodes)
    points, colours = state.points()
    assert points.shape == colours.shape == (3, 3)
    assert colours[0].tolist() == colours[1].tolist() != colours[2].tolist()
    state.filter = Filter(hidden_classes=frozenset({"bowl"}))
    assert len(state.points()[0]) == 2


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
        assert history.at(moment).message() == graphs[moment + 1]
    assert history.at(0).message() == graphs[history.first + 1]
    assert history.newest.message() == graphs[-1]


def test_a_gap_in_the_history_is_refused_and_a_snapshot_closes_it():
    history = History()
    assert history.last == -1 and not history.at(0).nodes
    graphs = random_graphs(0, 3, ["cup"], [0.0])
    first, _, third = updates_of(graphs)
    history.apply(first)
    with pytest.raises(RefusedInput, match="lost_updates|reset"):
        history.apply(third)
    history.reset(graphs[3])
    assert [history.at(moment).sequence for moment in (0, 1)] == [1, 3]


# --- labels and the camera ---------------------------------------------------------------------

# Looks along +y, z is up: x right, y down is -z.
QUAT = np.sqrt([0.5, 0.5, 0, 0]) * [1, -1, 0, 0]
AHEAD = scene.Camera(np.zeros(3), QUAT, np.pi / 2, 800.0, 600.0)


def boxes_of(placed):
    shifts = {name: np.array((x, y)) for name, x, y in scene.ANCHORS}
    boxes = []
    for item in placed:
        (point,), _ = AHEAD.project(item.label.position[None])
        width = scene.FRAME_PX + scene.LETTER_PX * len(item.label.text)
        half = np.array((width, scene.HEIGHT_PX)) / 2
        centre = point + shifts[item.anchor] * half
        boxes.append(np.concatenate([centre - half, centre + half]))
    return np.array(boxes).reshape(-1, 4)


@pytest.mark.parametrize("count", [0, 1, 40, 400])
def test_labels_do_not_overlap(count):
    rng = np.random.default_rng(count)
    positions = rng.uniform((-2, 1, -1), (2, 6, 1), (count, 3))
    labels = [Label(f"{i}", f"object {i}", p, float(i)) for i, p in enumerate(positions)]
    placed = scene.place(labels, AHEAD, 60)
    assert len(placed) <= 60 and bool(placed) == bool(count)
    shared = shared_areas(boxes_of(placed), boxes_of(placed))
    assert np.abs(shared - np.diag(np.diag(shared))).sum() == pytest.approx(0.0, abs=1e-6)


def test_the_heavier_labels_have_the_first_choice_and_none_is_behind_the_camera():
    def placed_at(y):
        labels = [Label(f"{i}", "a chair", np.array([0.0, y, 0.0]), float(i)) for i in range(6)]
        return [(item.label.key, item.anchor) for item in scene.place(labels, AHEAD, 60)]

    assert placed_at(3.0) == [("5", "bottom-center"), ("4", "top-center")]
    assert placed_at(-3.0) == []


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


def test_all_that_is_known_is_there():
    cup = item(("cup", 0.7), ("bowl", 0.2), remainder=0.1, entropy=math.log(2))
    table = scene_object(make_node(5, "table"), "map", UP)
    html = object_html(cup, [relation_of(make_edge(13, 5), cup, table, None)], b"\xff\xd8jpeg")
    for text in (
        "cup #13", "bowl", "all other classes", "10%", "5 frames", "on table #5", "80%",
        "seen in 4 frames", "data:image/jpeg;base64,/9hqcGVn", "2.0 equally likely",
    ):  # fmt: skip
        assert text in html, text
    assert uncertainty(item(("cup", 1.0), entropy=0.0)).startswith("certain")
    assert uncertainty(item(("cup", 1.0))) == ""
