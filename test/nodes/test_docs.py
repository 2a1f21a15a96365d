"""Tables of the pages equal the code; `python test/nodes/test_docs.py` writes them."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

from support import abnormal  # noqa: E402

from deworldsg_ros.ros.health import REASONS  # noqa: E402
from deworldsg_ros.ros.options import (  # noqa: E402
    FleetLinkParameters,
    FleetParameters,
    Parameters,
    RegionParameters,
    ReplayParameters,
    ViewerParameters,
)
from deworldsg_ros.ros.parameters import Field, fields  # noqa: E402

PAGES = (
    ROOT / "docs" / "dev" / "nodes.md",
    ROOT / "docs" / "dev" / "recordings.md",
    ROOT / "docs" / "dev" / "reliability.md",
    ROOT / "docs" / "troubleshooting.md",
    ROOT / "docs" / "topics_and_parameters.md",
)
# Everything that runs in the nodes.
PACKAGES = (
    "ros",
    "fleet",
    "streams",
    "nodes",
    "poses",
    "perception",
    "lifting",
    "merging",
    "relations",
    "wire/codec.py",
    "wire/messages.py",
    "graph_builder.py",
    "scene/camera.py",
)


def reasons_table() -> str:
    rows = [f"| `{reason}` | {advice} |" for reason, advice in REASONS.items()]
    return "\n".join(["| reason | cause, and remedy |", "|---|---|", *rows])


def parameters_table(listed: list[Field]) -> str:
    rows = []
    for field in listed:
        default = "''" if field.default == "" else str(field.default).lower()
        limits = field.limits() or ("true, false" if field.kind is bool else "")
        kind = field.kind.__name__
        rows.append(f"| `{field.name}` | {kind} | `{default}` | {limits} | {field.description} |")
    return "\n".join(["| name | type | default | allowed | |", "|---|---|---|---|---|", *rows])


def with_tables(text: str) -> str:
    tables = {
        "reasons": reasons_table(),
        "abnormal": abnormal.table(),
        "parameters": parameters_table(fields(Parameters)),
        "viewer": parameters_table([f for f in fields(ViewerParameters) if f.path[0] == "node"]),
        "region": parameters_table(fields(RegionParameters)),
        "fleet": parameters_table(fields(FleetParameters)),
        "fleet_link": parameters_table(fields(FleetLinkParameters)),
        # The configuration is in the other table.
        "replay": parameters_table([f for f in fields(ReplayParameters) if f.path[0] == "node"]),
    }
    pattern = re.compile(r"(<!-- (\w+) -->\n).*?(<!-- /\2 -->)", re.DOTALL)
    return pattern.sub(lambda match: f"{match[1]}{tables[match[2]]}\n{match[3]}", text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_tables_of_the_page_are_those_of_the_code(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert "<!-- /" in text
    assert text == with_tables(text), "run: python test/nodes/test_docs.py"


def reasons_in(path: Path) -> set[str]:
    """First arguments of every RefusedInput and drop that are literals."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and node.args:
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            literal = isinstance(node.args[0], ast.Constant)
            if name in ("RefusedInput", "drop", "_drop") and literal:
                found.add(node.args[0].value)
    return found


def test_every_reason_of_the_code_is_explained() -> None:
    package = ROOT / "deworldsg_ros"
    paths: list[Path] = []
    for name in PACKAGES:
        path = package / name
        paths += [path] if path.is_file() else sorted(path.rglob("*.py"))
    used = set().union(*(reasons_in(path) for path in paths))
    assert used
    assert used <= set(REASONS)


def topics_in(path: Path) -> set[str]:
    """Names of topics that a module publishes or subscribes to by a literal."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            at = {"create_publisher": 1, "create_subscription": 1}.get(name, 0)
            calls = ("create_publisher", "create_subscription", "listen_json", "source")
            if name in (*calls, "json_publisher", "text_publisher") and len(node.args) > at:
                topic = node.args[at]
                if isinstance(topic, ast.Constant) and isinstance(topic.value, str) and topic.value:
                    found.add(topic.value)
    return found


def test_every_topic_of_the_code_is_on_the_page() -> None:
    package = ROOT / "deworldsg_ros"
    paths = [path for name in ("nodes", "ros") for path in sorted((package / name).rglob("*.py"))]
    used = set().union(*(topics_in(path) for path in paths))
    assert {"deworldsg/frame_graph", "scene_graph/updates", "/diagnostics"} <= used
    page = (ROOT / "docs" / "topics_and_parameters.md").read_text(encoding="utf-8")
    assert {
        topic for topic in used if f"`{topic}`" not in page.replace("`/scene", "`scene")
    } == set()


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
