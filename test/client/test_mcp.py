"""The MCP server, asked by the package's own client in a process of its own; and its tools."""

import asyncio
import json
import math
import os
import sys
import threading
from contextlib import asynccontextmanager

import msgspec
import pytest
from support.cli import COMMAND, ROOT
from support.view import box_at, make_edge, make_graph, make_node

from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.mcp_server import GraphTools, WatchedFile, within
from deworldsg_ros.wire import messages as wire

TOOLS = {
    "list_objects", "list_relations", "list_rooms", "find", "get_object_context", "where_is",
    "if_removed", "what_changed_since", "go_to_goal", "next_view",
}  # fmt: skip


@asynccontextmanager
async def server_of(folder):
    """Ask the tools of a server of its own for the graph in a folder."""
    mcp = pytest.importorskip("mcp")
    if not hasattr(mcp, "Client"):
        pytest.skip("mcp is older than version 2")
    server = mcp.StdioServerParameters(
        command=COMMAND[0],
        args=[*COMMAND[1:], "mcp", str(folder)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]])},
    )
    async with mcp.Client(server) as client:

        async def ask(name, **arguments):
            result = await client.call_tool(name, arguments)
            assert not result.is_error, result.content
            return json.loads(result.content[0].text)

        yield client, ask


def test_an_agent_asks_over_stdio(demo_out):
    async def talk():
        async with server_of(demo_out) as (client, ask):
            listed = (await client.list_tools()).tools
            assert {tool.name for tool in listed} == TOOLS
            with_arguments = [tool for tool in listed if tool.name != "list_rooms"]
            assert all("Args:" in (tool.description or "") for tool in with_arguments)
            assert all(tool.input_schema["properties"] for tool in with_arguments)
            cups = await ask("list_objects", label="cup")
            assert [item["id"] for item in cups["objects"]] == [13, 40]
            (answer, *_) = (await ask("find", question="cup on dining table"))["answers"]
            assert (answer["object"]["label"], answer["sure"]) == ("cup", True)
            (related, *_) = (await ask("list_relations", subject="13", predicate="on"))["relations"]
            assert related["text"] == "cup #13 is on dining table #5"
            assert "exists with" in (await ask("get_object_context", object="cup"))["explanation"]
            goal = await ask("go_to_goal", object="13", distance_m=0.8)
            assert goal["distance_m"] == pytest.approx(0.8)
            view = await ask("next_view", radius_m=0.25)
            assert view["reason"] and view["gain_nats"] > 0 and view["header"]["frame_id"]
            assert (await ask("what_changed_since", seconds_ago=5.0))["note"]
            refused = await client.call_tool("go_to_goal", {"object": "elephant"})
            assert refused.is_error and "'elephant'" in refused.content[0].text

    asyncio.run(asyncio.wait_for(talk(), 90))


def test_changes_are_told_from_the_first_question_on(room):
    later = msgspec.structs.replace(
        room.message,
        nodes=room.message.nodes[1:],
        stamp=wire.stamp_from_ns(room.stamp_ns + 10**10),
    )
    graphs = [room, SceneGraph(later)]
    tools = GraphTools(lambda: graphs[0])
    assert tools.list_objects(limit=3)["count"] == 34
    del graphs[0]
    changed = tools.what_changed_since(10.0)
    assert "note" not in changed
    assert [item["label"] for item in changed["gone"]] == ["bottle"]
    assert tools.what_changed_since(1.0)["compared_with_s"] == room.stamp_ns / 1e9
    assert "note" in tools.what_changed_since(1000.0)


def test_empty_and_unknown_arguments(room):
    tools = GraphTools(lambda: room)
    assert tools.get_object_context("elephant")
    told = tools.get_object_context("cup near (90, 90)")["explanation"]
    assert told.startswith("cup near (90.00, 90.00), within 1 m: nothing was detected there")
    with pytest.raises(ClientError, match="an id or a class"):
        tools.go_to_goal(" ")
    assert tools.list_relations(limit=0)["relations"] == []
    for text in ("²", "#٣", "9" * 5000):
        with pytest.raises(ClientError, match="is the name of no class"):
            tools.go_to_goal(text)
        with pytest.raises(ClientError, match="is the name of no class"):
            tools.list_relations(text)
    for seconds in (math.inf, math.nan, 1e300, -1e300):
        with pytest.raises(ClientError, match="seconds_ago"):
            tools.what_changed_since(seconds)


def test_a_file_is_read_again_when_it_changes(demo_out, room):
    watched = WatchedFile(demo_out)
    first = watched()
    assert watched() is first
    path = demo_out / "scene_graph.json"
    path.write_text("{ half")
    assert watched() is first
    path.write_text(wire.encode(msgspec.structs.replace(room.message, nodes=[], edges=[])))
    assert len(watched()) == 0
    path.unlink()
    assert len(watched()) == 0


