#!/usr/bin/env python3
"""Measure what a reader of the package pays.

    python tools/house.py [CHECKOUT] [--frame]

Prints the figures of docs/dev/house.md: modules and lines, those that only one module of their
folder imports, import circles, the longest modules and functions, functions with many parameters,
kernels. With --frame also the modules that one frame enters, and the switches between them
(it runs the first frames of the shipped recording). test/package/test_house.py holds the limits.
"""

from __future__ import annotations

import argparse
import ast
import os
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice, pairwise
from pathlib import Path
from types import FrameType
from typing import Any

PACKAGE = "deworldsg_ros"
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
# Frames before the one that is traced: kernels are loaded, and nodes have come and changed.
FRAMES_BEFORE = 8


@dataclass
class House:
    """The figures of a package.

    Attributes:
        modules: lines of each module, by its dotted name; without tests and tools.
        functions: lines of each function, by "file:name".
        parameters: number of parameters of each function without self, by "file:name"; commands of
            the CLI are left out, whose parameters are the options of users.
        kernels: number of compiled functions.
        imports: modules of the package that each module imports, also inside of functions.
    """

    modules: dict[str, int] = field(default_factory=dict)
    functions: dict[str, int] = field(default_factory=dict)
    parameters: dict[str, int] = field(default_factory=dict)
    kernels: int = 0
    imports: dict[str, set[str]] = field(default_factory=dict)

    @property
    def lines(self) -> int:
        """Lines of all modules."""
        return sum(self.modules.values())

    @property
    def parts(self) -> list[str]:
        """Modules that one module alone imports, which lies in the same folder."""
        importers = defaultdict(set)
        for module, others in self.imports.items():
            for other in others - {module}:
                importers[other].add(module)
        return sorted(
            module
            for module in self.modules
            if {name.rpartition(".")[0] for name in importers[module]}
            == {module.rpartition(".")[0]}
            and len(importers[module]) == 1
        )


def measure(root: Path) -> House:
    """Measure the package below `root`."""
    house = House()
    trees = {
        path: ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted((root / PACKAGE).rglob("*.py"))
    }
    commands = _named(root / PACKAGE / "cli" / "app.py")
    for path, tree in trees.items():
        module = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        house.modules[module] = path.read_text(encoding="utf-8").count("\n")
        house.imports[module] = set(_imports(tree, root))
        for node in ast.walk(tree):
            if isinstance(node, FUNCTIONS):
                key = f"{path.relative_to(root).as_posix()}:{node.name}"
                decorators = set(map(ast.unparse, node.decorator_list))
                house.kernels += "kernel" in decorators
                house.functions[key] = max(house.functions.get(key, 0), _lines(node))
                is_command = any(".command(" in text for text in decorators)
                if not is_command and not (node.name in commands and "/cli/" in key):
                    house.parameters[key] = max(house.parameters.get(key, 0), _parameters(node))
    return house


def circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other (strongly connected components, Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for other in sorted(imports.get(module, ())):
            if other not in index:
                visit(other)
                low[module] = min(low[module], low[other])
            elif other in stack:
                low[module] = min(low[module], index[other])
        if low[module] == index[module]:
            group = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(group) > 1:
                found.append(sorted(group))

    for module in sorted(imports):
        if module not in index:
            visit(module)
    return found


def longest(sizes: dict[str, int], count: int = 3) -> list[tuple[str, int]]:
    """The largest entries, largest first."""
    return sorted(sizes.items(), key=lambda item: (-item[1], item[0]))[:count]


def _lines(node: ast.AST) -> int:
    return int(node.end_lineno) - int(node.lineno) + 1  # type: ignore[attr-defined]


def _parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    of = node.args
    names = [item.arg for item in (*of.posonlyargs, *of.args, *of.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def _named(path: Path) -> set[str]:
    """Names X of all `module.X` in a file: the commands that the program registers."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if path.exists() else ()
    return {node.attr for node in nodes if isinstance(node, ast.Attribute)}


def _imports(tree: ast.Module, root: Path) -> Iterator[str]:
    """Modules of the package that are imported; TYPE_CHECKING and functions included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == PACKAGE:
            base = str(node.module)
            for alias in node.names:
                whole = f"{base}.{alias.name}"
                yield whole if _is_module(whole, root) else base


def _is_module(name: str, root: Path) -> bool:
    path = root.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def trace_frame(root: Path) -> tuple[set[str], int, int]:
    """Trace what one frame of the shipped recording enters, in one process.

    Returns:
        The modules, the number of switches from one module to another, and of calls of Python.
    """
    sys.path.insert(0, str(root))
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    import msgspec

    from deworldsg_ros.config import Config
    from deworldsg_ros.pipeline import Pipeline
    from deworldsg_ros.recordings.recording import open_recording

    config = Config()
    perception = msgspec.structs.replace(config.perception, threads=1)
    pipeline = Pipeline(msgspec.structs.replace(config, perception=perception))
    recording = open_recording(root / "bags" / "demo_room")
    frames = list(islice(recording.frames(), FRAMES_BEFORE + 1))
    recording.close()
    entered: list[str] = []
    folder = str(root / PACKAGE) + os.sep

    def note(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(folder):
            entered.append(frame.f_code.co_filename.removeprefix(folder))

    for number, frame in enumerate(frames):
        sys.setprofile(note if number == FRAMES_BEFORE else None)
        pipeline.process(frame)
        assert pipeline.builder is not None
        pipeline.builder.update()
    sys.setprofile(None)
    return set(entered), sum(one != other for one, other in pairwise(entered)), len(entered)


def main() -> None:
    """Print the figures of a checkout."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checkout", type=Path, nargs="?")
    parser.add_argument("--frame", action="store_true", help="also trace one frame")
    options = parser.parse_args()
    root = (options.checkout or Path(__file__).resolve().parents[1]).resolve()
    house = measure(root)
    share = len(house.parts) / len(house.modules)
    print(f"modules {len(house.modules)}, lines {house.lines}, kernels {house.kernels}")
    print(f"imported by one module of their folder only: {len(house.parts)} ({share:.1%})")
    print("  " + ", ".join(name.removeprefix(f"{PACKAGE}.") for name in house.parts))
    for title, sizes in (
        ("lines of a module", house.modules),
        ("lines of a function", house.functions),
        ("parameters of a function", house.parameters),
    ):
        shown = ", ".join(f"{name} {size}" for name, size in longest(sizes, 5))
        print(f"most {title}: {shown}")
    found = circles(house.imports)
    print(f"import circles: {len(found)}")
    for group in found:
        print("  " + ", ".join(group))
    if options.frame:
        modules, switches, calls = trace_frame(root)
        print(f"a frame: {len(modules)} modules, {switches} switches, {calls} calls")


if __name__ == "__main__":
    main()
