"""An operator's edits hold for later frames, and undo brings back what was before."""

import msgspec
import numpy as np
import pytest
from msgspec import UNSET
from support.merging import VOCABULARY
from support.surfaces import CHAIR, CUP, HERE, TABLE, frame, slab, view

from deworldsg_ros.config import Config, MergingConfig, OutputConfig
from deworldsg_ros.graph.edits import MAX_UNDO, DeleteNode, MergeNodes, SetLabel, SplitNode, Undo
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import copy_state, read_map, write_map
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.wire import messages as wire

# A long table as two halves, which a detector may see as two tables, and something in its place.
LEFT, RIGHT = slab((-0.3, 0.1, 0.7), (0.5, 0.3, 0.01)), slab((0.22, 0.1, 0.7), (0.5, 0.3, 0.01))
LONG = np.concatenate([LEFT, RIGHT])
WHOLE = slab((0, 0, 0.95), (1.2, 0.8, 0.01))
BESIDE = slab((-0.5, -0.3, 0.7), (0.1, 0.1, 0.1))


def builder_of(association: str = "surface") -> GraphBuilder:
    config = Config(
        merging=MergingConfig(association=association), output=OutputConfig(min_existence=0.0)
    )
    return GraphBuilder(config, VOCABULARY, "world")


class Room:
    """A graph that sees the same objects frame by frame."""

    def __init__(self, *objects: tuple[np.ndarray, int], association: str = "surface") -> None:
        self.builder = builder_of(association)
        self.stamp = 0
        self.objects = objects
        self.see(5)

    def see(self, frames: int = 1, *objects: tuple[np.ndarray, int]) -> list[int]:
        node_ids: list[int] = []
        for _ in range(frames):
            self.stamp += 1
            node_ids = self.builder.integrate(view(self.stamp, *(objects or self.objects)))
        return node_ids

    def labels(self) -> dict[int, str]:
        return {node.id: node.label for node in self.builder.full().nodes}

    def full(self) -> tuple[list[wire.NodeState], list[wire.EdgeState]]:
        message = self.builder.full()
        return message.nodes, message.edges


RULES = pytest.mark.parametrize("association", ["surface", "paper"])


@RULES
def test_a_label_stays_and_tells_who_said_it(association):
    room = Room((HERE, CUP), association=association)
    before = room.full()
    room.builder.update()
    reply = room.builder.edit(SetLabel(1, "chair"))
    assert (reply.kind, reply.nodes) == ("set_label", [1])
    (state,) = room.builder.update().nodes
    assert (state.label, state.label_provenance) == ("chair", "operator")
    assert state.classes == [wire.Belief("chair", 1.0)] and state.entropy_nats == 0.0
    room.builder.edit(Undo())
    assert room.full() == before
    with pytest.raises(RefusedInput, match="blank"):
        room.builder.edit(SetLabel(1, " "))
    room.builder.edit(SetLabel(1, "chair"))
    assert room.see(20) == [1]  # the detector goes on to call it a cup: that is this object
    room.builder.edit(SetLabel(1, "Anna's mug"))  # in no vocabulary
    for label in ("Anna's mug", "chair", "cup"):
        assert room.labels() == {1: label}
        if label != "cup":
            room.builder.edit(Undo())
    # A frame may show and miss nothing.
    away = np.eye(4)
    away[:3, 3] = [50.0, 0.0, 0.0]
    assert room.builder.integrate(frame(room.stamp + 1, T_world_camera=away)) == []


@RULES
@pytest.mark.parametrize("away", [0, 20])
def test_a_deleted_object_stays_deleted_and_others_may_take_its_place(association, away):
    room = Room((HERE, CUP), (WHOLE, TABLE), association=association)
    assert room.labels() == {1: "cup", 2: "table"}
    room.builder.update()
    room.builder.edit(DeleteNode(1))
    assert [gone.id for gone in room.builder.update().removed_nodes] == [1]
    room.see(away, (WHOLE, TABLE))
    room.see(20)
    assert room.labels() == {2: "table"}
    hidden = room.builder.full().hidden
    assert [(item.label, item.reason) for item in hidden] == [("cup", "deleted by the operator")]
    assert room.builder.hidden == {"deleted by the operator": 1}
    # Something of another class in the same place is another object.
    room.see(5, (HERE, CHAIR), (WHOLE, TABLE))
    assert sorted(room.labels().values()) == ["chair", "table"]
    room.builder.edit(Undo())
    assert room.labels()[1] == "cup"


