"""`deworldsg query`, `goal` and `explain`: ask a scene graph."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from deworldsg_ros.client.asking import ask
from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import SURE, odds_of
from deworldsg_ros.client.patterns import Answers
from deworldsg_ros.words import visible, whole_number

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
    """Ask a graph in words: "cup on dining table", "chair within 1 m of table".

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
    live: Live = False,
    namespace: Namespace = "",
    as_json: AsJson = False,
) -> None:
    """Print a pose from which an object is in view, as a PoseStamped.

    The words are the id of an object or its class.
    """
    if live:
        from deworldsg_ros.client import SceneGraphClient

        with SceneGraphClient(namespace) as client:
            client.wait(timeout_s=10.0)
            found = client.goal_near(_which(words), distance)
    else:
        with _opened(words, live, namespace) as (graph, rest):
            found = graph.goal_near(_which(rest), distance).to_dict()
    if as_json:
        print_json(found)
    else:
        print_lines(_goal_lines(found))


def _goal_lines(found: dict[str, Any]) -> list[str]:
    """The fields of `Goal.to_dict` in words."""
    x, y, z = found["pose"]["position"].values()
    target, clearance_m, seen_free = (found[key] for key in ("target", "clearance_m", "seen_free"))
    probability = found["target_probability"]
    return [
        f"stand at {x:.2f} {y:.2f} {z:.2f} in frame '{found['header']['frame_id']}', facing "
        f"{target['label']} #{target['id']} ({probability:.0%}"
        f"{'' if probability >= SURE else ', not sure'}); quaternion xyzw "
        + " ".join(f"{value:.4f}" for value in found["pose"]["orientation"].values()),
        f"{found['distance_m']:.2f} m from it; "
        + ("" if clearance_m is None else f"next object {clearance_m:.2f} m away; ")
        + f"it extends {found['along_std_m']:.2f} m (1σ) along, "
        f"{found['across_std_m']:.2f} m across the view",
        "not sure: walls are not known here"
        if seen_free is None
        else f"seen as free: {seen_free:.0%}",
        *([] if found["in_known_area"] else ["not sure: the pose is outside of all objects"]),
        *(
            []
            if found["blocked_by"] is None
            else [f"not sure: object #{found['blocked_by']} may hide it"]
        ),
    ]


def explain(
    words: Words, live: Live = False, namespace: Namespace = "", as_json: AsJson = False
) -> None:
    """Explain why an object, a pair of objects or a class is in the graph, or is not.

    The words are an id, two ids, or a class.
    """
    with _opened(words, live, namespace) as (graph, rest):
        first, *others = [whole_number(word) for word in rest]
        if len(others) == 1 and first is not None and others[0] is not None:
            found = graph.explain((first, others[0]))
        else:
            found = graph.explain(_which(rest))
        if as_json:
            print_json({"subject": found.subject, "lines": list(found.lines), **found.values})
        else:
            print_lines([found.subject, *(f"  {line}" for line in found.lines)])


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

        with SceneGraphClient(namespace) as client:
            yield client.graph, words
        return
    if len(words) < 2:
        raise ClientError(f"'{' '.join(words)}': expected a graph and a question, or --live")
    yield SceneGraph.load(Path(words[0])), words[1:]


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
            " × ".join(f"{100 * value:.0f}" for value in item.size_m),
            f"{answer.probability:.0%}",
            odds_of(answer.probability),
            ("" if answer.is_sure else "[yellow]not sure:[/] ") + plain(answer.evidence),
        )
    if answers.found:
        console.print(table)
    for note in answers.notes:
        console.print(plain(note), highlight=False, soft_wrap=True)
