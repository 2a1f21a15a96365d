#!/usr/bin/env python3
"""Measure the size and the structure of the package.

python tools/house.py [CHECKOUT]

Prints the figures of docs/dev/house.md: modules, lines, numeric constants, the longest function and
class, the deepest nesting, import circles. test/package/test_house.py holds the limits.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

PACKAGE = "deworldsg_ros"
BLOCKS = (ast.If, ast.For, ast.While, ast.With, ast.Try, ast.AsyncFor, ast.AsyncWith)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass
class House:
    """The figures of a package.

    Attributes:
        modules, lines: of the package, without tests and tools.
        constants: module-level names whose value is a number or a tuple of numbers.
        functions, classes: lines of each, by "file:name".
        nesting: depth of nested blocks of each function, by "file:name".
        imports: modules of the package that each module imports when it is loaded.
    """

    modules: int = 0
    lines: int = 0
    constants: int = 0
    functions: dict[str, int] = field(default_factory=dict)
    classes: dict[str, int] = field(default_factory=dict)
    nesting: dict[str, int] = field(default_factory=dict)
    imports: dict[str, set[str]] = field(default_factory=dict)


def measure(root: Path) -> House:
    """Measure the package below `root`."""
    house = House()
    for path in sorted((root / PACKAGE).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        name = path.relative_to(root).as_posix()
        house.modules += 1
        house.lines += text.count("\n")
        house.constants += sum(map(_is_numeric_constant, tree.body))
        module = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        house.imports[module] = set(_imports(tree, root))
        for node in ast.walk(tree):
            if isinstance(node, FUNCTIONS):
                key = f"{name}:{node.name}"
                house.functions[key] = max(house.functions.get(key, 0), _lines(node))
                house.nesting[key] = max(house.nesting.get(key, 0), _depth(node))
            elif isinstance(node, ast.ClassDef):
                house.classes[f"{name}:{node.name}"] = _lines(node)
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


def _depth(node: ast.AST, depth: int = 0) -> int:
    """Depth of nested blocks; `elif` does not nest, and nested functions count by themselves."""
    deepest = depth
    for child in ast.iter_child_nodes(node):
        if isinstance(child, FUNCTIONS):
            continue
        is_elif = isinstance(node, ast.If) and isinstance(child, ast.If) and [child] == node.orelse
        deepest = max(deepest, _depth(child, depth + (isinstance(child, BLOCKS) and not is_elif)))
    return deepest


def _is_numeric_constant(node: ast.stmt) -> bool:
    value = node.value if isinstance(node, (ast.Assign, ast.AnnAssign)) else None
    if value is None:
        return False
    allowed = (ast.Constant, ast.UnaryOp, ast.BinOp, ast.Tuple, ast.operator, ast.unaryop, ast.Load)
    numbers = [
        item.value
        for item in ast.walk(value)
        if isinstance(item, ast.Constant) and type(item.value) in (int, float)
    ]
    return bool(numbers) and all(isinstance(item, allowed) for item in ast.walk(value))


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


def main() -> None:
    """Print the figures of a checkout."""
    root = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).resolve().parents[1])
    house = measure(root)
    print(f"modules {house.modules}, lines {house.lines}, numeric constants {house.constants}")
    for title, sizes, limit in (
        ("functions above 60 lines", house.functions, 60),
        ("classes above 200 lines", house.classes, 200),
        ("functions nested deeper than 4", house.nesting, 4),
    ):
        above = sum(size > limit for size in sizes.values())
        shown = ", ".join(f"{name} {size}" for name, size in longest(sizes))
        print(f"{title}: {above}; largest: {shown}")
    found = circles(house.imports)
    print(f"import circles: {len(found)}")
    for group in found:
        print("  " + ", ".join(group))


if __name__ == "__main__":
    main()
