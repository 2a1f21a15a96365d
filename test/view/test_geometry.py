"""Axes, meshes, colours and label positions of the views."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.scene.arrays import shared_areas
from deworldsg_ros.view.colours import (
    PALETTE,
    class_colours,
    drawable_edges,
    predicate_colours,
    principal_axes,
    shade,
    to_rgb,
    view_axes,
)
from deworldsg_ros.view.picture import place, place_if_free


def random_covariance(seed):
    shape = np.random.default_rng(seed).normal(size=(3, 3))
    return shape @ shape.T + 1e-6 * np.eye(3)


@given(seed=st.integers(0, 2**32 - 1))
def test_principal_axes_rebuild_the_covariance_with_a_rotation(seed):
    covariance = random_covariance(seed)
    deviations, axes = principal_axes(covariance)
    np.testing.assert_allclose(axes @ np.diag(deviations**2) @ axes.T, covariance, atol=1e-10)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert (np.diff(deviations) <= 0).all()


@pytest.mark.parametrize(
    ("up", "right", "forward"),
    [
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
        ((0, 2, 0), (1, 0, 0), (0, 0, -1)),
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ],
)
def test_view_axes_of_usual_world_frames(up, right, forward):
    axes = view_axes(up)
    np.testing.assert_allclose(axes[0], right, atol=1e-12)
    np.testing.assert_allclose(axes[1], forward, atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
def test_view_axes_are_a_rotation_whose_last_row_is_up(seed):
    up = np.random.default_rng(seed).normal(size=3)
    axes = view_axes(up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(axes[2], up / np.linalg.norm(up))


@pytest.mark.parametrize("up", [(0, 0, 0), (np.nan, 0, 1), (1, 0)])
def test_view_axes_refuse_an_invalid_direction(up):
    with pytest.raises(ValueError, match="up direction"):
        view_axes(up)


def test_a_new_label_changes_no_class_colour():
    labels = [f"class {index}" for index in range(len(PALETTE))]
    all_colours = class_colours(labels)
    assert len(set(all_colours.values())) == len(PALETTE)
    for count in range(len(labels)):
        known = class_colours(labels[:count])
        assert all(all_colours[label] == colour for label, colour in known.items())
    assert class_colours([*labels, "one more"])["one more"] in PALETTE
    assert class_colours([]) == {}


def test_the_predicate_near_is_grey():
    colours = predicate_colours({"near": 50, "on": 10, "under": 3})
    assert list(colours) == ["near", "on", "under"]
    assert len(set(colours.values())) == 3
    assert colours["near"] == "#8d93a5"


def test_shade_and_rgb():
    assert to_rgb("#ff0080") == (1.0, 0.0, pytest.approx(128 / 255))
    assert shade("#ff0080", 0.5) == "#800040"


def test_drawable_edges_have_both_ends_and_symmetric_ones_appear_once():
    nodes = [make_node(1, "cup"), make_node(2, "table")]
    edges = [
        make_edge(1, 2, "near", 0.6),
        make_edge(2, 1, "near", 0.9),
        make_edge(1, 2, "on", 0.5),
        make_edge(2, 1, "on", 0.4),
        make_edge(1, 3, "on", 0.9),
    ]
    drawn = drawable_edges(make_graph(nodes, edges))
    assert [(edge.subject, edge.predicate) for edge in drawn] == [(2, "near"), (1, "on"), (2, "on")]


@pytest.mark.parametrize("count", [0, 1, 12, 40])
def test_labels_do_not_overlap_and_stay_inside(count):
    rng = np.random.default_rng(count)
    anchors = rng.uniform(300, 900, (count, 2))
    sizes = np.column_stack([rng.uniform(40, 90, count), np.full(count, 14.0)])
    frame = np.array([0.0, 0.0, 1200.0, 1200.0])
    placed = place(anchors, sizes, frame)
    boxes = placed.boxes
    shared = shared_areas(boxes, boxes)
    np.fill_diagonal(shared, 0)
    assert (shared <= 4).all()
    assert (boxes[:, :2] >= 0).all()
    assert (boxes[:, 2:] <= 1200).all()
    # Near their anchors.
    assert (np.linalg.norm(placed.centres - anchors, axis=1) < 200).all()


def test_a_predicate_takes_the_first_free_position_or_none():
    frame = np.array([0.0, 0.0, 100.0, 100.0])
    candidates = np.array([[50.0, 50.0], [50.0, 80.0]])
    size = np.array([20.0, 10.0])
    nothing = np.zeros((0, 4))
    assert place_if_free(candidates, size, nothing, frame) == 0
    assert place_if_free(candidates, size, np.array([[45.0, 45, 55, 55]]), frame) == 1
    assert place_if_free(candidates, size, np.array([[0.0, 0, 100, 100]]), frame) is None
    assert place_if_free(np.array([[2.0, 2.0]]), size, nothing, frame) is None
