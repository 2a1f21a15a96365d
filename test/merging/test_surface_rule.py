"""The surface rule: partial views, flipping labels, adjacent objects, absent and moved ones."""

from collections.abc import Callable

import numpy as np
import pytest
from support.merging import VOCABULARY, node_states
from support.surfaces import (
    CAMERA,
    CHAIR,
    CUP,
    HERE,
    TABLE,
    WHOLE,
    depth_grid,
    frame,
    slab,
    view,
)

from deworldsg_ros.config import MergingConfig
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.merging import SurfaceMerging
from deworldsg_ros.merging.matching import in_one_place
from deworldsg_ros.merging.records import _nearest
from deworldsg_ros.merging.surface_map import CELL_M
from deworldsg_ros.scene.frame_graph import DepthGrid, LocalGraph

Seen = tuple[np.ndarray, int | None]
LEFT = slab((-0.5, 0, 1), (1.2, 0.8, 0.01))
RIGHT = slab((0.5, 0, 1), (1.2, 0.8, 0.01))


class Scene:
    """A graph, its association rule, and a clock."""

    def __init__(self) -> None:
        self.graph = GlobalGraph(VOCABULARY, "world")
        self.merging = SurfaceMerging(MergingConfig())
        self.stamp = 0

    def see(
        self, *objects: Seen, make: Callable[..., LocalGraph] = frame, times: int = 1, **changes
    ) -> list[int]:
        """Frames of the objects; returns the nodes of the last one."""
        ids: list[int] = []
        for _ in range(times):
            self.stamp += 1
            ids = self.merging.merge(self.graph, make(self.stamp, *objects, **changes))
        return ids

    def published(self) -> dict[int, str]:
        return {node_id: node.label for node_id, node in node_states(self.graph, 1).items()}


@pytest.fixture
def scene() -> Scene:
    return Scene()


# --- one object, one node ------------------------------------------------------------------------

ON_TABLE = slab((0.3, 0.1, 1.05), (0.08, 0.08, 0.09))
MAT = slab((0.5, 0.1, 1.005), (0.2, 0.15, 0.01))
BOOKS = [slab((x, 0, 1), (0.04, 0.15, 0.2)) for x in (0.0, 0.045, 0.09)]
SHELF = [(book, CUP) for book in BOOKS]


@pytest.mark.parametrize(
    "steps",
    [
        pytest.param([(LEFT, TABLE, 1), (WHOLE, TABLE, 1), (RIGHT, TABLE, 1)], id="partial views"),
        pytest.param([(WHOLE, TABLE, 1), (LEFT, TABLE, 1), (RIGHT, TABLE, 1)], id="parts of it"),
        pytest.param([(RIGHT, TABLE, 1), (WHOLE, TABLE, 1)], id="a part first"),
        # The large object does not match the small node either; a part of the table that is called
        # a chair is the table.
        pytest.param(
            3 * [(WHOLE, TABLE, 1)] + 3 * [(MAT, CUP, 2)] + [(WHOLE, TABLE, 1), (LEFT, CHAIR, 1)],
            id="a mat on a table",
        ),
    ],
)
def test_objects_that_are_seen_one_at_a_time(scene, steps) -> None:
    for points, kind, node_id in steps:
        assert scene.see((points, kind)) == [node_id]


def test_a_flipping_label_creates_no_node(scene) -> None:
    for index in range(10):
        assert scene.see((WHOLE, CHAIR if index % 5 == 3 else TABLE)) == [1]
    state = node_states(scene.graph, 3)[1]
    assert state.label == VOCABULARY.classes[TABLE]
    assert state.classes[0].probability > 0.5
    assert state.classes[1].label == VOCABULARY.classes[CHAIR]  # the disagreement is visible


def test_adjacent_objects_stay_separate(scene) -> None:
    for index in range(6):
        order = -1 if index % 2 else 1
        ids = scene.see(*[(WHOLE, TABLE), (ON_TABLE, CUP)][::order])
        assert ids == [1, 2][::order]
    assert scene.see((ON_TABLE, CUP)) == [2] and scene.see((WHOLE, TABLE)) == [1]


def test_adjacent_objects_of_one_class_stay_separate_though_one_is_often_missed(scene) -> None:
    assert scene.see(*SHELF, times=10) == [1, 2, 3]
    for index in range(40):
        seen = [0, 2] if index % 8 else [0, 1, 2]
        assert scene.see(*(SHELF[i] for i in seen)) == [i + 1 for i in seen]
    assert scene.see(SHELF[1]) == [2]


