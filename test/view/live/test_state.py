"""What the live viewer shows, without a browser."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from support.reference_updates import diff
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.view.live.drawing import Filter, ObjectTable
from deworldsg_ros.view.live.state import LiveState
from deworldsg_ros.wire import messages as wire


def box(center, size=(0.2, 0.4, 0.6), turned=0.0):
    quat = [0.0, 0.0, np.sin(turned / 2), np.cos(turned / 2)]
    return wire.GravityBox(center_m=list(center), size_m=list(size), orientation_xyzw=quat)


def node(node_id, label="cup", center=(0.0, 0.0, 0.0), **values):
    made = make_node(node_id, label, center)
    return msgspec.structs.replace(made, **{"box": box(center), "existence": 0.95, **values})


def state_of(nodes, edges=(), **chosen):
    state = LiveState(**chosen)
    state.reset(make_graph(nodes, edges))
    return state, state.draw()


def test_an_empty_graph_says_why():
    state, drawing = state_of([], why_empty="the camera is covered")
    assert len(drawing.ids) == len(drawing.outlines) == len(drawing.arrows) == 0
    assert not drawing.labels
    assert state.summary(drawing) == ["no objects", "the camera is covered"]
    assert state.bounds() is None


def test_boxes_have_the_corners_of_the_message():
    _, drawing = state_of([node(1, center=(1.0, 2.0, 3.0), box=box((1, 2, 3), turned=np.pi / 2))])
    corners = drawing.outlines.reshape(-1, 3)
    assert len(drawing.outlines) == 12
    # Turned by 90 degrees, the length of 0.2 m is along y.
    np.testing.assert_allclose(np.ptp(corners, axis=0), (0.4, 0.2, 0.6), atol=1e-9)
    lengths = np.linalg.norm(np.diff(drawing.outlines, axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(np.sort(lengths), np.repeat((0.2, 0.4, 0.6), 4), atol=1e-9)


def test_ellipsoids_are_those_of_the_covariances():
    _, drawing = state_of([node(1)], shape="ellipsoids")
    assert len(drawing.outlines) == 0
    # make_node: variances of 0.04, 0.01 and 0.0025 square metres; diameters of 4 deviations.
    np.testing.assert_allclose(np.sort(drawing.scales[0]), (0.2, 0.4, 0.8), atol=1e-9)


def test_near_is_hidden_at_first_and_can_be_shown():
    nodes = [node(1), node(2, center=(1, 0, 0)), node(3, center=(0, 0, 1))]
    edges = [make_edge(1, 2, "near"), make_edge(2, 1, "near"), make_edge(3, 1, "on")]
    state, drawing = state_of(nodes, edges)
    assert (len(drawing.arrows), len(drawing.lines)) == (1, 0)
    state.filter = Filter(hidden_predicates=frozenset())
    drawing = state.draw()
    assert (len(drawing.arrows), len(drawing.lines)) == (1, 1), "one line for both directions"


@pytest.mark.parametrize(
    ("chosen", "ids", "arrows"),
    [
        (Filter(), [1, 2], 1),
        (Filter(hidden_classes=frozenset({"bowl"})), [1], 0),
        (Filter(hidden_predicates=frozenset({"on"})), [1, 2], 0),
        (Filter(min_probability=0.99), [], 0),
        (Filter(min_relation=0.81), [1, 2], 0),
    ],
)
def test_filters_hide_objects_and_relations(chosen, ids, arrows):
    nodes = [node(1), node(2, "bowl", (1, 0, 0))]
    _, drawing = state_of(nodes, [make_edge(1, 2, "on", 0.8)], filter=chosen)
    assert sorted(drawing.ids.tolist()) == ids
    assert len(drawing.arrows) == arrows


def test_opposite_relations_do_not_cover_each_other():
    nodes = [node(1), node(2, center=(2, 0, 0))]
    _, drawing = state_of(nodes, [make_edge(1, 2, "in front of"), make_edge(2, 1, "behind")])
    there, back = drawing.arrows
    assert np.linalg.norm(there.mean(axis=0) - back.mean(axis=0)) > 0.05


def test_an_arrow_ends_at_the_box_of_its_object():
    nodes = [node(1), node(2, center=(2, 0, 0))]
    _, drawing = state_of(nodes, [make_edge(1, 2, "behind")])
    np.testing.assert_allclose(drawing.arrows[0], [(0, 0, 0), (1.9, 0, 0)], atol=1e-9)


def test_a_selected_object_is_emphasised_and_forgotten_when_it_goes():
    nodes = [node(1), node(2, center=(1, 0, 0)), node(3, center=(0, 1, 0))]
    edges = [make_edge(1, 2, "on"), make_edge(3, 2, "on")]
    state, drawing = state_of(nodes, edges, selected=1)
    assert drawing.opacities.argmax() == drawing.ids.tolist().index(1)
    assert (drawing.arrow_colours[0] != drawing.arrow_colours[1]).any()
    assert max(drawing.labels, key=lambda label: label.weight).key == "object 1"
    before, after = make_graph(nodes, edges), make_graph(nodes[1:], edges[1:])
    state.apply(diff(before, msgspec.structs.replace(after, sequence=before.sequence + 1)))
    state.draw()
    assert state.selected is None


def test_only_changed_objects_are_computed_again(monkeypatch):
    computed = []
    put = ObjectTable._put
    monkeypatch.setattr(
        ObjectTable, "_put", lambda self, item: (computed.append(item.id), put(self, item))
    )
    nodes = [node(index) for index in range(1, 50)]
    state, _ = state_of(nodes)
    assert len(computed) == 49
    computed.clear()
    before = make_graph(nodes)
    changed = [*nodes[:-1], node(49, "bowl")]
    after = msgspec.structs.replace(make_graph(changed), sequence=before.sequence + 1)
    state.apply(diff(before, after))
    state.draw()
    assert computed == [49]


def test_the_slider_shows_the_past_while_updates_arrive():
    state, _ = state_of([node(1)])
    first = make_graph([node(1)])
    second = msgspec.structs.replace(
        make_graph([node(1), node(2)]), sequence=2, stamp=wire.Stamp(sec=5, nanosec=5)
    )
    state.moment = 0
    state.apply(diff(first, second))
    drawing = state.draw()
    assert drawing.ids.tolist() == [1]
    assert "2.0 s before the newest" in state.summary(drawing)[-1]
    state.moment = None
    assert sorted(state.draw().ids.tolist()) == [1, 2]


def test_surface_points_have_the_colours_of_their_classes():
    nodes = [
        node(1, surface_points_m=[[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]),
        node(2, "bowl", surface_points_m=[[1.0, 0.0, 0.0]]),
    ]
    state, drawing = state_of(nodes)
    points, colours = state.points()
    assert points.shape == colours.shape == (3, 3)
    assert colours[0].tolist() == colours[1].tolist() != colours[2].tolist()
    state.filter = Filter(hidden_classes=frozenset({"bowl"}))
    assert len(state.points()[0]) == 2
