"""The MCP server, asked by the package's own client in a process of its own; and its tools."""

import asyncio
import json
import math
import os
import sys

import msgspec
import pytest
from support.cli import COMMAND, ROOT

from deworldsg_ros.client import ClientError, SceneGraph
from deworldsg_ros.client.mcp_server import GraphTools, WatchedFile
from deworldsg_ros.wire import messages as wire

TOOLS = {
    "list_objects", "list_relations", "list_rooms", "find", "get_object_context", "what_changed",
    "goal_near", "next_view",
}  # fmt: skip


def test_an_agent_asks_over_stdio(demo_out):
    mcp = pytest.importorskip("mcp")
    if not hasattr(mcp, "Client"):
        pytest.skip("mcp is older than version 2")
    server = mcp.StdioServerParameters(
        command=COMMAND[0],
        args=[*COMMAND[1:], "mcp", str(demo_out)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]])},
    )

    async def talk():
        async with mcp.Client(server) as client:

            async def ask(name, **arguments):
                result = await client.call_tool(name, arguments)
                assert not result.is_error, result.content
                return json.loads(result.content[0].text)

            listed = (await client.list_tools()).tools
            assert {tool.name for tool in listed} == TOOLS
            with_arguments = [tool for tool in listed if tool.name != "list_rooms"]
            assert all("Args:" in (tool.description or "") for tool in with_arguments)
            cups = await ask("list_objects", label="cup")
            assert [item["id"] for item in cups["objects"]] == [13, 40]
            (answer, *_) = (await ask("find", question="cup on dining table"))["answers"]
            assert (answer["object"]["label"], answer["sure"]) == ("cup", True)
            (related, *_) = (await ask("list_relations", subject="13", predicate="on"))["relations"]
            assert related["text"] == "cup #13 is on dining table #5"
            assert "exists with" in (await ask("get_object_context", object="cup"))["explanation"]
            goal = await ask("goal_near", object="13", distance_m=0.8)
            assert goal["distance_m"] == pytest.approx(0.8)
            view = await ask("next_view", radius_m=0.25)
            assert view["reason"] and view["gain_nats"] > 0 and view["header"]["frame_id"]
            assert (await ask("what_changed", seconds_ago=5.0))["note"]
            refused = await client.call_tool("goal_near", {"object": "elephant"})
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
    changed = tools.what_changed(10.0)
    assert "note" not in changed
    assert [item["label"] for item in changed["gone"]] == ["bottle"]
    assert tools.what_changed(1.0)["compared_with_s"] == room.stamp_ns / 1e9
    assert "note" in tools.what_changed(1000.0)


def test_empty_and_unknown_arguments(room):
    tools = GraphTools(lambda: room)
    assert tools.get_object_context("elephant")
    told = tools.get_object_context("cup near (90, 90)")["explanation"]
    assert told.startswith("cup near (90.00, 90.00), within 1 m: nothing was detected there")
    with pytest.raises(ClientError, match="an id or a class"):
        tools.goal_near(" ")
    assert tools.list_relations(limit=0)["relations"] == []
    for text in ("²", "#٣", "9" * 5000):
        with pytest.raises(ClientError, match="is the name of no class"):
            tools.goal_near(text)
        with pytest.raises(ClientError, match="is the name of no class"):
            tools.list_relations(text)
    for seconds in (math.inf, math.nan, 1e300, -1e300):
        with pytest.raises(ClientError, match="seconds_ago"):
            tools.what_changed(seconds)


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
