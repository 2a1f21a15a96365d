"""Messages of nodes: distributions, boxes against gravity, surface points, and what waits."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET
from support.merging import VOCABULARY, node_states

from deworldsg_ros.graph.extent import (
    box_of,
    even_moments,
    extents_of,
    horizontal_axes,
    rounded,
    surface_bytes,
    surface_points,
)
from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import Ends, NodeBoxes, NodeStates, listed
from deworldsg_ros.scene.camera import pose_from_quaternion
from deworldsg_ros.wire import messages as wire

NAMES = tuple("abcdefgh")
Z = (0.0, 0.0, 1.0)

# --- distributions -------------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [1, 2, 4, 10, 64])
def test_the_best_labels_the_rest_and_the_entropy(frames: int) -> None:
    rng = np.random.default_rng(frames)
    # Means of rounded numbers: many lie half-way between two rounded ones.
    seen = np.round(rng.dirichlet(np.full(len(NAMES), 0.3), (2000, frames)), 4)
    rows = np.concatenate([seen.mean(axis=1), np.eye(len(NAMES)), np.full((1, 8), 0.125)])
    for row, told in zip(rows, listed(rows, NAMES, 3)):
        best = (-row).argsort(kind="stable")[:3].tolist()
        expected = [(NAMES[index], round(float(row[index]), 4)) for index in best]
        assert [(item.label, item.probability) for item in told.beliefs] == expected
        listed_sum = sum(share for _, share in expected)
        assert told.remainder == round(max(float(row.sum()) - listed_sum, 0.0), 4)
        positive = row[row > 0]
        assert told.entropy_nats == pytest.approx(-(positive @ np.log(positive)), abs=5.1e-5)


def test_no_distributions_and_fewer_labels_than_are_listed() -> None:
    assert listed(np.zeros((0, 8)), NAMES, 3) == []
    (told,) = listed(np.array([[0.25, 0.75]]), ("a", "b"), 5)
    assert [(item.label, item.probability) for item in told.beliefs] == [("b", 0.75), ("a", 0.25)]
    assert told.remainder == 0.0


# --- messages ------------------------------------------------------------------------------------

CLASSES = np.array([0.5, 0.3, 0.15, 0.05])


@pytest.fixture
def points() -> np.ndarray:
    """A slab: 0.6 x 0.4 x 0.1 m."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 3)) * [0.6, 0.4, 0.1] + 1.0
    return points.astype(np.float32)


def graph_of_one(points: np.ndarray) -> GlobalGraph:
    graph = GlobalGraph(VOCABULARY, "world")
    graph.add_node(points.mean(axis=0), np.cov(points.T), CLASSES, 1_500_000_000, points)
    return graph


def test_the_message_of_a_node(points: np.ndarray) -> None:
    graph = graph_of_one(points)
    (state,) = node_states(graph, 2, with_points=True).values()
    assert state.label == "cup" and [belief.label for belief in state.classes] == ["cup", "table"]
    assert sum(belief.probability for belief in state.classes) == pytest.approx(0.8)
    assert state.remainder == pytest.approx(0.2)
    assert state.observations == 1 and state.confirmed
    assert state.first_seen == state.last_seen == wire.Stamp(1, 500_000_000)
    assert sorted(state.box.size_m) == pytest.approx([0.1, 0.4, 0.6], abs=0.04)
    assert len(surface_points(state)) == 300
    assert len(surface_points(node_states(graph, 2)[1])) == 0
    assert [len(str(value).split(".")[1]) <= 4 for value in state.mean_m] == [True] * 3
    assert np.linalg.eigvalsh(np.reshape(state.covariance_m2, (3, 3))).min() > 0
    assert b"surface_points_m" not in msgspec.json.encode(state)


def test_a_node_without_a_probable_name_is_an_object(points: np.ndarray) -> None:
    graph = graph_of_one(points)
    for min_name, label in ((0.5, "cup"), (0.51, "object")):
        states = NodeStates(graph, 2, min_name)
        states.refresh()
        state = states.states[1]
        assert (state.label, state.named) == (label, label == "cup")
        assert state.classes[0] == wire.Belief("cup", 0.5)


def test_only_a_real_turn_of_up_makes_new_boxes(points: np.ndarray) -> None:
    states = NodeStates(graph_of_one(points), 2, 0.0)
    assert states.refresh() == [1]
    before = states.states[1]
    states.set_up(np.array([0.0, 0.01, 0.99995]))
    assert states.refresh() == []
    states.set_up(np.array([0.0, 1.0, 0.0]))
    assert states.refresh() == [1]
    after = states.states[1]
    assert (before.box.size_m[2], after.box.size_m[2]) == pytest.approx((0.1, 0.4), abs=0.04)


# --- boxes and moments of surfaces ---------------------------------------------------------------


