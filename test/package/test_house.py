"""The limits that keep the package readable; tools/house.py measures."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import msgspec
import pytest

from deworldsg_ros.config import Config
from deworldsg_ros.ros.options import NodeOptions, ReplayOptions

MAX_OPTIONS = 58
MAX_MODULES = 220
MAX_MODULE_LINES = 700
MAX_FUNCTION_LINES = 100
MAX_PARAMETERS = 22
# Of all modules: those that one module of their folder alone imports.
MAX_PARTS = 0.09
MAX_KERNELS = 202
# Of one frame.
MAX_ENTERED, MAX_SWITCHES = 50, 520


@pytest.fixture(scope="module")
def tool(root_dir: Path) -> ModuleType:
    """tools/house.py as a module; dataclasses look it up in sys.modules."""
    spec = importlib.util.spec_from_file_location("house", root_dir / "tools" / "house.py")
    module = sys.modules["house"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def above(sizes: dict[str, int], limit: int) -> dict[str, int]:
    """The entries above a limit."""
    return {name: size for name, size in sizes.items() if size > limit}


def test_the_package_stays_readable(tool: ModuleType, root_dir: Path) -> None:
    house = tool.measure(root_dir)
    assert 100 < len(house.modules) <= MAX_MODULES
    assert above(house.modules, MAX_MODULE_LINES) == {}
    assert above(house.functions, MAX_FUNCTION_LINES) == {}
    assert above(house.parameters, MAX_PARAMETERS) == {}
    assert house.kernels <= MAX_KERNELS
    assert len(house.parts) <= MAX_PARTS * len(house.modules), house.parts


def test_a_frame_stays_in_few_modules(tool: ModuleType, root_dir: Path) -> None:
    code = (
        "import sys, pathlib, house\n"
        "print(*map(repr, house.trace_frame(pathlib.Path(sys.argv[1]))), sep=chr(10))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(root_dir)],
        cwd=root_dir / "tools",
        capture_output=True,
        text=True,
        check=True,
    )
    modules, switches, _ = map(ast.literal_eval, done.stdout.splitlines())
    assert 20 < len(modules) <= MAX_ENTERED
    assert switches <= MAX_SWITCHES


def test_no_modules_import_each_other_in_a_circle(tool: ModuleType, root_dir: Path) -> None:
    assert tool.circles(tool.measure(root_dir).imports) == []
    assert tool.circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_every_option_has_a_user() -> None:
    sections = msgspec.structs.fields(Config)
    count = sum(len(msgspec.structs.fields(section.type)) for section in sections)
    for options in (NodeOptions, ReplayOptions):
        count += len(msgspec.structs.fields(options))
    assert 40 <= count <= MAX_OPTIONS
