"""Names come from models and files: every output shows them as text, whatever they contain."""

from __future__ import annotations

import io
import json
import re

import pytest
from rich.console import Console
from support.view import make_edge, make_graph, make_node

from deworldsg_ros.cli import outputs
from deworldsg_ros.cli.models import inspect_file
from deworldsg_ros.evaluation.reports import plot_classes, print_protocol
from deworldsg_ros.evaluation.scoring import Count, ProtocolResult
from deworldsg_ros.view import page, picture, table

LABELS = [
    "$\\foo$", "$", "$$x^{$", "__THREE__", "__GRAPH__", "__PAGE__", "[/foo]", "[bold]",
    "[link=x]",
    "</script><script>alert(1)</script>", "\\u003c", "%s {0}", "a\nb", "\x1b[31m", "\u202e", "",
    "é" * 90,
]  # fmt: skip


def graph_of(*labels: str, frame_id: str = "map"):
    nodes = [make_node(1, labels[0]), make_node(2, labels[-1], (0.5, 0, 0))]
    return make_graph(nodes, [make_edge(1, 2, labels[0])], frame_id)


def printed(graph) -> str:
    output = io.StringIO()
    table.print_graph(Console(file=output, width=200, markup=False), graph)
    return output.getvalue()


def is_text(printed_text: str) -> bool:
    return printed_text.replace("\n", "").isprintable()


@pytest.mark.parametrize("label", LABELS)
def test_tables_show_any_label_as_text(label):
    assert is_text(printed(graph_of(label, "table")))


def test_names_of_parameters_and_scores_are_text(tmp_path):
    header = json.dumps({"a\x1b[2J": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}})
    content = len(header).to_bytes(8, "little") + header.encode() + bytes(4)
    (tmp_path / "model.safetensors").write_bytes(content)
    output = io.StringIO()
    console = Console(file=output, width=200, markup=False)
    inspect_file(tmp_path, console)
    count = Count(1, 2)
    classes = {"b\x1b[2J": count}
    result = ProtocolResult(count, count, count, classes, classes, [])
    print_protocol(console, result, "title \x1b[2J")
    assert output.getvalue().count("u001b[2J") == 4
    assert is_text(output.getvalue())


@pytest.mark.parametrize("label", LABELS)
def test_the_picture_draws_any_label(tmp_path, label):
    picture.draw(graph_of(label), tmp_path / "top.png")
    assert (tmp_path / "top.png").stat().st_size > 1000


def test_a_dollar_is_a_dollar_in_plots(tmp_path):
    plot_classes(tmp_path / "classes.png", {"$\\foo$": Count(1, 2)}, "$\\bar$")


@pytest.mark.parametrize("label", LABELS)
def test_the_page_stays_whole_with_any_label(tmp_path, label):
    page.write(graph_of(label, "table"), tmp_path / "graph.html")
    html = (tmp_path / "graph.html").read_text(encoding="utf-8")
    page.write(graph_of("cup", "table"), tmp_path / "plain.html")
    plain = (tmp_path / "plain.html").read_text(encoding="utf-8")
    assert html.count("</script>") == plain.count("</script>")
    assert abs(len(html) - len(plain)) < 10_000, "a part of the page is there twice, or missing"
    found = re.search(r'^.*"frame_id": "map", "nodes".*$', html, re.MULTILINE)
    assert found is not None
    details = json.loads(found[0][found[0].index('{"frame_id"') :].rstrip(";<>/script \n"))
    assert details["nodes"][0]["label"] == label


@pytest.mark.parametrize("name", ["[/foo]", "[bold]x", "/robot[0]/map", "[/]"])
def test_brackets_in_frames_paths_and_notes_are_text(tmp_path, name):
    assert name in printed(graph_of("cup", "table", frame_id=name)).replace("\n", "")
    output = io.StringIO()
    console = Console(file=output, width=200, markup=False)
    folder = tmp_path / name.replace("/", "-")
    folder.mkdir()
    (folder / "run.json").write_text("{}")
    outputs.print_files(console, folder)
    outputs.print_drops(console, [name], {"recording": {name: 1}}, {name: name})
    text = output.getvalue().replace(str(folder), "FOLDER")
    assert text.count("FOLDER") == 2 and text.count(name) == 3