def test_a_new_detection_between_adjacent_nodes_creates_a_node(scene) -> None:
    left, middle, right = (slab((x, 0, 1), (0.02, 0.15, 0.2)) for x in (0.0, 0.022, 0.044))
    assert scene.see((left, CUP), (right, CUP), times=3) == [1, 2]
    # The new detection has the highest class score, and its cells touch both adjacent nodes.
    classes = np.array([[0.97, 0.01, 0.01, 0.01], [0.7, 0.1, 0.1, 0.1], [0.7, 0.1, 0.1, 0.1]])
    for _ in range(7):
        objects = [(points, CUP) for points in (middle, left, right)]
        assert scene.see(*objects, class_probabilities=classes) == [3, 1, 2]


def test_two_halves_of_an_object_are_merged(scene) -> None:
    halves = [slab((x, 0, 1), (0.7, 0.8, 0.01)) for x in (-0.7, 0.7)]
    assert [scene.see((half, TABLE)) for half in halves] == [[1], [2]]
    scene.see((WHOLE, TABLE), times=6)
    assert list(scene.graph.nodes.slot_of) == [1]
    assert scene.graph.take_removals() == {2: 1}
    assert scene.see((halves[1], TABLE)) == [1]


# The back of a chair above its seat, with air between, and the same beside it.
SEAT = slab((0, 0, 0.45), (0.5, 0.5, 0.04))


@pytest.mark.parametrize(
    ("label", "x_m", "up", "count"),
    [
        (CHAIR, 0.2, (0.0, 0.0, 1.0), 1),
        (CHAIR, 0.7, (0.0, 0.0, 1.0), 2),  # another chair
        (CHAIR, 0.2, (1.0, 0.0, 0.0), 2),  # up is elsewhere: one stands beside the other
        (CUP, 0.2, (0.0, 0.0, 1.0), 2),  # cups are stacked
    ],
)
def test_parts_of_a_chair_over_each_other_are_one(scene, label, x_m, up, count) -> None:
    scene.graph.up_world = np.array(up)
    back = slab((x_m, 0, 0.8), (0.05, 0.45, 0.3))
    (seat,), (other,) = scene.see((SEAT, label), times=3), scene.see((back, label), times=3)
    assert seat != other  # they do not touch
    slots = scene.graph.nodes.slots_of([seat, other])
    pairs = in_one_place(scene.graph, slots[1:].tolist(), slots[:1])
    assert pairs == [tuple(slots.tolist())][: 2 - count]


@pytest.mark.parametrize(("viewpoints", "are_two"), [(2, False), (4, True)])
def test_two_that_viewpoints_have_shown_together_are_two(scene, viewpoints, are_two) -> None:
    """A chair in the place of another one, as a mask that takes in both makes it."""
    back = slab((0.2, 0, 0.8), (0.05, 0.45, 0.3))
    for index in range(viewpoints):
        scene.see((SEAT, CHAIR), (back, CHAIR), times=2, T_world_camera=at(0.3 * index))
    scene.graph.up_world = np.array((0.0, 0.0, 1.0))
    joint = scene.merging._records.joint
    assert in_one_place(scene.graph, [0], np.array([1])) == [(0, 1)]
    assert joint.are_two(0, 1) == joint.are_two(1, 0) == are_two


def test_a_node_of_two_objects_loses_the_surface_of_one_when_both_are_detected(scene) -> None:
    left, right = slab((-0.06, 0, 1), (0.12, 0.3, 0.004)), slab((0.06, 0, 1), (0.12, 0.3, 0.004))
    both = np.concatenate((left, right))
    assert scene.see((both, CUP), make=view, times=10) == [1]
    assert scene.see((left, CUP), (right, CUP), make=view, times=10) == [1, 2]
    assert scene.see((right, CUP), make=view) == [2] and scene.see((left, CUP), make=view) == [1]
    # Its surface ends within two cells of the other object, which extends to 0.12 m.
    assert scene.graph.nodes.surface(0)[:, 0].max() < 2 * CELL_M


def at(x_m: float) -> np.ndarray:
    """A pose of the camera."""
    pose = np.eye(4)
    pose[0, 3] = x_m
    return pose


NEAR_CHAIR, FAR_CHAIR = slab((-0.4, 0, 1), (0.5, 0.5, 0.04)), slab((0.4, 0, 1.3), (0.4, 0.5, 0.04))
BOXES = {
    "apart": [[100, 100, 200, 300], [220, 100, 300, 300]],
    "nested": [[100, 100, 200, 300]] * 2,
}


