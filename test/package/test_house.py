"""The limits that keep the package readable; tools/house.py measures."""

import ast
import importlib.util
import subprocess
import sys

import msgspec
import pytest

from deworldsg_ros.config import Config
from deworldsg_ros.ros.options import NodeOptions, ReplayOptions

MAX_OPTIONS = 60
MAX_MODULES = 220
MAX_MODULE_LINES = 700
MAX_FUNCTION_LINES = 100
MAX_PARAMETERS = 8
# Of all modules: those that one module of their folder alone imports.
MAX_PARTS = 0.08
MAX_KERNELS = 120
# Of one frame.
MAX_ENTERED, MAX_SWITCHES = 45, 490


@pytest.fixture(scope="module")
def tool(root_dir):
    """tools/house.py as a module; dataclasses look it up in sys.modules."""
    spec = importlib.util.spec_from_file_location("house", root_dir / "tools" / "house.py")
    module = sys.modules["house"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_package_stays_readable(tool, root_dir):
    house = tool.measure(root_dir)
    assert 100 < len(house.modules) <= MAX_MODULES
    for sizes, limit in (
        (house.modules, MAX_MODULE_LINES),
        (house.functions, MAX_FUNCTION_LINES),
        (house.parameters, MAX_PARAMETERS),
    ):
        assert {name: size for name, size in sizes.items() if size > limit} == {}
    assert house.kernels <= MAX_KERNELS
    assert len(house.parts) <= MAX_PARTS * len(house.modules), house.parts


def test_a_frame_stays_in_few_modules(root_dir):
    code = (
        "import pathlib, house\n"
        "print(*map(repr, house.trace_frame(pathlib.Path().absolute().parent)), sep=chr(10))"
    )
    command = [sys.executable, "-c", code]
    traced = subprocess.check_output(command, cwd=root_dir / "tools", text=True)
    modules, switches, _ = map(ast.literal_eval, traced.splitlines())
    assert 20 < len(modules) <= MAX_ENTERED
    assert switches <= MAX_SWITCHES


def test_no_modules_import_each_other_in_a_circle(tool, root_dir):
    assert tool.circles(tool.measure(root_dir).imports) == []
    assert tool.circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_every_option_has_a_user():
    sections = msgspec.structs.fields(Config)
    count = sum(len(msgspec.structs.fields(section.type)) for section in sections)
    for options in (NodeOptions, ReplayOptions):
        count += len(msgspec.structs.fields(options))
    assert 40 <= count <= MAX_OPTIONS