def test_merged_objects_stay_one_though_the_detector_sees_two():
    room = Room((LEFT, TABLE), (RIGHT, TABLE), (BESIDE, CUP))
    assert room.labels() == {1: "table", 2: "table", 3: "cup"}
    room.builder.update()
    before = room.full()
    reply = room.builder.edit(MergeNodes([2, 1]))
    assert reply.nodes == [4] and room.labels() == {3: "cup", 4: "table"}
    removed = room.builder.update().removed_nodes
    assert {gone.id: gone.merged_into for gone in removed if gone.id < 4} == {1: 4, 2: 4}
    node = room.builder.full().nodes[1]
    assert node.box.size_m[0] > 0.95  # both halves
    room.builder.edit(Undo())
    assert room.full() == before
    room.builder.edit(MergeNodes([1, 2]))
    for _ in range(20):
        one, two, cup = room.see()
        assert one == two != cup
    assert sorted(room.labels().values()) == ["cup", "table"]
    node = next(node for node in room.builder.full().nodes if node.label == "table")
    assert node.box.size_m[0] > 0.95 and node.existence > 0.5
    assert room.see(3, (LONG, TABLE)) == [one]
    room.builder.edit(Undo())
    assert sorted(room.labels()) == [1, 2, 3]
    assert room.see(3) == [1, 2, 3]


def test_a_split_stays_split_though_the_detector_sees_one():
    room = Room((LONG, TABLE), (BESIDE, CUP))
    before = room.full()
    reply = room.builder.edit(SplitNode(1))
    first, second = reply.nodes
    assert sorted(room.labels()) == [2, first, second] == [2, 3, 4]
    room.builder.edit(Undo())
    assert room.full() == before
    first, second = room.builder.edit(SplitNode(1)).nodes
    for _ in range(20):
        assert room.see()[0] in (first, second)
    states = {node.id: node for node in room.builder.full().nodes}
    assert states.keys() == {2, first, second}
    for node_id in (first, second):
        assert 0.4 < states[node_id].box.size_m[0] < 0.6
        assert states[node_id].existence > 0.5 and states[node_id].label == "table"
    # A detector that sees both finds both.
    assert set(room.see(1, (LEFT, TABLE), (RIGHT, TABLE))) == {first, second}
    room.builder.edit(Undo())
    assert sorted(room.labels()) == [1, 2]
    assert room.see(3) == [1, 2]


def test_a_split_takes_the_places_that_are_named():
    room = Room((LONG, TABLE))
    room.builder.edit(SplitNode(1, [[-0.5, 0.1, 0.7], [-0.1, 0.1, 0.7]]))
    widths = [node.box.size_m[0] for node in room.builder.full().nodes]
    assert sorted(np.round(widths, 1)) == [0.3, 0.8]


@pytest.mark.parametrize("count", [0, 1, 2, 15, 40])
def test_an_object_of_few_places_is_not_split(count):
    room = Room((BESIDE, CUP))
    slot = room.builder.graph.nodes.slot(1)
    room.builder.graph.nodes.set_surface(slot, np.tile(BESIDE[:1], (count, 1)))
    for places in (None, [[0, 0, 0], [1, 1, 1]], [[0, 0, 0], [0, 0, 0]]):
        with pytest.raises(RefusedInput, match="no two parts of at least 8"):
            room.builder.edit(SplitNode(1, places))
    assert room.see() == [1]


def test_a_single_point_is_no_part_of_a_cut_object():
    room = Room((LONG, TABLE))
    first, second = room.builder.edit(SplitNode(1)).nodes
    for count in (2, 3, 4):
        few = np.concatenate([LEFT[:1], RIGHT[: count - 1]])
        assert room.see(1, (few, TABLE))[0] in (first, second)
    assert all(np.isfinite(node.mean_m).all() for node in room.builder.full().nodes)


def test_edits_of_edited_objects_are_undone_newest_first():
    room = Room((LEFT, TABLE), (RIGHT, TABLE), (BESIDE, CUP))
    steps = []
    for request in (
        SetLabel(1, "chair"),
        MergeNodes([1, 2]),
        SplitNode(4),
        DeleteNode(3),
        MergeNodes([6, 7]),
    ):
        steps.append(room.full())
        room.builder.edit(request)
    assert list(room.labels().values()) == ["chair"]
    for before in reversed(steps):
        room.builder.edit(Undo())
        assert room.full() == before
    with pytest.raises(RefusedInput, match="nothing to undo"):
        room.builder.edit(Undo())


def closed(message: wire.SceneGraphMessage) -> wire.SceneGraphMessage:
    """Without the sides that may go on: a map does not keep which frames showed their ends."""

    def one(node: wire.NodeState) -> wire.NodeState:
        return msgspec.structs.replace(node, box=msgspec.structs.replace(node.box, at_least=UNSET))

    return msgspec.structs.replace(message, nodes=[one(node) for node in message.nodes])


