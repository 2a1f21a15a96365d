"""docs/dev/architecture.md names functions that exist, and every folder of the package."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROW = re.compile(r"^\| [^|]+ \| `(\w+)` \| `([\w/]+\.py)` \|$", re.M)


@pytest.fixture()
def page(root_dir: Path) -> str:
    """The text of the page."""
    return (root_dir / "docs" / "dev" / "architecture.md").read_text(encoding="utf-8")


def test_each_step_names_a_function_or_class_of_its_file(root_dir: Path, page: str) -> None:
    rows = ROW.findall(page)
    assert len(rows) >= 20
    for name, file in rows:
        tree = ast.parse((root_dir / file).read_text(encoding="utf-8"))
        defined = {getattr(node, "name", "") for node in tree.body}
        assert name in defined, f"{file} defines no {name}"


def test_each_folder_and_module_of_the_package_is_described(root_dir: Path, page: str) -> None:
    described = set(re.findall(r"^\| `([\w.]+)/?` \|", page, re.M))
    package = root_dir / "deworldsg_ros"
    folders = {path.parent.name for path in package.glob("*/__init__.py")}
    assert folders <= described
    assert {"pipeline.py", "graph_builder.py", "config.py", "map_file.py"} <= described
