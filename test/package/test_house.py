"""The limits that keep the package readable; tools/house.py measures."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import msgspec
import pytest

from deworldsg_ros.config import Config
from deworldsg_ros.ros.options import DebugOptions, NodeOptions, ReplayOptions

# 57: `debug.faults`; 58: `output.publish_tf`. Both were asked for, and replace nothing.
MAX_OPTIONS = 58
MAX_FUNCTION_LINES = 60
MAX_CLASS_LINES = 200
MAX_NESTING = 4


def load_tool(root: Path) -> ModuleType:
    """tools/house.py as a module; dataclasses look it up in sys.modules."""
    spec = importlib.util.spec_from_file_location("house", root / "tools" / "house.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["house"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def tool(root_dir: Path) -> ModuleType:
    """tools/house.py."""
    return load_tool(root_dir)


def above(sizes: dict[str, int], limit: int) -> dict[str, int]:
    """The entries above a limit."""
    return {name: size for name, size in sizes.items() if size > limit}


def test_functions_classes_and_nesting_stay_readable(tool: ModuleType, root_dir: Path) -> None:
    house = tool.measure(root_dir)
    assert house.modules > 200
    assert above(house.functions, MAX_FUNCTION_LINES) == {}
    assert above(house.classes, MAX_CLASS_LINES) == {}
    assert above(house.nesting, MAX_NESTING) == {}


def test_no_modules_import_each_other_in_a_circle(tool: ModuleType, root_dir: Path) -> None:
    assert tool.circles(tool.measure(root_dir).imports) == []
    assert tool.circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_the_measuring_tool_counts_what_it_says(tool: ModuleType, tmp_path: Path) -> None:
    package = tmp_path / "deworldsg_ros"
    package.mkdir()
    (package / "a.py").write_text(
        "LIMIT_M = 0.5\nNAME = 'x'\n\ndef f(x):\n    if x:\n        for y in x:\n            pass\n"
        "    elif x is None:\n        pass\n"
    )
    house = tool.measure(tmp_path)
    assert (house.modules, house.lines, house.constants) == (1, 9, 1)
    assert house.functions == {"deworldsg_ros/a.py:f": 6}
    assert house.nesting == {"deworldsg_ros/a.py:f": 2}


def test_every_option_has_a_user() -> None:
    sections = msgspec.structs.fields(Config)
    count = sum(len(msgspec.structs.fields(section.type)) for section in sections)
    for options in (NodeOptions, DebugOptions, ReplayOptions):
        count += len(msgspec.structs.fields(options))
    assert 40 <= count <= MAX_OPTIONS
