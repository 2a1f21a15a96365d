"""Rooms of the client: questions with rooms, names, and where an object is."""

import msgspec
import pytest
from support.view import make_graph, make_node
from typer.testing import CliRunner

from deworldsg_ros.cli.app import app
from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.mcp_server import GraphTools
from deworldsg_ros.client.questions import ask
from deworldsg_ros.graph.graph_files import write_graph
from deworldsg_ros.wire import messages as wire

OBJECTS = {1: "cup", 2: "cup", 3: "refrigerator", 4: "bed", 5: "desk"}
# Label, the probability of the kind, doors to, and objects. Room 4 has a name by hand.
ROOMS = {
    1: ("kitchen", 0.9, [2], {1: 0.95, 3: 1.0}),
    2: ("hallway", 0.8, [1, 3, 4], {2: 0.1}),
    3: ("bedroom", 0.7, [2], {2: 0.9, 4: 1.0}),
    4: ("Anna's room", 0.6, [2], {5: 1.0}),
    5: ("room", 0.3, [], {}),
}


def room(room_id: int) -> wire.RoomState:
    label, chance, doors, objects = ROOMS[room_id]
    by_hand, is_named = label == "Anna's room", label != "room"
    kind = "office" if by_hand or not is_named else label
    x = 4.0 * room_id
    return wire.RoomState(
        id=room_id,
        label=label,
        kinds=[wire.Belief(kind, chance), wire.Belief("laundry room", 0.1)],
        storey=0,
        outline_m=[[x, 0, 0], [x + 3, 0, 0], [x + 3, 3, 0], [x, 3, 0]],
        area_m2=9.0,
        doorways=[wire.Doorway(other, [x, 1.5, 0.0], 0.8) for other in doors],
        objects=[wire.RoomObject(node, share) for node, share in objects.items()],
        named=is_named,
        label_provenance="operator" if by_hand else msgspec.UNSET,
    )


@pytest.fixture
def message() -> wire.SceneGraphMessage:
    nodes = [make_node(i, label, (4.0 * i, 1.0, 0.5)) for i, label in OBJECTS.items()]
    made = make_graph(nodes)
    made.rooms, made.storeys_m = [room(i) for i in ROOMS], [0.0]
    return wire.decode(wire.encode(made), wire.SceneGraphMessage)


@pytest.fixture
def graph(message) -> SceneGraph:
    return SceneGraph(message)


@pytest.mark.parametrize(
    ("question", "found"),
    [
        ("cup in the kitchen", {1: 0.95 * 0.9}),
        ("which cups are in the hall", {2: 0.1 * 0.8}),
        ("what is in the bedroom", {4: 0.7, 2: 0.9 * 0.7}),
        ("anything in room 1", {3: 1.0, 1: 0.95}),
        ("desk in Anna's room", {5: 1.0}),
        ("desk in the office", {5: 0.6}),
        ("cup not in the kitchen", {2: 1.0, 1: 1 - 0.95 * 0.9}),
        ("cup in the room", {1: 1.0, 2: 1.0}),  # the room around, as before
    ],
)
def test_objects_are_asked_for_by_their_room(graph, question, found) -> None:
    answers = ask(graph, question).found
    own = {answer.item.id: answer.item.probability for answer in answers}
    assert {a.item.id: a.probability for a in answers} == pytest.approx(
        {i: chance * own[i] for i, chance in found.items()}, abs=1e-6
    )


@pytest.mark.parametrize(
    ("question", "found"),
    [
        ("rooms", {1: 1.0, 2: 1.0, 3: 1.0, 4: 1.0, 5: 1.0}),
        ("rooms next to the hall", {1: 0.8, 3: 0.8, 4: 0.8}),
        ("rooms next to the corridor and next to the hall", {1: 0.64, 3: 0.64, 4: 0.64}),
        ("bedrooms", {3: 0.7}),
        ("kitchen", {1: 0.9}),
        ("room 2", {2: 1.0}),
        ("rooms next to Anna's room", {2: 1.0}),
        ("rooms with a bed", {3: 1.0}),
        ("which room is the fridge in", {1: 1.0}),
        ("what room is the bed in?", {3: 1.0}),
        ("in which room is the desk", {4: 1.0}),
        ("rooms not with a cup", {4: 1.0, 5: 1.0, 2: 0.9, 3: 0.1, 1: 0.05}),
    ],
)
def test_rooms_are_asked_for(graph, question, found) -> None:
    answers = ask(graph, question)
    assert answers.found == ()
    chances = {answer.room.id: answer.probability for answer in answers.rooms}
    # What is in a room is also as sure as the object.
    assert chances == pytest.approx(found, abs=0.1)
    assert [a.probability for a in answers.rooms] == sorted(chances.values(), reverse=True)
    assert len(answers.to_dict()["rooms"]) == len(found)


def test_counts_and_yes_or_no(graph) -> None:
    assert ask(graph, "how many rooms").count == 5
    assert ask(graph, "how many bedrooms").said.startswith("1 (")
    assert ask(graph, "is there a kitchen").probability == pytest.approx(0.9)
    assert ask(graph, "is there a bathroom").said.startswith("no")
    assert ask(graph, "is the bed in the bedroom").probability == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("question", "says"),
    [
        ("rooms on the table", "'on table' is no condition of a room"),
        ("rooms next to the elephantt", "is the name of no class"),
        ("rooms within 2 m of cup", "is no condition of a room"),
    ],
)
def test_what_no_room_can_fulfil_is_named(graph, question, says) -> None:
    with pytest.raises(ClientError, match=says):
        ask(graph, question)


def test_without_rooms_the_error_says_why(message) -> None:
    message.rooms = message.storeys_m = msgspec.UNSET
    graph = SceneGraph(message)
    assert graph.rooms == () and graph.room_of("bed") is None
    for question in ("cup in the kitchen", "rooms", "rooms next to the hall"):
        with pytest.raises(ClientError, match="rooms are found in the views of the camera"):
            ask(graph, question)
    # A class of the graph of that name is meant first.
    nodes = [make_node(1, "office"), make_node(2, "cup")]
    assert ask(SceneGraph(make_graph(nodes)), "office").found[0].item.id == 1


def test_rooms_from_python(graph) -> None:
    assert graph.room_of("bed").name == "bedroom (room 3)"
    assert [(room.id, share) for room, share in graph.rooms.of(2)] == [(3, 0.9), (2, 0.1)]
    assert [room.id for room in graph.rooms.next_to("hall")] == [1, 3, 4]
    assert graph.rooms.one(5).name == "room 5" and graph.rooms.one("anna's room").id == 4
    assert graph.rooms.one("kitchen").probability == 0.9 and graph.rooms[3].probability == 1.0
    with pytest.raises(ClientError, match=r"no room 'attic'; rooms: kitchen \(room 1\)"):
        graph.rooms.one("attic")


def test_the_command_line_and_agents(message, graph, tmp_path) -> None:
    path = write_graph(tmp_path, message)
    shown = CliRunner().invoke(app, ["query", str(path), "rooms next to the hall"])
    assert shown.exit_code == 0 and "kitchen (room" in shown.output
    told = GraphTools(lambda: graph).list_rooms()
    assert told["storeys_m"] == [0.0] and told["rooms"][0]["next_to"] == [2]
    assert told["rooms"][0]["objects"] == {"1": 0.95, "3": 1.0}
    rooms = GraphTools(lambda: graph).get_object_context("bed")["rooms"]
    assert rooms == [{"id": 3, "label": "bedroom", "probability": 1.0}]