@pytest.mark.parametrize(
    ("boxes", "score", "poses_m", "cut"),
    [
        ("apart", 0.8, (0.0, 0.1, 0.3), True),
        ("apart", 0.8, (0.0, 0.1, 0.15), False),  # one viewpoint says once
        ("apart", 0.4, (0.0, 0.1, 0.3), False),  # unsure
        ("nested", 0.8, (0.0, 0.1, 0.3), False),  # a second box on an object
    ],
)
def test_a_node_of_two_chairs_is_cut_when_viewpoints_show_both(
    scene, boxes, score, poses_m, cut
) -> None:
    scene.see((np.concatenate((NEAR_CHAIR, FAR_CHAIR)), CHAIR), times=5)
    changes = {"scores": np.array([0.9, score]), "boxes_xyxy": np.array(BOXES[boxes], np.float64)}
    for x_m in poses_m:
        pose = at(x_m)
        ids = scene.see((NEAR_CHAIR, CHAIR), (FAR_CHAIR, CHAIR), T_world_camera=pose, **changes)
    nodes, records = scene.graph.nodes, scene.merging._records
    surface, cells = nodes.surface(0), records.map.centres(0)
    assert ids[0] == 1 and ids[1] > 1
    if cut:
        # Surface, cells and Gaussian are those of the nearer chair alone.
        assert max(surface[:, 0].max(), cells[:, 0].max()) < 0
        assert abs(nodes.means[0, 0] + 0.4) < 0.05 and nodes.covariances[0, 0, 0] < 0.15**2
        assert scene.see((FAR_CHAIR, CHAIR)) == [ids[1]]
        assert records.joint.balance(0, nodes.slot(ids[1])) < 0
    else:
        assert surface[:, 0].max() > 0.4 and cells[:, 0].max() > 0.4


def test_each_point_goes_to_the_nearest_surface() -> None:
    """As the slow, obvious way finds it, far from the origin."""
    generator = np.random.default_rng(5)
    points, *surfaces = (
        (generator.random((count, 3)) + (1e3, -2e3, 5.0)).astype(np.float32)
        for count in (200, 1, 30, 60)
    )
    distances = [
        np.linalg.norm(points[:, None].astype(float) - surface, axis=2).min(axis=1)
        for surface in surfaces
    ]
    assert (_nearest(points, surfaces) == np.argmin(distances, axis=0)).all()


CHAIR_FRONT = slab((0, 0, 1), (0.5, 0.6, 0.004))
PART = slab((0, 0.1, 0.998), (0.3, 0.25, 0.004))


@pytest.mark.parametrize(
    "large, small",
    [
        pytest.param(CHAIR_FRONT, slab((0.05, 0.1, 0.99), (0.2, 0.26, 0.004)), id="book on chair"),
        pytest.param(
            slab((0, 0, 1), (0.3, 0.3, 0.004)),
            slab((0.05, 0.05, 0.98), (0.1, 0.1, 0.004)),
            id="cup on box",
        ),
        pytest.param(
            slab((0, 0, 1), (0.95, 0.6, 0.004)),
            slab((0.2, 0.1, 0.99), (0.24, 0.16, 0.004)),
            id="remote on couch",
        ),
    ],
)
def test_a_thing_that_lies_wholly_on_a_larger_one_is_a_node(scene, large, small) -> None:
    """Masks of the larger thing include the smaller, until it is detected apart."""
    assert scene.see((large, CHAIR), (small, None), make=view, times=3) == [1]
    assert scene.see((small, CUP), (large, None), make=view) == [2]
    assert scene.see((large, CHAIR), (small, CUP), make=view) == [1, 2]
    # The larger one alone, its mask over both, is no evidence that they are one.
    for _ in range(20):
        assert scene.see((large, CHAIR), (small, None), make=view) == [1]
    assert scene.see((small, CUP), (large, None), make=view) == [2]


@pytest.mark.parametrize(("score", "removals"), [(0.3, {2: 1, 3: 1}), (0.9, {})])
def test_a_second_box_on_an_object_is_an_object_if_it_is_sure(scene, score, removals) -> None:
    scene.see((CHAIR_FRONT, CHAIR), make=view, times=3)
    changes = {"scores": np.array([0.8, score])}
    ids = scene.see((CHAIR_FRONT, CHAIR), (PART, CHAIR), make=view, times=20, **changes)
    assert scene.graph.take_removals() == removals
    assert ids == ([1, 2] if not removals else ids)


def test_observations_are_weighted_by_pixels(scene) -> None:
    means = []
    for points, pixels in ((LEFT, 1000), (WHOLE, 9000)):
        scene.see((points, TABLE), pixel_counts=np.array([pixels]))
        means.append(frame(0, (points, TABLE)).means_world[0])
    assert scene.graph.nodes.means[0] == pytest.approx((means[0] + 9 * means[1]) / 10)
    assert scene.graph.nodes.observations.tolist() == [2]


