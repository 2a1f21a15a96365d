"""The surface rule: partial views, flipping labels, adjacent objects."""

from __future__ import annotations

import numpy as np
import pytest
from support.merging import VOCABULARY
from support.node_states import node_states
from support.surfaces import CHAIR, CUP, TABLE, WHOLE, frame, slab, view

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.graph.graph import SceneGraph
from deworldsg_ros.merging import SurfaceMerging
from deworldsg_ros.merging.surface_map import CELL_M


@pytest.fixture
def graph() -> SceneGraph:
    return SceneGraph(VOCABULARY, "world")


CONFIG = MergingConfig()


@pytest.fixture
def merging() -> SurfaceMerging:
    return SurfaceMerging(CONFIG)


LEFT = slab((-0.5, 0, 1), (1.2, 0.8, 0.01))
RIGHT = slab((0.5, 0, 1), (1.2, 0.8, 0.01))


@pytest.mark.parametrize("parts", [(LEFT, WHOLE, RIGHT), (WHOLE, LEFT, RIGHT), (RIGHT, WHOLE)])
def test_partial_views_are_one_object(graph, merging, parts) -> None:
    for stamp, points in enumerate(parts):
        assert merging.merge(graph, frame(stamp, (points, TABLE))) == [1]
    assert len(graph) == 1


def test_a_flipping_label_creates_no_node(graph, merging) -> None:
    for stamp in range(10):
        kind = CHAIR if stamp % 5 == 3 else TABLE
        assert merging.merge(graph, frame(stamp, (WHOLE, kind))) == [1]
    state = node_states(graph, 3)[1]
    assert state.label == VOCABULARY.classes[TABLE]
    assert state.classes[0].probability > 0.5
    assert state.classes[1].label == VOCABULARY.classes[CHAIR]  # the disagreement is visible


def test_objects_that_touch_stay_separate(graph, merging) -> None:
    cup = slab((0.3, 0.1, 1.05), (0.08, 0.08, 0.09))
    for stamp in range(5):
        order = [(WHOLE, TABLE), (cup, CUP)]
        ids = merging.merge(graph, frame(stamp, *order[:: -1 if stamp % 2 else 1]))
        assert ids == ([2, 1] if stamp % 2 else [1, 2])
    assert merging.merge(graph, frame(9, (cup, CUP))) == [2]
    assert merging.merge(graph, frame(10, (WHOLE, TABLE))) == [1]


def test_adjacent_objects_of_one_class_stay_separate_while_both_are_detected(
    graph, merging
) -> None:
    books = [slab((x, 0, 1), (0.04, 0.15, 0.2)) for x in (0.0, 0.045, 0.09)]
    for stamp in range(10):
        assert merging.merge(graph, frame(stamp, *[(book, CUP) for book in books])) == [1, 2, 3]


def test_an_adjacent_object_that_is_often_missed_stays_separate(graph, merging) -> None:
    books = [slab((x, 0, 1), (0.035, 0.15, 0.2)) for x in (0.0, 0.036, 0.072)]
    for stamp in range(3):
        assert merging.merge(graph, frame(stamp, *[(book, CUP) for book in books])) == [1, 2, 3]
    for stamp in range(3, 40):
        seen = [0, 2] if stamp % 8 else [0, 1, 2]
        ids = merging.merge(graph, frame(stamp, *[(books[index], CUP) for index in seen]))
        assert ids == [index + 1 for index in seen]
    assert merging.merge(graph, frame(50, (books[1], CUP))) == [2]


def test_a_new_detection_between_adjacent_nodes_creates_a_node(graph, merging) -> None:
    left, middle, right = (slab((x, 0, 1), (0.02, 0.15, 0.2)) for x in (0.0, 0.022, 0.044))
    for stamp in range(3):
        assert merging.merge(graph, frame(stamp, (left, CUP), (right, CUP))) == [1, 2]
    # The new detection has the highest class score, and its cells touch both adjacent nodes.
    classes = np.array([[0.97, 0.01, 0.01, 0.01], [0.7, 0.1, 0.1, 0.1], [0.7, 0.1, 0.1, 0.1]])
    for stamp in range(3, 10):
        local = frame(stamp, (middle, CUP), (left, CUP), (right, CUP), class_probabilities=classes)
        assert merging.merge(graph, local) == [3, 1, 2]


def test_a_small_object_on_a_large_one_of_another_class_is_a_node(graph, merging) -> None:
    for stamp in range(3):
        assert merging.merge(graph, frame(stamp, (WHOLE, TABLE))) == [1]
    mat = slab((0.5, 0.1, 1.005), (0.2, 0.15, 0.01))
    for stamp in range(3, 6):
        assert merging.merge(graph, frame(stamp, (mat, CUP))) == [2]
    # The large object does not match the small node either.
    assert merging.merge(graph, frame(6, (WHOLE, TABLE))) == [1]
    # A part of the table that is called a chair is the table.
    assert merging.merge(graph, frame(7, (LEFT, CHAIR))) == [1]


def test_two_halves_of_an_object_are_merged(graph, merging) -> None:
    gap_left, gap_right = slab((-0.7, 0, 1), (0.7, 0.8, 0.01)), slab((0.7, 0, 1), (0.7, 0.8, 0.01))
    assert merging.merge(graph, frame(0, (gap_left, TABLE))) == [1]
    assert merging.merge(graph, frame(1, (gap_right, TABLE))) == [2]
    for stamp in range(2, 8):
        merging.merge(graph, frame(stamp, (WHOLE, TABLE)))
    assert list(graph.nodes.slot_of) == [1]
    assert graph.take_removals() == {2: 1}
    assert merging.merge(graph, frame(9, (gap_right, TABLE))) == [1]