@pytest.mark.parametrize("frames", [0, 6])
def test_edits_survive_a_map_and_continue_equally(tmp_path, frames):
    room = Room((LEFT, TABLE), (RIGHT, TABLE), (BESIDE, CUP))
    room.builder.edit(SetLabel(1, "chair"))
    merged = room.builder.edit(MergeNodes([1, 2])).nodes[0]
    room.builder.edit(DeleteNode(3))
    room.see(frames)
    write_map(room.builder, tmp_path / "room.map")
    write_map(room.builder, tmp_path / "again.map")
    first, second = (tmp_path / name for name in ("room.map", "again.map"))
    assert first.read_bytes() == second.read_bytes()
    config = Config(output=OutputConfig(min_existence=0.0))
    whole, again = room.builder, read_map(config, first)
    assert copy_state(again).keys() == copy_state(whole).keys()
    assert closed(again.full()) == closed(whole.full())
    whole.graph.take_removals()
    for stamp in range(room.stamp + 1, room.stamp + 6):
        local = view(stamp, *room.objects)
        assert again.integrate(local) == whole.integrate(local)
    assert [node.id for node in again.full().nodes] == [merged]
    for builder in (again, whole):
        assert builder.edit(Undo()).text == "undone: delete of 3"
        assert builder.edit(Undo()).nodes == [1, 2]
    assert closed(again.full()) == closed(whole.full())


@pytest.mark.parametrize(
    ("association", "request_", "message"),
    [
        ("surface", SetLabel(99, "cup"), "object 99 is not in the graph: it is gone, or never was"),
        ("surface", SetLabel(1, "cup"), "merged into object 4"),
        ("surface", SetLabel(3, "cup"), "hidden"),
        ("surface", SetLabel(4, "a\u009bb"), "control character"),
        ("surface", MergeNodes([4, 4]), "itself"),
        ("surface", MergeNodes([4, 8]), "object 8"),
        ("surface", DeleteNode(9), "object 9"),
        ("surface", SplitNode(4, [[5, 5, 5], [9, 9, 9]]), "no two parts of at least 8"),
        ("paper", Undo(), "nothing to undo"),
        ("paper", MergeNodes([1, 2]), "merging.association surface"),
        ("paper", SplitNode(1), "merging.association surface"),
    ],
)
def test_a_bad_edit_changes_nothing(association, request_, message):
    room = Room((LEFT, TABLE), (RIGHT, TABLE), (BESIDE, CUP), association=association)
    if association == "surface":
        room.builder.edit(MergeNodes([1, 2]))
        room.builder.edit(DeleteNode(3))
    before = copy_state(room.builder)
    with pytest.raises(RefusedInput, match=message) as refusal:
        room.builder.edit(request_)
    assert refusal.value.reason == "invalid_request"
    after = copy_state(room.builder)
    assert before.keys() == after.keys()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)


def test_old_edits_hold_but_cannot_be_undone():
    room = Room((LEFT, TABLE), (RIGHT, TABLE))
    for _ in range(MAX_UNDO + 1):
        nodes = sorted(room.labels())
        if len(nodes) == 2:
            last = room.builder.edit(MergeNodes(nodes)).nodes
        else:
            last = room.builder.edit(SplitNode(nodes[0])).nodes
    assert sorted(room.labels()) == sorted(last)
    assert len(room.builder.graph.edits.replaced) == 150  # two of each merge, one of each split
    for _ in range(MAX_UNDO):
        room.builder.edit(Undo())
    reply = room.builder.edit(Undo())
    assert "the objects before it are forgotten" in reply.text
    assert len(room.builder.graph) == len(room.labels()) == 1


def test_what_was_said_of_a_part_holds_when_the_other_part_goes(tmp_path):
    room = Room((LONG, TABLE))
    (whole,) = room.labels()
    room.builder.edit(SetLabel(whole, "bench"))
    left, right = room.builder.edit(SplitNode(whole)).nodes
    room.builder.graph.remove_node(left)
    assert room.labels() == {right: "bench"}
    assert [edit.nodes for edit in room.builder.graph.edits.edits] == [[right], [right]]
    assert len(room.builder.graph) == 1, "the whole table cannot come back"
    write_map(room.builder, tmp_path / "room.map")
    assert list(read_map(Config(), tmp_path / "room.map").graph.edits.labels) == [right]
    room.builder.graph.remove_node(right)  # an object that goes takes its edits with it
    assert not room.builder.graph.edits
