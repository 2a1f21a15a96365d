"""The Python of README.md and of the page "use the graph" runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(path: Path) -> list[str]:
    return BLOCK.findall(path.read_text(encoding="utf-8"))


def test_the_readme_says_which_cup_is_on_the_table(
    root_dir: Path, demo_out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (block,) = blocks(root_dir / "README.md")
    assert len(block.strip().splitlines()) == 3
    exec(compile(block, "README.md", "exec"), {})
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("cup #13 (-0.8")


def test_the_page_use_the_graph_runs(root_dir: Path, demo_out: Path) -> None:
    names: dict[str, object] = {}
    page = blocks(root_dir / "docs" / "use_the_graph.md")
    assert len(page) >= 5
    for block in page:
        exec(compile(block, "use_the_graph.md", "exec"), names)