def test_a_call_that_takes_too_long_says_so():
    places, ends = threading.BoundedSemaphore(1), threading.Event()
    assert within(5.0, places, lambda: {"a": 1}) == {"a": 1}
    with pytest.raises(ZeroDivisionError):
        within(5.0, places, lambda: {"a": 1 // 0})
    with pytest.raises(ClientError, match=r"no answer within 0.05 s"):
        within(0.05, places, lambda: {"a": ends.wait(30)})
    with pytest.raises(ClientError, match="busy"):  # the first one still runs
        within(0.05, places, dict)
    ends.set()
    assert within(30.0, places, dict) == {}


def test_where_is_says_what_is_not_there(room):
    tools = GraphTools(lambda: room)
    told = tools.where_is("cup on dining table")
    assert told["found"] and told["object"]["label"] == "cup"
    assert told["object"]["rests_on"][0]["label"] == "dining table"
    assert told["object"]["seen_seconds_ago"] >= 0.0 and told["object"]["rooms"] == []
    assert [one["label"] for one in tools.where_is("cup")["others"]] == ["cup"]
    assert tools.where_is("13")["object"]["id"] == 13
    assert tools.where_is("elephant")["found"] is False
    with pytest.raises(ClientError, match="words or an id"):
        tools.where_is(" ")
    with pytest.raises(ClientError, match="is the name of no class"):
        tools.where_is("cupp")


STAMP_S = 1_000


def kitchen(*, without=()):
    """A graph: a pan in a stack on a counter, with a spoon in it, and a shelf with books."""
    boxes = {
        1: ("counter", (0.0, 0.0, 0.0), (2.0, 0.6, 0.9)),
        2: ("plate", (0.5, 0.1, 0.9), (0.3, 0.3, 0.02)),
        3: ("pan", (0.53, 0.13, 0.92), (0.24, 0.24, 0.06)),
        4: ("spoon", (0.6, 0.2, 0.93), (0.12, 0.03, 0.03)),
        5: ("cup", (1.2, 0.2, 0.9), (0.08, 0.08, 0.1)),
        6: ("shelf", (3.0, 2.0, 0.0), (0.3, 0.8, 1.2)),
        7: ("book", (3.05, 2.1, 0.4), (0.2, 0.25, 0.04)),
        8: ("book", (3.06, 2.11, 0.44), (0.18, 0.22, 0.03)),
        9: ("chair", (1.0, 2.5, 0.0), (0.5, 0.5, 0.9)),
    }
    on = {2: 1, 3: 2, 4: 3, 5: 1, 7: 6, 8: 7}
    stamp = wire.Stamp(STAMP_S + 60 * bool(without), 0)
    nodes = []
    for node_id, (label, low, size) in boxes.items():
        center = tuple(a + b / 2 for a, b in zip(low, size))
        seen = {"first_seen": wire.Stamp(900, 0), "last_seen": wire.Stamp(STAMP_S - 5, 0)}
        nodes.append(make_node(node_id, label, center, box=box_at(center, size), **seen))
    edges = [make_edge(a, b, "in" if a == 4 else "on", 0.95) for a, b in on.items()]
    return make_graph(
        [node for node in nodes if node.id not in without],
        [edge for edge in edges if not {edge.subject, edge.object} & {*without}],
        stamp=stamp,
        session="kitchen",
        sequence=1 + bool(without),
    )


@pytest.mark.slow
def test_a_scripted_agent_runs_five_errands(tmp_path):
    """Without a network, through the official client; what it needs comes from the answers."""
    pytest.importorskip("mujoco")
    file = tmp_path / "scene_graph.json"
    file.write_text(wire.encode(kitchen()))

    async def fetch(ask, words):
        """Stand before each thing that has to go first, then before the thing itself."""
        place = await ask("where_is", object=words)
        assert place["found"] and place["object"]["sure"]
        told = await ask("if_removed", object=place["object"]["id"])
        taken = []
        for step in told["steps"]:
            assert step["safe"]
            goal = await ask("go_to_goal", object=step["object"]["id"], distance_m=0.6)
            assert goal["header"]["frame_id"] == place["frame_id"]
            assert goal["pose"].keys() == {"position", "orientation"}
            taken.append(step["object"]["label"])
        return place, told, taken

    async def talk():
        async with server_of(tmp_path) as (client, ask):
            # 1. Fetch the pan: where is it, what is on it, in which order, where do I stand?
            place, told, taken = await fetch(ask, "pan")
            assert [one["label"] for one in place["object"]["rests_on"]] == ["plate"]
            assert place["object"]["seen_seconds_ago"] == 5.0
            assert [one["label"] for one in told["moves"]] == ["spoon"] and not told["safe"]
            assert taken == ["spoon", "pan"] and told["steps_safe"]
            # 2. Bring a cup: nothing is on it.
            _, told, taken = await fetch(ask, "cup on counter")
            assert told["safe"] and taken == ["cup"]
            # 3. Clear the shelf.
            on_it = await ask("find", question="what rests on the shelf, all the way up")
            ids = {one["object"]["id"] for one in on_it["answers"]}
            told = await ask("if_removed", object="shelf", clear=True)
            order = [step["object"]["id"] for step in told["steps"]]
            assert ids == {7, 8} and order == [8, 7] and told["steps_safe"]
            # 4. What is not there is said so.
            assert not (await ask("where_is", object="teddy bear"))["found"]
            refused = await client.call_tool("if_removed", {"object": "teddy bear"})
            assert refused.is_error and "teddy bear" in refused.content[0].text
            # 5. Somebody takes the cup meanwhile: what has changed since then?
            file.write_text(wire.encode(kitchen(without=(5,))))
            changed = await ask("what_changed_since", since_s=place["stamp_s"])
            assert [one["label"] for one in changed["gone"]] == ["cup"]
            assert changed["times"][0].startswith("gone cup #5")
            assert not (await ask("where_is", object="cup"))["found"]

    asyncio.run(asyncio.wait_for(talk(), 110))
