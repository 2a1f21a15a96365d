"""Tables of the pages equal the code; `python test/nodes/test_docs.py` writes them."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

from support import abnormal, wrong_recordings  # noqa: E402

from deworldsg_ros.ros import options  # noqa: E402
from deworldsg_ros.ros.health import REASONS  # noqa: E402
from deworldsg_ros.ros.parameters import fields  # noqa: E402

DOCS = ROOT / "docs"
TOPICS_PAGE = DOCS / "topics_and_parameters.md"
PAGES = (
    *(DOCS / "dev" / f"{name}.md" for name in ("nodes", "recordings", "reliability")),
    *(DOCS / f"{name}.md" for name in ("many_robots", "troubleshooting")),
    TOPICS_PAGE,
)
# Everything that runs in the nodes.
PACKAGES = (
    *("ros", "fleet", "streams", "nodes", "poses", "perception", "lifting", "merging", "relations"),
    *("wire/codec.py", "wire/messages.py", "graph_builder.py", "scene/camera.py"),
)


def reasons_table() -> str:
    rows = [f"| `{reason}` | {advice} |" for reason, advice in REASONS.items()]
    return "\n".join(["| reason | cause, and remedy |", "|---|---|", *rows])


def parameters_table(kind: type, section: str = "") -> str:
    rows = []
    for field in fields(kind):
        if section in ("", field.path[0]):
            default = "''" if field.default == "" else str(field.default).lower()
            limits = field.limits() or ("true, false" if field.kind is bool else "")
            cells = (f"`{field.name}`", field.kind.__name__, f"`{default}`", limits)
            rows.append(f"| {' | '.join(cells)} | {field.description} |")
    return "\n".join(["| name | type | default | allowed | |", "|---|---|---|---|---|", *rows])


def with_tables(text: str) -> str:
    tables = {
        "reasons": reasons_table(),
        "abnormal": abnormal.table(),
        "matrix": wrong_recordings.table(),
        "parameters": parameters_table(options.Parameters),
        "viewer": parameters_table(options.ViewerParameters, "node"),
        "region": parameters_table(options.RegionParameters),
        "fleet": parameters_table(options.FleetParameters),
        "fleet_link": parameters_table(options.FleetLinkParameters),
        # The configuration is in the other table.
        "replay": parameters_table(options.ReplayParameters, "node"),
    }
    pattern = re.compile(r"(<!-- (\w+) -->\n).*?(<!-- /\2 -->)", re.DOTALL)
    return pattern.sub(lambda match: f"{match[1]}{tables[match[2]]}\n{match[3]}", text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_tables_of_the_page_are_those_of_the_code(page):
    text = page.read_text(encoding="utf-8")
    assert "<!-- /" in text
    assert text == with_tables(text), "run: python test/nodes/test_docs.py"


def test_the_page_for_robots_has_all_launch_arguments():
    page = (DOCS / "on_a_robot.md").read_text(encoding="utf-8")
    for path in sorted((ROOT / "launch").glob("*.py")):
        text = path.read_text(encoding="utf-8")
        inputs = re.findall(r'^    \(?\s*"(\w+)", ?"[\w/]+",', text, re.MULTILINE)
        names = re.findall(r'DeclareLaunchArgument\(\s*"(\w+)"', text)
        assert names
        for name in (*names, *inputs):
            assert f"`{name}`" in page, f"{path.name}: {name}"


def literals(names: tuple[str, ...], places: dict[str, int]) -> Iterator[str]:
    """Texts in the calls of some functions, at the first place or another."""
    for name in names:
        path = ROOT / "deworldsg_ros" / name
        for file in [path] if path.is_file() else sorted(path.rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call):
                    place = places.get(getattr(node.func, "id", getattr(node.func, "attr", "")))
                    arguments = node.args[place:] if place is not None else []
                    if arguments and isinstance(arguments[0], ast.Constant):
                        yield arguments[0].value


def test_every_reason_of_the_code_is_explained():
    used = set(literals(PACKAGES, {"RefusedInput": 0, "drop": 0, "_drop": 0}))
    assert used
    assert used <= set(REASONS)


def test_every_topic_of_the_code_is_on_the_page():
    makers = ("listen_json", "source", "json_publisher", "text_publisher")
    places = {"create_publisher": 1, "create_subscription": 1, **dict.fromkeys(makers, 0)}
    used = {text for text in literals(("nodes", "ros"), places) if text and isinstance(text, str)}
    assert {"deworldsg/frame_graph", "scene_graph/updates", "/diagnostics"} <= used
    page = TOPICS_PAGE.read_text(encoding="utf-8").replace("`/scene", "`scene")
    assert {topic for topic in used if f"`{topic}`" not in page} == set()


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
