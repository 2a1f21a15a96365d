"""`deworldsg query`, `goal`, `explain`, `edit`, `export`, `diff`, `merge` and `mcp`."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import msgspec
import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from deworldsg_ros.base.files import write_atomically
from deworldsg_ros.base.words import counted, visible, whole_number
from deworldsg_ros.client.combine import combine
from deworldsg_ros.client.explain import place_of
from deworldsg_ros.client.export import FORMATS
from deworldsg_ros.client.export import export as export_graph
from deworldsg_ros.client.goals import Robot
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.mcp_server import WatchedFile, make_server
from deworldsg_ros.client.objects import SURE, odds_of
from deworldsg_ros.client.questions import Answers, ask
from deworldsg_ros.graph.edits import (
    DeleteNode,
    GraphEdit,
    MergeNodes,
    NameRoom,
    SetLabel,
    SplitNode,
    Undo,
)
from deworldsg_ros.graph.extent import DEFAULT_UP
from deworldsg_ros.graph.graph_files import graph_path
from deworldsg_ros.scene.arrays import Float64
from deworldsg_ros.scene.camera import rigid_motion
from deworldsg_ros.scene.errors import ClientError
from deworldsg_ros.scene.limits import MAX_GRAPH_COORDINATE_M
from deworldsg_ros.scene.vocabulary import PREDICATES
from deworldsg_ros.scene.vocabulary import plain as plain_name
from deworldsg_ros.wire import messages as wire

if TYPE_CHECKING:
    from deworldsg_ros.client import SceneGraphClient

# Words between the two objects of a relation, the longest first.
_PREDICATES = {"and", *(plain_name(name) for names in PREDICATES for name in names)}
_BETWEEN = re.compile(rf" (?:{'|'.join(sorted(_PREDICATES, key=len, reverse=True))}) ")

# --- `deworldsg query`, `goal` and `explain`: ask a scene graph.

# graph_node looks once a second whether somebody wants embeddings.
LOOKS_S = 5.0

# typer evaluates these annotations at run time.
Words = Annotated[
    list[str],
    typer.Argument(metavar="[FILE] WORDS", help="graph (file, or folder of a run), then the words"),
]
Live = Annotated[bool, typer.Option("--live", help="ask the running graph_node instead of a file")]
Namespace = Annotated[
    str, typer.Option("--namespace", help="of the robot, with --live, e.g. /robot_1")
]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON for programs")]


def query(
    words: Words, live: Live = False, namespace: Namespace = "", as_json: AsJson = False
) -> None:
    """Ask a graph in words: "cup on dining table", "how many chairs", "largest plant".

    Every answer has its probability, its evidence, and "not sure" below odds of 2 : 1.
    """
    with _opened(words, live, namespace) as (graph, rest):
        answers = ask(graph, " ".join(rest))
        if as_json:
            print_json(answers.to_dict())
        else:
            _print_answers(answers, graph.frame_id, Console())


def goal(
    words: Words,
    distance: Annotated[
        float, typer.Option("--distance", help="from the box of the object, metres")
    ] = 1.0,
    radius: Annotated[
        float, typer.Option("--radius", help="half of the robot's width, metres")
    ] = Robot.radius_m,
    height: Annotated[
        float,
        typer.Option("--height", help="of the robot, metres; higher boxes are not in its way"),
    ] = Robot.height_m,
    live: Live = False,
    namespace: Namespace = "",
    as_json: AsJson = False,
) -> None:
    """Print a pose from which an object is in view, as a PoseStamped.

    The words are the id of an object or its class.
    """
    robot = Robot(radius, height)
    if live:
        from deworldsg_ros.client import SceneGraphClient

        with SceneGraphClient(namespace) as client:
            client.wait(timeout_s=10.0)
            found = client.goal_near(_which(words), distance, robot)
    else:
        with _opened(words, live, namespace) as (graph, rest):
            found = graph.goal_near(_which(rest), distance, robot=robot).to_dict()
    if as_json:
        print_json(found)
    else:
        print_lines(_goal_lines(found))


def _goal_lines(found: dict[str, Any]) -> list[str]:
    """The fields of `Goal.to_dict` in words."""
    x, y, z = found["pose"]["position"].values()
    target, clearance_m, seen_free = (found[key] for key in ("target", "clearance_m", "seen_free"))
    blocker = found["blocked_by"]
    probability = found["target_probability"]
    return [
        f"stand at {x:.2f} {y:.2f} {z:.2f} in frame '{found['header']['frame_id']}', facing "
        f"{target['label']} #{target['id']} ({probability:.0%}"
        f"{'' if probability >= SURE else ', not sure'}); quaternion xyzw "
        + " ".join(f"{value:.4f}" for value in found["pose"]["orientation"].values()),
        f"{found['distance_m']:.2f} m from its box; "
        + ("" if clearance_m is None else f"next object {clearance_m:.2f} m beside the robot; ")
        + f"it extends {found['along_std_m']:.2f} m (1σ) along, "
        f"{found['across_std_m']:.2f} m across the view",
        "not sure: walls are not known here"
        if seen_free is None
        else f"seen as free: {seen_free:.0%}",
        *([] if found["in_known_area"] else ["not sure: the pose is outside of all objects"]),
        *(
            []
            if blocker is None
            else [f"not sure: {blocker['label']} #{blocker['id']} may hide it"]
        ),
    ]


def explain(
    words: Words, live: Live = False, namespace: Namespace = "", as_json: AsJson = False
) -> None:
    """Explain why an object, a pair of objects or a class is in the graph, or is not.

    The words are an id, a class, two of them (laptop "dining table", or "laptop on table"), or a
    class and a place: "chair near (1.6, -0.5)".
    """
    if live and place_of(" ".join(words), DEFAULT_UP):
        from deworldsg_ros.client import SceneGraphClient

        with SceneGraphClient(namespace) as client:
            client.wait(timeout_s=10.0)
            told = client.explain(" ".join(words))
        _print_explanation(told["subject"], told["lines"], told if as_json else None)
        return
    with _opened(words, live, namespace) as (graph, rest):
        found = graph.explain(_pair(graph, rest) or _which(rest))
    _print_explanation(found.subject, found.lines, found.to_dict() if as_json else None)


def _print_explanation(subject: str, lines: Iterable[str], values: dict[str, Any] | None) -> None:
    if values is not None:
        print_json(values)
    else:
        print_lines([subject, *(f"  {line}" for line in lines)])


def print_json(content: Any) -> None:
    """Print a JSON document; control characters in it are escapes of JSON."""
    print_lines(json.dumps(content, indent=2, ensure_ascii=False).split("\n"))


def print_lines(lines: Iterable[str]) -> None:
    """Print lines that contain names of a file or message: whatever these are, as text."""
    for line in lines:
        typer.echo(visible(line))


def plain(text: str) -> str:
    """Text of a file or message for a table of rich, which would read markup in it."""
    return escape(visible(text))


@contextmanager
def _opened(words: list[str], live: bool, namespace: str) -> Iterator[tuple[SceneGraph, list[str]]]:
    """The graph that the arguments name, and the rest of the words."""
    if live:
        from deworldsg_ros.client import SceneGraphClient

        by_looks = words[0].lower().split()[:1] == ["like"]
        with SceneGraphClient(namespace, embeddings=by_looks) as client:
            yield _with_looks(client) if by_looks else client.graph, words
        return
    if len(words) < 2:
        raise ClientError(f"'{' '.join(words)}': expected a graph and a question, or --live")
    yield SceneGraph.load(Path(words[0])), words[1:]


def _with_looks(client: SceneGraphClient) -> SceneGraph:
    """The newest graph, with its embeddings if they come in time."""
    end_s = time.monotonic() + LOOKS_S
    while client.graph.looks is None and time.monotonic() < end_s:
        time.sleep(0.05)
    return client.graph


def _pair(graph: SceneGraph, words: list[str]) -> tuple[int | str, int | str] | None:
    """Two objects that the words name, in two arguments or with a relation between; None = one."""
    text = " ".join(" ".join(words).split())
    between = _BETWEEN.split(text, maxsplit=1)
    parts = between if len(between) == 2 else words
    if len(parts) != 2 or _is_known(graph, text) or place_of(text, graph.up):
        return None
    if parts is words and not all(_is_known(graph, part) for part in parts):
        return None  # one name of two words, which the graph does not know
    return _which(parts[:1]), _which(parts[1:])


def _is_known(graph: SceneGraph, text: str) -> bool:
    """Whether a text is an id, or what objects are called here."""
    with suppress(ClientError):
        return isinstance(_which([text]), int) or bool(graph.understand(text))
    return False


def _which(words: list[str]) -> int | str:
    text = " ".join(words).removeprefix("#")
    number = whole_number(text)
    return text if number is None else number


def _print_answers(answers: Answers, frame_id: str, console: Console) -> None:
    table = Table(box=box.SIMPLE, caption=plain(f"positions in frame {frame_id!r}"))
    table.add_column("object", no_wrap=True)
    table.add_column("x, y, z (m)", no_wrap=True)
    table.add_column("size (cm)", no_wrap=True)
    table.add_column("p", justify="right", no_wrap=True)
    table.add_column("odds", justify="right", no_wrap=True)
    table.add_column("evidence")
    for answer in answers.found:
        item = answer.item
        table.add_row(
            plain(item.name),
            " ".join(f"{value:.2f}" for value in item.position_m),
            " × ".join(item.size_words),
            f"{answer.probability:.0%}",
            odds_of(answer.probability),
            ("" if answer.is_sure else "[yellow]not sure:[/] ") + plain(answer.evidence),
        )
    if answers.said is not None:
        console.print(answers.said, highlight=False)
    if answers.rooms:
        rooms = Table(box=box.SIMPLE)
        for heading in ("room", "x, y, z (m)", "area (m²)", "p", "odds", "evidence"):
            rooms.add_column(heading)
        for one in answers.rooms:
            rooms.add_row(
                plain(one.room.name),
                " ".join(f"{value:.2f}" for value in one.room.center_m),
                f"{one.room.area_m2:.1f}",
                f"{one.probability:.0%}",
                odds_of(one.probability),
                ("" if one.is_sure else "[yellow]not sure:[/] ") + plain(one.evidence),
            )
        console.print(rooms)
    if answers.found:
        console.print(table)
    for note in answers.notes:
        console.print(plain(note), highlight=False, soft_wrap=True)


# --- `deworldsg edit`: an operator's edits, in a map file or in a running graph.

# typer evaluates these annotations at run time.
Edits = Annotated[list[str], typer.Argument(metavar="[FILE] WORDS", help="map file, then the edit")]
EditLive = Annotated[
    bool, typer.Option("--live", help="edit the running graph_node instead of a file")
]

USAGE = (
    "set_label ID LABEL, merge ID ID, split ID [X,Y,Z X,Y,Z], delete ID, name_room ID [NAME], or "
    "undo, after the map file or --live; or follow TRAJECTORY, after the map file"
)


def edit(
    words: Edits, live: EditLive = False, namespace: Namespace = "", as_json: AsJson = False
) -> None:
    """Edit a map: set_label ID LABEL, merge ID ID, split ID, delete ID, name_room ID NAME, undo.

    With --live, the graph of the running graph_node. An edit holds for all later frames. `split`
    takes two points, X,Y,Z each: every part of the object belongs to the nearer one. `follow FILE`
    moves a map file as a trajectory in the TUM format says, which SLAM has corrected.
    """
    if live:
        reply = _edit_live(namespace, words[0], parse_edit(words))
    else:
        from deworldsg_ros import map_file  # with all stages: slow to import

        path, rest = Path(words[0]), words[1:]
        if rest[:1] == ["follow"] and len(rest) == 2:
            changed = map_file.follow_trajectory(path, Path(rest[1]))
        else:
            changed = map_file.edit_map(path, parse_edit(rest))
        reply = msgspec.to_builtins(changed)
    if as_json:
        print_json(reply)
    else:
        print_lines([reply["text"]])


def parse_edit(words: list[str]) -> GraphEdit:
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
        if verb == "name_room" and rest:
            return msgspec.convert({"room": _number(rest[0]), "name": " ".join(rest[1:])}, NameRoom)
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


def _edit_live(namespace: str, verb: str, request: GraphEdit) -> dict[str, Any]:
    from deworldsg_ros.client import SceneGraphClient

    with SceneGraphClient(namespace) as client:
        if verb == "undo":
            return client.undo()
        values = json.loads(msgspec.json.encode(request))
        return client.command(verb, **values)


# --- `deworldsg mcp`: serve a scene graph to an LLM agent, over stdio.


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

    with SceneGraphClient(namespace, embeddings=True) as client:
        make_server(lambda: client.graph, client, edits).run()


# --- `deworldsg export`, `diff` and `merge`: graphs in other formats, compared, and merged.

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
    if output.resolve() in (graph_path(first).resolve(), graph_path(second).resolve()):
        raise ClientError(f"{output} is one of the graphs to merge: expected another file")
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
    if not (max(map(abs, (x, y, z))) <= MAX_GRAPH_COORDINATE_M and abs(degrees) <= 360.0):
        raise ClientError(
            f"--transform {text}: expected at most {MAX_GRAPH_COORDINATE_M:g} m and 360 degrees"
        )
    return rigid_motion(np.array([x, y, z]), math.radians(degrees) * np.array(a.up))
