"""`deworldsg store`: keep a scene graph and its history in a graph database."""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Optional

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from deworldsg_ros.base.words import counted
from deworldsg_ros.cli.ask import AsJson, Live, Namespace, plain, print_json
from deworldsg_ros.store import Store, StoreError
from deworldsg_ros.store.store import EXAMPLES, StoreWriter, clock_text, time_ns_from_text
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import join

# The updates of a live graph are joined for this time: objects in view change with every frame.
PERIOD_S = 2.0

# typer evaluates these annotations at run time.
Folder = Annotated[Path, typer.Argument(metavar="STORE", help="folder of the store")]


def add(
    store: Folder,
    graphs: Annotated[
        Optional[list[Path]],
        typer.Argument(metavar="[GRAPH]...", help="files, or folders of runs, oldest first"),
    ] = None,
    live: Live = False,
    namespace: Namespace = "",
) -> None:
    """Add graphs to a store, or follow the running graph_node until Ctrl-C.

    A store has the graph of one world: each graph that is added is a later state of it.
    """
    if live == bool(graphs):
        raise StoreError("expected graphs or --live, and not both")
    with StoreWriter(store) as writer:
        number = _follow(writer, namespace) if live else sum(map(writer.add_file, graphs or ()))
    typer.echo(f"{counted(number, 'message')} added to {store}")


def ask(
    store: Folder,
    cypher: Annotated[
        str, typer.Argument(metavar="CYPHER", help="with tables Object, Relation and Stay")
    ],
    values: Annotated[
        Optional[list[str]],
        typer.Argument(metavar="[NAME=VALUE]...", help="parameters $NAME of the question"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Ask in Cypher: "MATCH (a:Object)-[r:Relation]->(b:Object) RETURN a.label, b.label"."""
    found = Store(store).ask(cypher, dict(map(_parameter, values or ())))
    if as_json:
        print_json([dict(zip(found.columns, row)) for row in found.rows])
        return
    table = Table(*map(plain, found.columns), box=box.SIMPLE)
    for row in found.rows:
        table.add_row(*(plain(str(value)) for value in row))
    Console().print(table)


def at(
    store: Folder,
    moment: Annotated[str, typer.Argument(metavar="TIME", help=EXAMPLES)],
    label: Annotated[
        Optional[str], typer.Argument(metavar="[CLASS]", help="class of the objects; default: all")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print where objects were at a time, and what they were called."""
    opened = Store(store)
    head = opened.head
    time_ns = time_ns_from_text(moment, head.stamp_ns)
    stays = opened.at(time_ns, label)
    if as_json:
        print_json([stay.to_dict() for stay in stays])
        return
    if not stays:
        typer.echo(f"nothing at {clock_text(time_ns)}: {opened.why_nothing(time_ns, label)}")
        return
    where = plain(f"in {head.frame_id!r}")
    table = Table("object", "x, y, z (m)", "since", "until", box=box.SIMPLE, caption=where)
    for stay in stays:
        name, place = f"{stay.label} #{stay.node}", " ".join(f"{v:.2f}" for v in stay.position_m)
        until = "" if stay.is_current else clock_text(stay.until_ns)
        table.add_row(plain(name), place, clock_text(stay.since_ns), until)
    Console().print(table)


def rebuild(store: Folder) -> None:
    """Make the database anew from the messages of the store."""
    Store(store)  # refuses a folder that is no store
    with StoreWriter(store, anew=True):
        pass
    typer.echo(f"{store}: the database is made anew")


def _follow(writer: StoreWriter, namespace: str) -> int:
    """Add what changes until Ctrl-C, joined to one update every two seconds; their number."""
    from deworldsg_ros.client.live import GraphMessage, SceneGraphClient

    messages: queue.SimpleQueue[GraphMessage] = queue.SimpleQueue()
    number = 0
    with SceneGraphClient(namespace) as client:
        client.on_message(messages.put)
        typer.echo("following the graph; Ctrl-C ends")
        try:
            while True:
                time.sleep(PERIOD_S)
                number += add_joined(writer, [messages.get() for _ in range(messages.qsize())])
        except KeyboardInterrupt:
            return number + add_joined(writer, [messages.get() for _ in range(messages.qsize())])


def add_joined(
    writer: StoreWriter, messages: Sequence[wire.SceneGraphMessage | wire.SceneGraphUpdateMessage]
) -> int:
    """Add messages, consecutive updates of a session as one; the number of those added."""
    number = 0
    for _, group in groupby(messages, lambda item: (type(item), item.session)):
        found = list(group)
        updates = [item for item in found if isinstance(item, wire.SceneGraphUpdateMessage)]
        number += sum(map(writer.add, [join(updates)] if updates else found))
    writer.commit()
    return number


def _parameter(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise StoreError(f"'{text[:80]}': expected NAME=VALUE")
    try:
        return name, json.loads(value)
    except (ValueError, RecursionError):
        return name, value


app = typer.Typer(
    name="store",
    help="Keep a scene graph and its history in a graph database.",
    no_args_is_help=True,
)