def shell(rng: np.random.Generator, count: int, size: np.ndarray) -> np.ndarray:
    """Points (count, 3) on the faces of a box around the origin."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    axis = rng.integers(0, 3, count)
    points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    return points * size


@pytest.mark.parametrize("up", [Z, (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.1, 0.2, 0.95)])
@pytest.mark.parametrize("heading", [0.0, 0.3, 1.2])
def test_a_box_is_found_in_every_world(up, heading) -> None:
    rng = np.random.default_rng(1)
    size = np.array([0.6, 0.3, 0.9])
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ horizontal_axes(up)
    points = shell(rng, 512, size) @ turn + [1.0, 2.0, 3.0]
    box = box_of(points.astype(np.float32), up)
    assert sorted(box.size_m) == pytest.approx(sorted(size), abs=0.02)
    assert box.center_m == pytest.approx([1.0, 2.0, 3.0], abs=0.01)
    rotation = pose_from_quaternion(np.zeros(3), np.array(box.orientation_xyzw))[:3, :3]
    assert rotation[:, 2] == pytest.approx(np.array(up) / np.linalg.norm(up), abs=1e-3)
    inside = np.abs((points - box.center_m) @ rotation) <= np.array(box.size_m) / 2 + 2e-3
    assert inside.all(axis=1).mean() > 0.98


def test_a_box_is_along_the_sides_that_are_seen_and_around_the_main_parts() -> None:
    rng, length, depth = np.random.default_rng(3), 0.7, 0.6
    # Front and one side of a cabinet: the rectangle along the diagonal is as small. And a part of
    # the floor.
    front = np.column_stack([rng.uniform(0, length, 200), np.zeros(200), rng.uniform(0, 1, 200)])
    side = np.column_stack([np.zeros(150), rng.uniform(0, depth, 150), rng.uniform(0, 1, 150)])
    floor = rng.uniform((1.2, 0.0, 0.0), (1.4, 0.2, 0.0), (20, 3))
    points = np.concatenate([front, floor, side]).astype(np.float32)[None]
    known = points, np.array([370]), np.array([0]), Z
    (extent,) = extents_of(*known, np.ones((1, 370), np.bool_))
    assert extent.box.size_m == pytest.approx([length, depth, 1.0], abs=0.02)
    # Points that the images do not show as the object's are outside.
    shown = np.arange(370)[None] < 200
    (thin,) = extents_of(*known, shown)
    assert sorted(thin.box.size_m[:2]) == pytest.approx([0.0, length], abs=0.02)
    # Without images, as with the paper's rule: the smallest box, around everything.
    (smallest,) = extents_of(*known)
    assert max(smallest.box.size_m) > 1.1


@pytest.mark.parametrize("heading", [0.0, 0.35, 0.7])
def test_what_has_no_heading_lies_along_the_room_and_what_is_askew_does_not(heading) -> None:
    def turned(points: np.ndarray, by: float) -> np.ndarray:
        c, s = np.cos(by), np.sin(by)
        return (points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])).astype(np.float32)

    def along(state: wire.NodeState, by: float) -> float:
        """How far a box is turned from a heading, degrees, modulo quarter turns."""
        x, y = pose_from_quaternion(np.zeros(3), np.array(state.box.orientation_xyzw))[:2, 0]
        return float((np.degrees(np.arctan2(y, x) - by) + 45) % 90 - 45)

    rng = np.random.default_rng(4)
    desks = [turned(shell(rng, 400, np.array([1.4, 0.7, 0.75])), heading) for _ in range(3)]
    chair = turned(shell(rng, 400, np.array([0.5, 0.4, 0.9])), heading + 0.5)
    angle, radius = rng.uniform(0, 2 * np.pi, 300), 0.12 * np.sqrt(rng.uniform(0, 1, 300))
    plate = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(300)])
    graph = GlobalGraph(VOCABULARY, "world")
    boxes = NodeBoxes(graph.nodes, lambda slots: np.ones((len(slots), 512), np.bool_))
    states, found = NodeStates(graph, 2, 0.0, boxes), []
    for number, points in enumerate([plate.astype(np.float32), chair, *desks]):
        points = points + np.array([3.0 * number, 0, 0], np.float32)
        covariance = np.cov(points.T) + 1e-4 * np.eye(3)
        graph.add_node(points.mean(axis=0), covariance, CLASSES, number + 1, points)
        states.refresh()
        found.append(states.heading.step)
    # The chair and two desks are the first three, and the plate, told before, is told again.
    assert found[:3] == [None] * 3 and found[4] is not None
    told = states.states
    assert [along(told[node], heading) for node in (1, 3, 4, 5)] == pytest.approx([0] * 4, abs=3)
    assert along(told[2], heading + 0.5) == pytest.approx(0, abs=3)


def seat(**counts: tuple[int, int, int]) -> Ends:
    """A seat whose ends ten frames have shown; by name: frames that show, cut, and go on."""
    names = ["left", "right", "back", "front", "below", "above"]
    ends = Ends.of(wire.GravityBox([0, 0, 0.4], [0.4, 0.4, 0.1], [0, 0, 0, 1]))
    ends.rests_m = (0.35,) * 3
    for index, name in enumerate(names):
        ends.counts[index // 2, index % 2] = counts.get(name, (10, 0, 0))
    return ends


@pytest.mark.parametrize(
    ("counts", "rests", "open_sides"),
    [
        ({}, 3, None),
        ({"left": (0, 2, 0)}, 3, [True, False, False]),
        ({"front": (1, 9, 0)}, 3, [False, True, False]),
        ({"front": (2, 9, 0)}, 3, None),
        ({"above": (5, 0, 5)}, 3, [False, False, True]),
        # No frame has told.
        ({"right": (0, 0, 0)}, 3, [True, False, False]),
        # It rests on nothing, and nothing hides its back; or it may hang on a wall.
        ({}, 2, [False, False, True]),
        ({"back": (2, 9, 0)}, 2, None),
        ({"below": (3, 0, 0)}, 2, None),
    ],
)
def test_which_sides_of_a_box_may_go_on(counts, rests, open_sides) -> None:
    ends = seat(**counts)
    ends.rests_m = ends.rests_m[:rests]
    box = wire.GravityBox([0, 0, 0.4], [0.4, 0.4, 0.1], [0, 0, 0, 1])
    assert ends.open_sides(box) == (UNSET if open_sides is None else open_sides)
    # Where the box ends elsewhere by now, no frame has shown its end.
    longer = wire.GravityBox([0.1, 0, 0.4], [0.6, 0.4, 0.1], [0, 0, 0, 1])
    assert ends.open_sides(longer)[0]


def test_few_points_and_points_at_nearly_one_place_have_a_box() -> None:
    for count in (1, 2, 3, 7):
        box = box_of(np.arange(3.0 * count).reshape(count, 3), Z)
        assert box.size_m[2] == pytest.approx(3.0 * (count - 1))
    tiny = np.array([[0.0, 0.0, 0.0], [5e-324, 0.0, 0.0], [0.0, 5e-324, 0.0]])
    assert box_of(tiny, Z).size_m == even_moments(tiny)[0].tolist() == [0.0, 0.0, 0.0]
    mean, covariance = even_moments(np.full((1, 3), 1.005, np.float32))
    assert np.allclose(mean, 1.005) and np.linalg.eigvalsh(covariance).min() > 0
    assert str(rounded(np.array([-1e-9, 0.12345]), 3)) == "[0.0, 0.123]"


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_points_that_no_kernel_may_see_are_refused(bad: float) -> None:
    points = np.array([[0.0, 0.0, 0.0], [bad, 0.0, 0.0]])
    for call in (lambda: box_of(points, Z), lambda: even_moments(points)):
        with pytest.raises(ValueError, match="points contain"):
            call()
    with pytest.raises(ValueError, match="without points"):
        box_of(np.zeros((0, 3)), Z)


def test_even_moments_lean_less_to_where_points_are_dense() -> None:
    rng = np.random.default_rng(8)
    plate = rng.uniform((-0.3, -0.2, 0.0), (0.3, 0.2, 0.001), (4000, 3))
    looked_at_long = rng.uniform((0.2, -0.2, 0.0), (0.3, 0.2, 0.001), (20_000, 3))
    points = np.concatenate((plate, looked_at_long)).astype(np.float32)
    assert points.mean(axis=0)[0] > 0.15
    mean, covariance = even_moments(points)
    assert 0.0 < mean[0] < 0.75 * points.mean(axis=0)[0]
    assert np.abs(mean[1:]).max() < 0.005
    assert np.sqrt(covariance[1, 1]) == pytest.approx(0.4 / 12**0.5, rel=0.1)
    assert np.array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0


# --- surface points as bytes ---------------------------------------------------------------------


def node(mean: list[float], **content: object) -> wire.NodeState:
    never = wire.Stamp(0, 0)
    return wire.NodeState(1, "cup", [], mean, [0.0] * 9, 1, never, never, **content)


@given(st.integers(0, 50), st.integers(0, 2**32))
def test_points_survive_as_bytes_to_the_millimetre(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-50, 50, 3).round(3).tolist()
    points = (mean + rng.normal(0, 1, (count, 3))).astype(np.float32)
    state = node(mean, surface_mm=surface_bytes(points, mean))
    sent = msgspec.json.decode(msgspec.json.encode(state), type=wire.NodeState)
    assert surface_points(sent) == pytest.approx(points, abs=6e-4)


def test_points_of_version_1_and_broken_bytes() -> None:
    origin = [0.0] * 3
    assert surface_points(node(origin)).shape == (0, 3)
    old = node(origin, surface_points_m=[[1.0, 2.0, 3.0]])
    assert surface_points(old).tolist() == [[1.0, 2.0, 3.0]]
    assert surface_points(node(origin, surface_mm=b"12345")).shape == (0, 3)
    far = np.array([[40.0, 0.0, 0.0], [1.0, 0.0, 0.0]], np.float32)
    assert len(surface_points(node(origin, surface_mm=surface_bytes(far, origin)))) == 1
