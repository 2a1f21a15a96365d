"""No weights that can contain code, no server that strangers can reach."""

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

from deworldsg_ros.cli.app import view
from deworldsg_ros.ros.options import FleetOptions, ViewerOptions

# A loader, and the keyword that it needs.
LOADERS = {"from_pretrained": "use_safetensors", "load": "weights_only"}
CONFIGURATIONS = {"AutoConfig", "AutoTokenizer"}  # without weights
# Reads pickles without running them.
UNPICKLER = "deworldsg_ros/evaluation/predictions.py"
ANYWHERE = ("0.0.0.0", "::", "[::]")


def sources(root: Path) -> Iterator[tuple[str, ast.Module]]:
    for folder in ("deworldsg_ros", "tools", "bench", "launch"):
        for path in sorted((root / folder).rglob("*.py")):
            yield path.relative_to(root).as_posix(), ast.parse(path.read_text(encoding="utf-8"))


def calls(tree: ast.Module) -> Iterator[tuple[str, str, ast.Call]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            yield ast.unparse(node.func.value), node.func.attr, node


def test_weights_are_read_as_safetensors_or_as_tensors_alone(root_dir):
    loads = []
    for name, tree in sources(root_dir):
        for owner, called, node in calls(tree):
            last = owner.rpartition(".")[2]
            if called not in LOADERS or (called == "load" and last != "torch"):
                continue
            if last in CONFIGURATIONS or "Processor" in last:
                continue
            given = {word.arg: ast.unparse(word.value) for word in node.keywords}
            assert given.get(LOADERS[called]) == "True", f"{name}:{node.lineno}"
            loads.append(name)
    assert any("checkpoints" in name for name in loads)


def test_the_package_runs_no_code_of_a_file(root_dir):
    for name, tree in sources(root_dir):
        if not name.startswith("deworldsg_ros/"):  # others read pickles that they wrote
            continue
        text = ast.unparse(tree)
        assert "trust_remote_code" not in text, name
        for owner, called, node in calls(tree):
            unpickles = owner in ("pickle", "joblib", "dill", "cloudpickle")
            if unpickles and called in ("load", "loads", "Unpickler"):
                assert name == UNPICKLER, f"{name}:{node.lineno}"
            if owner in ("np", "numpy") and called == "load":
                given = {word.arg: ast.unparse(word.value) for word in node.keywords}
                assert given.get("allow_pickle", "False") == "False", f"{name}:{node.lineno}"
            assert (owner, called) != ("yaml", "unsafe_load"), f"{name}:{node.lineno}"


def test_servers_listen_to_this_machine_alone_by_default(root_dir):
    """An address for all machines stands in texts at most."""
    for name, tree in sources(root_dir):
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert node.value not in ANYWHERE, f"{name}:{node.lineno}"
    assert FleetOptions().listen == "tcp/127.0.0.1:7447"
    assert ViewerOptions().host == "127.0.0.1"
    assert inspect.signature(view).parameters["host"].default == "127.0.0.1"
