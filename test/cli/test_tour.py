"""scripts/tour: everything that a user does with a graph, once from start to end."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_tour(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]])}
    done = subprocess.run(
        [
            sys.executable,
            ROOT / "scripts" / "tour.py",
            ROOT / "bags" / "demo_room",
            tmp_path / "out",
        ],
        capture_output=True,
        text=True,
        env=environment,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert ">>> which cup is on the table, where\ncup #" in done.stdout
    assert "not sure" in done.stdout
    assert "stand at" in done.stdout
    assert "transform found" in done.stdout
    assert "is a 'my mug'" in done.stdout and "undone: delete" in done.stdout
    assert "labelled by hand: True" in done.stdout and "undone: split" in done.stdout
    assert "relabelled" in done.stdout
    assert "MCP find" in done.stdout or "mcp is not installed" in done.stdout
