"""Compilation of kernels: ahead, in several processes, and announced only when it happens."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from deworldsg_ros.cli import run
from deworldsg_ros.graph_builder import KERNEL_PARTS

SCRIPT = """
import sys
from small import twice, thrice
assert "numba" not in sys.modules
from deworldsg_ros.base.kernels import on_compilation
on_compilation(lambda: print("compiling"))
assert twice(2) == 4 and thrice(2) == 6
import small
assert small.twice is twice.dispatcher and small.thrice.signatures
"""
KERNELS = """
from deworldsg_ros.base.kernels import kernel

@kernel
def twice(x):
    return 2 * x

@kernel
def thrice(x):
    return twice(x) + x
"""


def run_script(folder: Path) -> str:
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(folder / "cache"),
        "PYTHONPATH": f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
    }
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return done.stdout


def test_compilation_is_announced_once_and_only_if_it_happens(tmp_path: Path) -> None:
    (tmp_path / "small.py").write_text(KERNELS)
    assert run_script(tmp_path).splitlines() == ["compiling"]
    assert run_script(tmp_path) == ""  # loaded from the cache


def test_all_kernels_of_a_run_have_a_part() -> None:
    assert set(run.PARTS) == {"perception", "lifting", *KERNEL_PARTS}


def test_a_part_is_compiled_in_another_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "PARTS", {"pairs": None})  # only here, not in that process
    run.compile_kernels(Console(quiet=True))


def test_a_failed_part_is_reported_with_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "PARTS", {"nothing": None})
    with pytest.raises(run.CompilationFailed, match="KeyError: 'nothing'"):
        run.compile_kernels(Console(quiet=True))