def test_a_node_of_two_objects_loses_the_surface_of_one_when_both_are_detected(graph) -> None:
    merging = SurfaceMerging(CONFIG)
    left, right = slab((-0.06, 0, 1), (0.12, 0.3, 0.004)), slab((0.06, 0, 1), (0.12, 0.3, 0.004))
    both = np.concatenate((left, right))
    ids = [merging.merge(graph, view(stamp, (both, CUP))) for stamp in range(10)]
    ids += [merging.merge(graph, view(stamp, (left, CUP), (right, CUP))) for stamp in range(10, 20)]
    ids += [
        merging.merge(graph, view(20, (right, CUP))),
        merging.merge(graph, view(21, (left, CUP))),
    ]
    assert ids[9] == [1] and ids[19:] == [[1, 2], [2], [1]]
    # Its surface ends within two cells of the other object, which extends to 0.12 m.
    assert graph.nodes.surface(0)[:, 0].max() < 2 * CELL_M


CHAIR_FRONT = slab((0, 0, 1), (0.5, 0.6, 0.004))
BOX_FRONT = slab((0, 0, 1), (0.3, 0.3, 0.004))
COUCH_FRONT = slab((0, 0, 1), (0.95, 0.6, 0.004))


@pytest.mark.parametrize(
    "large, small",
    [
        pytest.param(CHAIR_FRONT, slab((0.05, 0.1, 0.99), (0.2, 0.26, 0.004)), id="book on chair"),
        pytest.param(BOX_FRONT, slab((0.05, 0.05, 0.98), (0.1, 0.1, 0.004)), id="cup on box"),
        pytest.param(
            COUCH_FRONT, slab((0.2, 0.1, 0.99), (0.24, 0.16, 0.004)), id="remote on couch"
        ),
    ],
)
def test_a_thing_that_lies_wholly_on_a_larger_one_is_a_node(graph, merging, large, small) -> None:
    """Masks of the larger thing include the smaller, until it is detected apart."""
    for stamp in range(3):
        assert merging.merge(graph, view(stamp, (large, CHAIR), (small, None))) == [1]
    assert merging.merge(graph, view(3, (small, CUP), (large, None))) == [2]
    assert merging.merge(graph, view(4, (large, CHAIR), (small, CUP))) == [1, 2]
    # The larger one alone, its mask over both, is no evidence that they are one.
    for stamp in range(5, 25):
        assert merging.merge(graph, view(stamp, (large, CHAIR), (small, None))) == [1]
    assert merging.merge(graph, view(25, (small, CUP), (large, None))) == [2]


def test_a_second_unsure_box_on_an_object_is_merged(graph, merging) -> None:
    part = slab((0, 0.1, 0.998), (0.3, 0.25, 0.004))
    for stamp in range(3):
        assert merging.merge(graph, view(stamp, (CHAIR_FRONT, CHAIR))) == [1]
    for stamp in range(3, 23):
        scores = np.array([0.8, 0.3])
        merging.merge(graph, view(stamp, (CHAIR_FRONT, CHAIR), (part, CHAIR), scores=scores))
    assert graph.take_removals() == {2: 1, 3: 1}


def test_a_second_sure_box_on_an_object_is_an_object(graph, merging) -> None:
    part = slab((0, 0.1, 0.998), (0.3, 0.25, 0.004))
    for stamp in range(3):
        assert merging.merge(graph, view(stamp, (CHAIR_FRONT, CHAIR))) == [1]
    for stamp in range(3, 23):
        objects = (CHAIR_FRONT, CHAIR), (part, CHAIR)
        assert merging.merge(graph, view(stamp, *objects)) == [1, 2]


def test_a_confirmed_node_out_of_view_stays(graph, merging) -> None:
    for stamp in range(3):
        merging.merge(graph, frame(stamp, (WHOLE, TABLE)))
    merging.merge(graph, frame(10_000))
    assert list(graph.nodes.slot_of) == [1]


def test_observations_are_weighted_by_pixels(graph, merging) -> None:
    few = frame(0, (LEFT, TABLE), pixel_counts=np.array([1000]))
    many = frame(1, (WHOLE, TABLE), pixel_counts=np.array([9000]))
    merging.merge(graph, few)
    merging.merge(graph, many)
    expected = (few.means_world[0] + 9 * many.means_world[0]) / 10
    assert graph.nodes.means[0] == pytest.approx(expected)
    assert graph.nodes.observations.tolist() == [2]


def test_the_result_does_not_depend_on_the_world_frame() -> None:
    rng = np.random.default_rng(3)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    shift = np.array([10.0, -4.0, 2.0])
    cup = slab((0.3, 0.1, 1.05), (0.08, 0.08, 0.09))
    views = [[(LEFT, TABLE)], [(WHOLE, TABLE), (cup, CUP)], [(cup, CHAIR), (RIGHT, TABLE)]]
    results = []
    for move in (False, True):
        graph = SceneGraph(VOCABULARY, "world")
        merging = SurfaceMerging(CONFIG)
        ids = []
        for stamp, objects in enumerate(views):
            moved = [
                ((points @ rotation.T + shift).astype(np.float32) if move else points, kind)
                for points, kind in objects
            ]
            ids.append(merging.merge(graph, frame(stamp, *moved)))
        means = graph.nodes.means if not move else (graph.nodes.means - shift) @ rotation
        results.append((ids, means.copy()))
    assert results[0][0] == results[1][0] == [[1], [1, 2], [2, 1]]
    assert results[0][1] == pytest.approx(results[1][1], abs=1e-5)
