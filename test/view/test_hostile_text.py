"""Names come from models and files: every output shows them as text, whatever they contain."""

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
from deworldsg_ros.view import page, picture

LABELS = [
    "$\\foo$", "$", "$$x^{$", "__THREE__", "__GRAPH__", "__PAGE__", "[/foo]", "[bold]",
    "[link=x]",
    "</script><script>alert(1)</script>", '"><img src=x onerror=1>', "&lt;", "\\u003c",
    "%s {0}", "a\nb", "\x1b[31m", "\u202e", "",
    "é" * 90,
]  # fmt: skip


def graph_of(label: str, frame_id: str = "map"):
    nodes = [make_node(1, label), make_node(2, "table", (0.5, 0, 0))]
    return make_graph(nodes, [make_edge(1, 2, label)], frame_id)


def console() -> tuple[Console, io.StringIO]:
    output = io.StringIO()
    return Console(file=output, width=200, markup=False), output


def printed(graph) -> str:
    terminal, output = console()
    outputs.print_graph(terminal, graph)
    return output.getvalue()


def is_text(printed_text: str) -> bool:
    return printed_text.replace("\n", "").isprintable()


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The page of a graph of usual names."""
    path = tmp_path_factory.mktemp("plain") / "graph.html"
    page.write(graph_of("cup"), path)
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize("label", LABELS)
def test_tables_picture_and_page_show_any_label_as_text(tmp_path, plain, label):
    graph = graph_of(label)
    assert is_text(printed(graph))
    picture.draw(graph, tmp_path / "top.png")
    assert (tmp_path / "top.png").stat().st_size > 1000
    page.write(graph, tmp_path / "graph.html")
    html = (tmp_path / "graph.html").read_text(encoding="utf-8")
    assert html.count("</script>") == plain.count("</script>")
    assert abs(len(html) - len(plain)) < 10_000, "a part of the page is there twice, or missing"
    found = re.search(r'<script id="graph" type="application/json">(.*?)</script>', html, re.S)
    assert found is not None
    details = json.loads(found[1])
    assert details["nodes"][0]["label"] == label


def test_names_of_parameters_and_scores_are_text(tmp_path):
    header = json.dumps({"a\x1b[2J": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}})
    content = len(header).to_bytes(8, "little") + header.encode() + bytes(4)
    (tmp_path / "model.safetensors").write_bytes(content)
    terminal, output = console()
    inspect_file(tmp_path, terminal)
    count = Count(1, 2)
    classes = {"b\x1b[2J": count}
    print_protocol(
        terminal, ProtocolResult(count, count, count, count, classes, classes, []), "title \x1b[2J"
    )
    assert output.getvalue().count("u001b[2J") == 4
    assert is_text(output.getvalue())
    plot_classes(tmp_path / "classes.png", {"$\\foo$": count}, "$\\bar$")


@pytest.mark.parametrize("name", ["[/foo]", "[bold]x", "/robot[0]/map", "[/]"])
def test_brackets_in_frames_paths_and_notes_are_text(tmp_path, name):
    assert name in printed(graph_of("cup", name)).replace("\n", "")
    terminal, output = console()
    folder = tmp_path / name.replace("/", "-")
    folder.mkdir()
    (folder / "run.json").write_text("{}")
    outputs.print_files(terminal, folder)
    outputs.print_drops(terminal, [name], {"recording": {name: 1}}, {name: name})
    text = output.getvalue().replace(str(folder), "FOLDER")
    assert text.count("FOLDER") == 2 and text.count(name) == 3


def test_a_name_of_a_folder_cannot_write_on_the_terminal(tmp_path, capsys):
    folder = tmp_path / "a\x1b[31m[red]b"
    folder.mkdir()
    (folder / "run.json").write_text("{}")
    outputs.print_files(Console(width=400), folder)
    shown = capsys.readouterr().out
    assert "\x1b" not in shown and shown.count("[red]b") == 2
