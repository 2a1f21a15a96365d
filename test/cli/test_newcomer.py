"""The steps of scripts/newcomer.md, in parts; `scripts/newcomer` does them all in a new clone."""

import importlib.util
import os
import sys
from pathlib import Path

import pytest
from support.cli import DEMO_ROOM, ROOT, deworldsg

SPEC = importlib.util.spec_from_file_location("newcomer", ROOT / "scripts" / "newcomer.py")
newcomer = importlib.util.module_from_spec(SPEC)
sys.modules["newcomer"] = newcomer
SPEC.loader.exec_module(newcomer)

PARTS = newcomer.read_parts()
# What each part needs that is no requirement.
EXTRAS = {"Python, and an agent": "mcp", "It is corrected, and kept": "ladybug", "A fleet": "zenoh"}


@pytest.fixture(scope="module")
def demo_out(tmp_path_factory):
    """A folder with what the first part makes."""
    folder = tmp_path_factory.mktemp("newcomer")
    done = deworldsg(folder, "run", DEMO_ROOM, "--out", "demo_out", "--map", "room.map")
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture
def environment(tmp_path):
    """That of a terminal with .venv activated, with the `deworldsg` of this checkout."""
    command = tmp_path / "bin" / "deworldsg"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m deworldsg_ros.cli "$@"\n')
    command.chmod(0o755)
    path = os.pathsep.join(
        [str(command.parent), str(Path(sys.executable).parent), os.environ["PATH"]]
    )
    return {
        **os.environ,
        "PATH": path,
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        "ROS_LOG_DIR": str(tmp_path / "ros"),
        "COLUMNS": "140",
    }


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("title", [title for title in PARTS if title not in newcomer.INSTALLING])
def test_each_step_prints_what_it_must(title, demo_out, environment, tmp_path, monkeypatch):
    pytest.importorskip(EXTRAS.get(title, "json"))
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "bags").symlink_to(DEMO_ROOM.parent)
    for path in demo_out.iterdir():
        (folder / path.name).symlink_to(path) if path.is_dir() else os.link(
            path, folder / path.name
        )
    monkeypatch.chdir(folder)
    newcomer.run_part(PARTS[title], environment)


def test_there_are_sixty_steps():
    assert sum(map(len, PARTS.values())) >= 60


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("$ echo cup\ncu+p", None),
        ("$ python - <<'END'\n> print(1 + 1)\n> END\n^2", None),
        ("$ false\n[exit 1]", None),
        ("$ echo cup\nmug", "'mug' is not in its output"),
        ("$ false", "exit code 1, expected 0"),
        ("$ sleep 60", "no end within"),
        ("$ echo ready; sleep 60 &\nready", None),
        ("$ echo not &\nready", "'ready' is not in its output"),
    ],
)
def test_a_step_that_prints_something_else_is_an_error(tmp_path, text, problem):
    page = tmp_path / "steps.md"
    page.write_text(f"# Steps\n\n## Part\n\n```console\n{text}\n```\n")
    (steps,) = newcomer.read_parts(page).values()
    if problem is None:
        newcomer.run_part(steps, dict(os.environ), 5.0)
    else:
        with pytest.raises(newcomer.StepError, match=problem):
            newcomer.run_part(steps, dict(os.environ), 1.0)
