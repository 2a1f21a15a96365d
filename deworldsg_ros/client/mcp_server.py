"""An MCP server on stdio, so that an LLM agent can ask a robot's graph. Offline, without a key."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.tools import EditTools, GraphTools
from deworldsg_ros.scene.errors import DeWorldSGError

INSTRUCTIONS = (
    "A live 3D scene graph of a robot's surroundings: objects with positions and sizes in metres, "
    "and relations between them. Every answer has a probability; `sure` is false below odds of "
    "2 : 1, and then say that you are not sure. Positions are in the frame `frame_id`; `up` points "
    "against gravity. Start with list_objects or find."
)


def make_server(newest: Callable[[], SceneGraph], client: Any = None, edits: bool = False) -> Any:
    """The server with its tools.

    Args:
        newest: returns the newest graph.
        client: a `SceneGraphClient` with this graph; None = the graph is of a file.
        edits: the agent may edit the graph of the client.

    Raises:
        ClientError: without the package mcp.
    """
    try:
        from mcp.server import MCPServer
        from mcp.server.mcpserver.exceptions import ToolError
    except ImportError as error:
        raise ClientError(
            "the MCP server needs the package mcp, version 2: pip install 'deworldsg_ros[mcp]'"
        ) from error

    def reporting(function: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
        @functools.wraps(function)
        def call(*arguments: Any, **named: Any) -> dict[str, Any]:
            try:
                return function(*arguments, **named)
            except DeWorldSGError as error:
                raise ToolError(str(error)) from error

        return call

    tools = GraphTools(newest, client)
    functions: list[Callable[..., dict[str, Any]]] = [
        tools.list_objects,
        tools.list_relations,
        tools.find,
        tools.get_object_context,
        tools.what_changed,
        tools.goal_near,
        *(EditTools(client) if edits else []),
    ]
    server = MCPServer("deworldsg", instructions=INSTRUCTIONS, log_level="WARNING")
    for function in functions:
        server.tool()(reporting(function))
    return server
