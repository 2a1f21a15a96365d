"""`deworldsg export`, `diff` and `merge`: graphs in other formats, compared, and merged."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from deworldsg_ros.cli.ask import AsJson, print_json, print_lines
from deworldsg_ros.client.combine import combine
from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.export import FORMATS
from deworldsg_ros.client.export import export as export_graph
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.files import write_atomically
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.rigid import rigid_motion
from deworldsg_ros.words import counted

# typer evaluates these annotations at run time.
Graph = Annotated[Path, typer.Argument(metavar="GRAPH", help="file, or folder of a run")]
First = Annotated[Path, typer.Argument(metavar="A", help="file, or folder of a run")]
Second = Annotated[Path, typer.Argument(metavar="B", help="file, or folder of a run")]


def export(
    kind: Annotated[str, typer.Argument(metavar="FORMAT", help=", ".join(FORMATS))],
    graph: Graph,
    output: Annotated[Path, typer.Argument(metavar="OUT", help="file to write")],
) -> None:
    """Write a scene graph in another format."""
    for path in export_graph(SceneGraph.load(graph), kind, output):
        typer.echo(str(path))


def diff(before: First, after: Second, as_json: AsJson = False) -> None:
    """List what differs between two scene graphs in one world frame.

    Objects are added, gone, moved or relabelled.
    """
    changes = SceneGraph.load(after).changes_since(SceneGraph.load(before))
    if as_json:
        print_json(changes.to_dict())
        return
    print_lines(changes.lines)
    typer.echo(f"unchanged: {counted(changes.same, 'object')}")


def merge(
    first: First,
    second: Second,
    output: Annotated[Path, typer.Argument(metavar="OUT", help="file to write")],
    transform: Annotated[
        str,
        typer.Option(
            "--transform",
            metavar="X,Y,Z,DEGREES",
            help="position of the world frame of B in that of A, and its turn about up; default: "
            "find it from the objects",
        ),
    ] = "",
) -> None:
    """Merge a scene graph into another one: objects at one place become one."""
    a, b = SceneGraph.load(first), SceneGraph.load(second)
    combined = combine(a, b, _transform(transform, a) if transform else None)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(output, wire.encode(combined.message).encode())
    except OSError as error:
        raise ClientError(f"{output} cannot be written: {error.strerror}") from error
    console = Console(highlight=False, soft_wrap=True)
    if not transform:
        turn = combined.T_a_b[:3, :3]
        angle = math.degrees(math.acos(min(max((np.trace(turn) - 1) / 2, -1.0), 1.0)))
        place = " ".join(f"{value:.3f}" for value in combined.T_a_b[:3, 3])
        console.print(
            f"transform found: {place} m, {angle:.1f} degrees; confidence {combined.confidence:.2f}"
        )
    console.print(
        f"{output}: {counted(len(combined.message.nodes), 'object')}; {len(combined.pairs)} of the "
        f"{len(a)} and {len(b)} objects are in both"
    )


def _transform(text: str, a: SceneGraph) -> Float64:
    parts = re.split(r"[,\s]+", text.strip())
    try:
        x, y, z, degrees = map(float, parts)
    except ValueError as error:
        raise ClientError(f"--transform {text}: expected four numbers X,Y,Z,DEGREES") from error
    return rigid_motion(np.array([x, y, z]), math.radians(degrees) * np.array(a.up))
