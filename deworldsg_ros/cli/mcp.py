"""`deworldsg mcp`: serve a scene graph to an LLM agent, over stdio."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from deworldsg_ros.cli.ask import Live, Namespace
from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.mcp_server import make_server
from deworldsg_ros.client.tools import WatchedFile


def mcp(
    graph: Annotated[
        Optional[Path],
        typer.Argument(
            metavar="[GRAPH]", help="file, or folder of a run; read again when it changes"
        ),
    ] = None,
    live: Live = False,
    namespace: Namespace = "",
    edits: Annotated[
        bool, typer.Option("--edit", help="with --live: the agent may edit the graph, too")
    ] = False,
) -> None:
    """Serve a scene graph to an LLM agent: an MCP server on stdio, offline, without a key.

    Needs the package mcp: pip install 'deworldsg_ros[mcp]'.
    """
    if live == (graph is not None):
        raise ClientError("expected a graph or --live, and not both")
    if edits and not live:
        raise ClientError("--edit needs --live; edit a map file with deworldsg edit")
    if graph is not None:
        make_server(WatchedFile(graph)).run()
        return
    from deworldsg_ros.client import SceneGraphClient

    with SceneGraphClient(namespace) as client:
        make_server(lambda: client.graph, client, edits).run()
