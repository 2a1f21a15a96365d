"""The graph as two tables on the terminal: objects, and relations."""

from __future__ import annotations

from rich.console import Console
from rich.style import Style
from rich.table import Table
from rich.text import Text

from deworldsg_ros.base.words import visible
from deworldsg_ros.client.graph import SceneGraph
from deworldsg_ros.client.objects import scene_object
from deworldsg_ros.view.colours import class_colours
from deworldsg_ros.wire import messages as wire

MOST_ROWS = 60
PROVENANCE_STYLES = {"visual": "", "prior": "yellow", "fused": "cyan"}


def print_graph(console: Console, graph: wire.SceneGraphMessage, most: int = MOST_ROWS) -> None:
    """Print the most observed objects and the most probable relations, at most `most` of each."""
    console.print(object_table(graph, most))
    console.print(relation_table(graph, most))


def object_table(graph: wire.SceneGraphMessage, most: int = MOST_ROWS) -> Table:
    """Objects, most observed first, with the sides of their boxes."""
    table = Table(
        title=_title("object", len(graph.nodes), most),
        caption=Text(
            "p: it exists and is that; an object without a name: it exists; "
            f"position in frame {graph.frame_id!r}; "
            "size: length, width and height; seen: number of frames"
        ),
    )
    table.add_column("object", no_wrap=True)
    table.add_column("p", justify="right")
    table.add_column("x, y, z (m)", justify="right", no_wrap=True)
    table.add_column("size (cm)", justify="right", no_wrap=True)
    table.add_column("seen", justify="right")
    colours = class_colours(node.label for node in graph.nodes)
    up = SceneGraph(graph).up
    for node in sorted(graph.nodes, key=lambda node: (-node.observations, node.id))[:most]:
        item = scene_object(node, graph.frame_id, up)
        table.add_row(
            _name(node.label, node.id, Style(color=colours[node.label])),
            _percent(item.probability),
            " ".join(f"{value:6.2f}" for value in item.position_m),
            " × ".join(item.size_words),
            str(node.observations),
        )
    return table


def relation_table(graph: wire.SceneGraphMessage, most: int = MOST_ROWS) -> Table:
    """Relations, most probable first."""
    table = Table(title=_title("relation", len(graph.edges), most))
    for name in ("subject", "predicate", "object"):
        table.add_column(name, no_wrap=True)
    table.add_column("p", justify="right")
    table.add_column("provenance", no_wrap=True)
    table.add_column("seen", justify="right")
    names = {node.id: _name(node.label, node.id) for node in graph.nodes}
    edges = sorted(
        graph.edges,
        key=lambda edge: (-edge.probability, -edge.observations, edge.subject, edge.object),
    )
    for edge in edges[:most]:
        table.add_row(
            names.get(edge.subject, _name("?", edge.subject)),
            Text(visible(edge.predicate), "bold"),
            names.get(edge.object, _name("?", edge.object)),
            _percent(edge.probability),
            Text(edge.provenance, PROVENANCE_STYLES[edge.provenance]),
            str(edge.observations),
        )
    return table


def _title(noun: str, number: int, most: int) -> str:
    plural = noun if number == 1 else f"{noun}s"
    return f"{number} {plural}" + (f" (the first {most})" if number > most else "")


def _name(label: str, node_id: int, style: str | Style = "") -> Text:
    return Text.assemble((visible(label), style), (f" #{node_id}", "dim"))


def _percent(probability: float) -> str:
    return f"{100 * probability:.0f} %"
