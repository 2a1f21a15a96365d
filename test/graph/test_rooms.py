"""Rooms and storeys: free space divided by doorways, ids that stay, names by what is inside."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.homes import CEILING_M, Home, home, nodes_of, poses, see
from bench.rooms import Counts, truth_of
from deworldsg_ros.graph.provenance import SeenSpace
from deworldsg_ros.graph.rooms import CELL_M, RoomMap, divided, floors_m, kinds_of
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.vocabulary import ROOM_KINDS, ROOM_PRIOR, THINGS_OF_ROOMS
from deworldsg_ros.wire import messages as wire

UP = (0.0, 0.0, 1.0)


def plan(width_m: float, height_m: float, *solid: tuple[float, float, float, float]) -> np.ndarray:
    """Free space of a rectangle without some solid ones (x0, y0, x1, y1), metres."""
    inside = np.ones((round(height_m / CELL_M), round(width_m / CELL_M)), bool)
    for x0, y0, x1, y1 in solid:
        rows = slice(round(y0 / CELL_M), round(y1 / CELL_M))
        inside[rows, round(x0 / CELL_M) : round(x1 / CELL_M)] = False
    return np.pad(inside, 2)


def wall(opening_m: float) -> list[tuple[float, float, float, float]]:
    """A wall across a place of 8 m by 4 m, with an opening in its middle."""
    return [(3.9, 0, 4.0, 2 - opening_m / 2), (3.9, 2 + opening_m / 2, 4.0, 4)]


@pytest.mark.parametrize(
    ("inside", "rooms"),
    [
        (plan(8, 4), 1),
        (plan(8, 4, *wall(0.9)), 2),
        (plan(8, 4, *wall(0.6)), 2),
        (plan(8, 4, *wall(2.5)), 1),  # a wide opening
        (plan(8, 4, (3.9, 0, 4.0, 4)), 2),  # no opening at all
        (plan(6, 6, (3, 3, 6, 6)), 1),  # the shape of an L
        (plan(12, 1.2), 1),  # a corridor
        # A corridor with three rooms on one side.
        (
            plan(9, 4.3, *[(x, 1.2, x + 0.1, 4.3) for x in (3, 6)],
                 *[(x, 1.2, x + 2.2, 1.3) for x in (-0.0, 3.0, 6.0)]),
            4,
        ),
        (plan(4, 4, (0.0, 1.0, 0.7, 1.1), (0.7, 0, 0.8, 0.3)), 1),  # a niche is too small
    ],
)  # fmt: skip
def test_doorways_divide_and_nothing_else_does(inside: np.ndarray, rooms: int) -> None:
    parts, distance = divided(inside)
    assert parts.max() == rooms
    assert ((parts > 0) == inside).all() and (distance[~inside] == 0).all()
    for turned in (inside[::-1], inside[:, ::-1], inside.T):
        assert divided(np.ascontiguousarray(turned))[0].max() == rooms


@settings(max_examples=15, deadline=None)
@given(
    split_m=st.floats(2.5, 5.5), opening_m=st.floats(0.6, 1.0), at_m=st.floats(0.2, 2.6)
)  # fmt: skip
def test_the_border_is_in_the_doorway(split_m: float, opening_m: float, at_m: float) -> None:
    """Each side of a wall is one room, wherever the wall and its door are."""
    solid = [(split_m, 0, split_m + 0.1, at_m), (split_m, at_m + opening_m, split_m + 0.1, 4)]
    parts, _ = divided(plan(8, 4, *solid))
    left = parts[2:-2, 2 : 2 + round((split_m - 0.3) / CELL_M)]
    right = parts[2:-2, 2 + round((split_m + 0.4) / CELL_M) : -2]
    assert len(np.unique(left)) == len(np.unique(right)) == 1
    assert left[0, 0] != right[0, 0]


@pytest.fixture(scope="module")
def made() -> Home:
    return home(1)


@pytest.fixture(scope="module")
def walks(made: Home) -> list[SeenSpace]:
    """The views of a walk: after a half of it, and at its end, where the first views are gone."""
    space, found = SeenSpace(), []
    walk = poses(made, 5, spots=1, turns=8)
    for part in (walk[: len(walk) // 2], walk[len(walk) // 2 :]):
        see(space, made.boxes, part, len(found))
        found.append(SeenSpace())
        found[-1].restore(space.arrays())
        space.__init__()
    return found


@pytest.fixture(scope="module")
def rooms(walks: list[SeenSpace]) -> list[RoomMap]:
    half = RoomMap().found_in(walks[0], UP)
    return [half, half.found_in(walks[1], UP)]


def true_rooms(made: Home, rooms: RoomMap) -> dict[int, int]:
    """The room of the home that each found one is, by id."""
    (storey,) = rooms.storeys
    truth = truth_of(made, storey)
    return {i: int(np.bincount(truth[storey.ids == i]).argmax()) - 1 for i in rooms.ids}


def test_the_rooms_of_a_home_are_found(made: Home, rooms: list[RoomMap]) -> None:
    (storey,) = rooms[1].storeys
    counts = Counts()
    counts.add(truth_of(made, storey), storey.ids)
    assert counts.f1 >= 0.9
    assert rooms[1].floors_m == [pytest.approx(0.0, abs=0.03)]
    doors = {(min(a, b), max(a, b)) for _, a, b in made.doors}
    true_of = true_rooms(made, rooms[1])
    states = rooms[1].states([])
    found = {tuple(sorted((true_of[room.id], true_of[door.to])))
             for room in states for door in room.doorways}  # fmt: skip
    assert found == doors
    for room in states:
        assert all(0.6 <= door.width_m <= 1.4 for door in room.doorways)


def test_ids_stay_while_the_first_views_are_forgotten(
    made: Home, rooms: list[RoomMap], walks: list[SeenSpace]
) -> None:
    half, whole = rooms
    assert half.ids < whole.ids
    # An id is that of the same room, and what the second walk does not show is as it was.
    before, after = (true_rooms(made, one) for one in rooms)
    assert before == {room: after[room] for room in before}
    first, last = (
        {room.id: room.area_m2 for room in one.states([]) if after[room.id] in (1, 2)}
        for one in rooms
    )
    assert len(first) == 2 and last == pytest.approx(first, rel=0.05)
    # The same again changes no id.
    again = whole.found_in(walks[1], UP)
    assert again.ids == whole.ids and again.next_id == whole.next_id
    assert np.mean(again.storeys[0].ids == whole.storeys[0].ids) > 0.99


def test_objects_are_in_rooms_and_give_them_their_names(made: Home, rooms: list[RoomMap]) -> None:
    nodes = nodes_of(made, 3)
    states = rooms[1].states(nodes)
    true_of, right = true_rooms(made, rooms[1]), []
    for room in states:
        row = true_of[room.id]
        right += [made.things[item.id - 1].room == row for item in room.objects
                  if item.probability > 0.5]  # fmt: skip
        assert sum(kind.probability for kind in room.kinds) <= 1.0 + 1e-6
        if room.named:
            assert room.label == made.kinds[row]
    assert len(right) >= 0.9 * len(made.things) and np.mean(right) > 0.95
    assert sum(room.named for room in states) >= len(states) - 2


def test_an_operator_names_a_room_and_a_map_keeps_it(made: Home, rooms: list[RoomMap]) -> None:
    room_id = min(rooms[1].ids)
    named = rooms[1].named(room_id, "Anna's room")
    kept = RoomMap.restored(named.arrays())
    for one in (named, kept):
        state = next(room for room in one.states([]) if room.id == room_id)
        assert (state.label, state.named, state.label_provenance) == (
            "Anna's room", True, "operator",
        )  # fmt: skip
    assert kept.states(nodes_of(made, 3)) == named.states(nodes_of(made, 3))
    assert kept.named(room_id, "").states([]) == rooms[1].states([])
    with pytest.raises(RefusedInput, match="room 99 is unknown; rooms: 1"):
        named.named(99, "attic")
    assert RoomMap.restored({}).states([]) == [] and RoomMap().arrays() == {}


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("rooms", np.frombuffer(b"{}", np.uint8)),
        ("rooms", np.zeros(3)),
        ("room_cells.0", np.zeros((4, 4))),
        ("room_cells.0", np.full((4, 4), 2**31, np.uint32)),  # a room that was never given
        ("room_cells.0", None),
    ],
)
def test_broken_rooms_of_a_map_are_refused(
    rooms: list[RoomMap], name: str, values: np.ndarray | None
) -> None:
    arrays = rooms[1].arrays()
    arrays[name] = values
    if values is None:
        del arrays[name]
    with pytest.raises(ValueError, match=r"room|Object missing|expected"):
        RoomMap.restored(arrays)


def test_storeys_are_told_apart(made: Home, walks: list[SeenSpace]) -> None:
    """The same rooms once more, a storey above: the cameras are in both."""
    high = CEILING_M + 0.3
    both = SeenSpace()
    both.restore(walks[0].arrays())
    above = walks[0].poses.copy()
    above[:, 2, 3] += high
    for name in ("depths_mm", "cameras", "stamps_ns", "colours"):
        setattr(both, name, np.concatenate([getattr(both, name)] * 2))
    both.poses = np.concatenate([both.poses, above])
    found = RoomMap().found_in(both, UP)
    assert found.floors_m == [pytest.approx(0.0, abs=0.03), pytest.approx(high, abs=0.03)]
    lower, upper = ({int(i) for i in np.unique(one.ids) if i} for one in found.storeys)
    assert len(lower) == len(upper) >= 2 and not lower & upper
    nodes = nodes_of(made, 3)
    low = {item.id for room in found.states(nodes) if room.storey == 0 for item in room.objects}
    assert low and not any(r.objects for r in found.states(nodes) if r.storey == 1)


def test_without_depth_there_are_no_rooms(walks: list[SeenSpace]) -> None:
    assert RoomMap().found_in(SeenSpace(), UP).states([]) == []
    empty = SeenSpace()
    empty.restore({**walks[0].arrays(), "view_depths_mm": walks[0].depths_mm * 0})
    assert RoomMap().found_in(empty, UP).states([]) == []
    assert floors_m([]) == []
    far = SeenSpace()
    far.restore(walks[0].arrays())
    far.poses[0, 2, 3] = -1e8  # of a damaged file
    assert RoomMap().found_in(far, UP).ids


def test_kinds_are_the_posterior_of_the_table() -> None:
    """Against Bayes' rule, written out for one thing; more of a class tell nothing more."""
    node = nodes_of(home(1), 1)[0]
    (sure,) = [wire.Belief("oven", 1.0)]
    oven = wire.NodeState(
        1, "oven", [sure], [0.0, 0.0, 0.0], node.covariance_m2, 1, node.first_seen, node.last_seen
    )
    prior, likely = np.array(ROOM_PRIOR), THINGS_OF_ROOMS["oven"]
    expected = prior * (likely / (prior @ likely)) ** 0.7
    expected /= expected.sum()
    found = {kind.label: kind.probability for kind in kinds_of([(oven, 1.0)], 0, 5.0)}
    assert found == pytest.approx(dict(zip(ROOM_KINDS, expected)), abs=1e-3)
    assert sum(ROOM_PRIOR) == pytest.approx(1.0)
    twice = kinds_of([(oven, 1.0), (oven, 1.0)], 0, 5.0)
    assert twice == kinds_of([(oven, 1.0)], 0, 5.0)
    # What is not in the room tells nothing; what may be, tells less.
    nothing = {kind.label: kind.probability for kind in kinds_of([(oven, 0.0)], 0, 5.0)}
    assert nothing == pytest.approx(dict(zip(ROOM_KINDS, prior)), abs=1e-3)
    maybe = {kind.label: kind.probability for kind in kinds_of([(oven, 0.3)], 0, 5.0)}
    assert nothing["kitchen"] < maybe["kitchen"] < found["kitchen"]
    assert kinds_of([], 4, 1.4)[0].label == "hallway"