# --- absent and moved objects --------------------------------------------------------------------

THERE = slab((-0.4, -0.1, 0.7), (0.08, 0.08, 0.06))


def before_wall(stamp: int, *objects: Seen) -> LocalGraph:
    shown = (points for points, kind in objects if kind != TABLE)
    return frame(stamp, *objects, depth_grid=depth_grid(*shown))


class Room(Scene):
    """A cup before a wall, and a table behind it."""

    def __init__(self) -> None:
        super().__init__()
        self.see((WHOLE, TABLE), (HERE, CUP), times=4)
        assert self.published() == {1: "table", 2: "cup"}

    def see(self, *objects: Seen, **changes) -> list[int]:
        return super().see(*objects, **{"make": before_wall, **changes})


@pytest.fixture
def room() -> Room:
    return Room()


def test_a_node_is_removed_after_five_frames_that_see_through_it(room) -> None:
    room.see((WHOLE, TABLE), times=4)
    assert room.published() == {1: "table", 2: "cup"}
    room.see((WHOLE, TABLE))
    assert room.published() == {1: "table"}
    assert len(room.graph) == 2  # it is lost; after a time it is removed
    room.see((WHOLE, TABLE), times=902)
    assert len(room.graph) == 1


BLIND = DepthGrid(np.zeros((60, 80), np.uint16), 8, CAMERA)
TURNED = np.diag([-1.0, 1.0, -1.0, 1.0])  # half a turn about y


@pytest.mark.parametrize(
    ("seen", "grids", "changes"),
    [
        pytest.param([(WHOLE, TABLE)], [depth_grid(HERE)] * 10, {}, id="not detected"),
        # Only consecutive frames that see through it count.
        pytest.param(
            [(WHOLE, TABLE)], 5 * [*[depth_grid()] * 3, depth_grid(HERE)], {}, id="at times absent"
        ),
        pytest.param([], [depth_grid(background_m=0.4)] * 10, {}, id="occluded"),
        pytest.param([], [BLIND] * 10, {}, id="blind"),
        pytest.param(
            [], [depth_grid(background_m=4.0)] * 10, {"T_world_camera": TURNED}, id="out of view"
        ),
        pytest.param([], [None], {"stamp_ns": 10**12}, id="no depth"),
    ],
)
def test_an_object_that_may_be_there_stays(room, seen, grids, changes) -> None:
    room.see((WHOLE, TABLE), (HERE, CUP), times=8)
    for grid in grids:
        room.see(*seen, make=frame, depth_grid=grid, **changes)
    assert room.published() == {1: "table", 2: "cup"}


def test_a_moved_object_keeps_its_id(room) -> None:
    assert room.see((WHOLE, TABLE), (THERE, CUP), times=8) == [1, 2]
    assert room.published() == {1: "table", 2: "cup"}
    slot = room.graph.nodes.slot(2)
    assert room.graph.nodes.means[slot] == pytest.approx(THERE.mean(axis=0), abs=1e-3)
    assert room.graph.nodes.observations[slot] == 12
    assert room.see((THERE, CUP)) == [2]
    assert room.graph.take_removals() == {3: 2}


@pytest.mark.parametrize(
    ("kind", "pause", "same"), [(CUP, 0, True), (CHAIR, 0, False), (CUP, 901, False)]
)
def test_an_absent_object_keeps_its_id_for_a_while(room, kind, pause, same) -> None:
    room.see((WHOLE, TABLE), times=8)
    assert room.published() == {1: "table"}
    room.see((WHOLE, TABLE), times=pause)
    room.see((WHOLE, TABLE), (THERE, kind), times=12)
    assert room.published() == {1: "table", 2 if same else 3: VOCABULARY.classes[kind]}


def test_a_tentative_node_that_is_seen_through_is_removed(scene) -> None:
    scene.see((WHOLE, TABLE), make=before_wall, times=5)
    scene.see((WHOLE, TABLE), (HERE, CUP), make=before_wall)
    scene.see((WHOLE, TABLE), make=before_wall, times=6)
    assert list(scene.graph.nodes.slot_of) == [1]


def test_another_least_probability_publishes_and_hides_what_is_known(scene) -> None:
    scene.see((WHOLE, TABLE), (ON_TABLE, CUP))
    existence = scene.graph.nodes.existence[scene.graph.nodes.slots]
    assert scene.published() == {} or existence.min() >= 0.5
    for least in (0.0, 1.0, 0.5, float(existence.max()), 0.0):
        scene.merging.publish_from(scene.graph, least)
        assert len(scene.published()) == np.count_nonzero(existence >= least)
