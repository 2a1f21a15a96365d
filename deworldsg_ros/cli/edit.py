"""`deworldsg edit`: an operator's edits, in a map file or in a running graph."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from deworldsg_ros.cli.ask import AsJson, Namespace, print_json, print_lines
from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.scene.edits import (
    DeleteNode,
    EditRequest,
    MergeNodes,
    SetLabel,
    SplitNode,
    Undo,
)
from deworldsg_ros.words import whole_number

# typer evaluates these annotations at run time.
Words = Annotated[list[str], typer.Argument(metavar="[FILE] WORDS", help="map file, then the edit")]
Live = Annotated[bool, typer.Option("--live", help="edit the running graph_node instead of a file")]

USAGE = (
    "set_label ID LABEL, merge ID ID, split ID [X,Y,Z X,Y,Z], delete ID, or undo, after the map "
    "file or --live"
)


def edit(
    words: Words, live: Live = False, namespace: Namespace = "", as_json: AsJson = False
) -> None:
    """Edit a map: set_label ID LABEL, merge ID ID, split ID, delete ID, undo.

    With --live, the graph of the running graph_node. An edit holds for all later frames. `split`
    takes two points, X,Y,Z each: every part of the object belongs to the nearer one.
    """
    path, rest = (None, words) if live else (Path(words[0]), words[1:])
    request = parse_edit(rest)
    if path is None:
        reply = _edit_live(namespace, rest[0], request)
    else:
        from deworldsg_ros.map_file import edit_map  # with all stages: slow to import

        reply = msgspec.to_builtins(edit_map(path, request))
    if as_json:
        print_json(reply)
    else:
        print_lines([reply["text"]])


def parse_edit(words: list[str]) -> EditRequest:
    """The request of words such as ``merge 4 7``; ClientError for others."""
    verb, *rest = words or [""]
    try:
        if verb == "set_label" and len(rest) >= 2:
            return SetLabel(_number(rest[0]), " ".join(rest[1:]))
        if verb == "merge" and len(rest) == 2:
            return MergeNodes([_number(word) for word in rest])
        if verb == "split" and len(rest) in (1, 3):
            points = [[float(value) for value in word.split(",")] for word in rest[1:]]
            request = {"node": _number(rest[0]), "near_m": points or None}
            return msgspec.convert(request, SplitNode)
        if verb == "delete" and len(rest) == 1:
            return DeleteNode(_number(rest[0]))
        if verb == "undo" and not rest:
            return Undo()
    except ValueError as error:  # msgspec's errors are such
        raise ClientError(f"'{' '.join(words)}': {error}; expected {USAGE}") from error
    raise ClientError(f"'{' '.join(words)}': expected {USAGE}")


def _number(word: str) -> int:
    number = whole_number(word.removeprefix("#"))
    if number is None:
        raise ValueError(f"{word} is no id")
    return number


def _edit_live(namespace: str, verb: str, request: EditRequest) -> dict[str, Any]:
    from deworldsg_ros.client import SceneGraphClient

    with SceneGraphClient(namespace) as client:
        if verb == "undo":
            return client.undo()
        values = json.loads(msgspec.json.encode(request))
        return client.command(verb, **values)
