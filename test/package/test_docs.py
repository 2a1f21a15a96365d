"""Documentation names only what exists, and its site builds strictly and loads nothing."""

import ast
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "deworldsg_ros"
DEV = ROOT / "docs" / "dev"
# A changelog names files of earlier versions.
HISTORY = {"CHANGELOG.md"}
# A program of another project, and files that the package writes.
ELSEWHERE = {"Merging/evaluate.py", "SCAN/config.yaml", "config.yaml", "my.yaml"}

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.+)$", re.MULTILINE)
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"`([^`\n]+)`")
SOURCE_PATH = re.compile(r"[\w./-]+\.(?:py|yaml|yml|sh|toml|md)")
PAGE_IN_CODE = re.compile(r"\b(?:docs|bench|bags)/[\w/-]+\.md")
STEP = re.compile(r"^\| [^|]+ \| `(\w+)` \| `([\w/]+\.py)` \|$", re.MULTILINE)
# What a browser fetches by itself; links that a reader clicks are not in it.
FETCHED = re.compile(
    r"<(?:script|img|iframe)[^>]*\bsrc=[\"']?https?://|"
    r"<link[^>]*rel=[\"']?(?:stylesheet|preconnect|preload|icon)[\"']?[^>]*https?://|"
    r"@import url\(http"
)


@cache
def tracked() -> tuple[Path, ...]:
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    paths = (Path(line) for line in listed.stdout.splitlines())
    return tuple(path for path in paths if (ROOT / path).is_file())


PAGES = [str(path) for path in tracked() if path.suffix == ".md" and path.name not in HISTORY]


def anchors(text: str) -> set[str]:
    """The anchors that GitHub makes of the headings of a page."""
    headings = HEADING.findall(FENCE.sub("", text))
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", line).strip().lower() for line in headings]
    return {re.sub(r"[^\w\- ]", "", line).replace(" ", "-") for line in plain}


def broken_links(page: Path, text: str) -> list[str]:
    def is_broken(link: str) -> bool:
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists():
            return True
        has_anchors = bool(anchor) and target.suffix == ".md"
        return has_anchors and anchor not in anchors(target.read_text(encoding="utf-8"))

    links = LINK.findall(FENCE.sub("", text))
    return [link for link in links if not re.match(r"[a-z]+:", link) and is_broken(link)]


def missing_files(text: str) -> list[str]:
    """Source files named in backticks, perhaps without leading folders, that do not exist."""
    ends = {"/".join(path.parts[start:]) for path in tracked() for start in range(len(path.parts))}
    words = [word for code in CODE.findall(FENCE.sub("", text)) for word in code.split()]
    names = [word for word in words if SOURCE_PATH.fullmatch(word)]
    # Not names with a placeholder in capitals (`NAME.py`).
    checked = [re.sub(r"^(\.\./)+", "", name) for name in names if not Path(name).stem.isupper()]
    return [name for name in checked if name not in ends | ELSEWHERE]


def defined_in(path: Path) -> set[str]:
    kinds = (ast.FunctionDef, ast.ClassDef)
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, kinds)}


@pytest.mark.parametrize("page", PAGES)
def test_links_and_named_source_files_of_a_page_exist(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    assert broken_links(ROOT / page, text) == []
    assert missing_files(text) == []


def test_pages_named_in_code_exist():
    missing = {
        f"{path}: {name}"
        for path in tracked()
        if path.suffix in (".py", ".sh", ".toml", ".yaml")
        for name in PAGE_IN_CODE.findall((ROOT / path).read_text(encoding="utf-8"))
        if not (ROOT / name).exists()
    }
    assert missing == set()


def test_functions_of_the_equations_exist_where_the_table_says():
    text = (DEV / "method.md").read_text(encoding="utf-8")
    cells = [[CODE.findall(cell) for cell in line.strip("|").split("|")]
             for line in text.splitlines() if re.match(r"\| *\d+ *\|", line)]  # fmt: skip
    assert len(cells) == 10
    for _, _, functions, files, tests in cells:
        assert functions and files and tests
        assert set(functions) <= set().union(*(defined_in(PACKAGE / file) for file in files))
        assert all((ROOT / test).is_file() for test in tests)


def test_the_page_of_the_architecture_names_functions_and_every_folder():
    page = (DEV / "architecture.md").read_text(encoding="utf-8")
    steps = STEP.findall(page)
    assert len(steps) >= 20
    assert [step for step in steps if step[0] not in defined_in(ROOT / step[1])] == []
    described = set(re.findall(r"^\| `([\w.]+)/?` \|", page, re.MULTILINE))
    assert {path.parent.name for path in PACKAGE.glob("*/__init__.py")} <= described
    assert {"pipeline.py", "graph_builder.py", "config.py", "map_file.py"} <= described


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_the_site_has_all_pages_builds_strictly_and_fetches_nothing(root_dir, tmp_path):
    pytest.importorskip("mkdocs", reason="pip install 'deworldsg_ros[docs]'")
    text = (root_dir / "mkdocs.yml").read_text(encoding="utf-8")
    pages = [page for entry in yaml.safe_load(text)["nav"] for page in entry.values()]
    assert set(pages) == {path.name for path in (root_dir / "docs").glob("*.md")}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=root_dir, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    built = list(tmp_path.rglob("*.html"))
    assert len(built) >= 8
    for path in built:
        assert not FETCHED.search(path.read_text(encoding="utf-8")), path
    # A moving picture that a phone can load.
    assert (tmp_path / "images" / "growing.webp").stat().st_size < 1_500_000
