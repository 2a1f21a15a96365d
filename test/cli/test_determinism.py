"""The same recording gives the same bytes, whatever the threads and the seed of hashes."""

from __future__ import annotations

import os
import subprocess

import pytest
from support.cli import COMMAND, DEMO_ROOM, environment

FRAMES = 15
FILES = ("out/scene_graph.json", "out/scene_graph.html", "out/scene_graph.png", "room.map")
MACHINES = (
    {"PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
    {"PYTHONHASHSEED": "4711", "OMP_NUM_THREADS": "3"},
)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_graph_map_page_and_picture_are_equal_to_the_byte(tmp_path):
    found = []
    for number, machine in enumerate(MACHINES):
        folder = tmp_path / str(number)
        folder.mkdir()
        command = [*COMMAND, "run", DEMO_ROOM, "--out", "out", "--map", "room.map"]
        subprocess.run(
            [*map(str, command), "--max-frames", str(FRAMES)],
            cwd=folder,
            env={**os.environ, **environment(folder), **machine},
            check=True,
            capture_output=True,
            timeout=280,
        )
        found.append({name: (folder / name).read_bytes() for name in FILES})
    assert [name for name in FILES if found[0][name] != found[1][name]] == []
