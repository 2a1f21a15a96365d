"""Both ways to install, each into an empty folder, and what a ROS 2 user then finds there."""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from ament_index_python.packages import get_package_prefix, get_package_share_directory

PACKAGE = "deworldsg_ros"
SCRIPTS = Path(__file__).parents[2] / "scripts" / "ros"
EXECUTABLES = {path.name for path in SCRIPTS.iterdir()}
SOURCES = (
    *("deworldsg_ros", "resource", "launch", "config", "msg_schemas", "bags", "scripts"),
    *("package.xml", "setup.py", "setup.cfg", "pyproject.toml", "README.md", "LICENSE"),
)
SHARED = ("launch", "config", "msg_schemas", "bags")


@dataclass(frozen=True)
class Install:
    """An installation: what AMENT_PREFIX_PATH names, and where Python imports the package from."""

    prefix: Path
    site: Path

    def environment(self) -> dict[str, str]:
        """The environment of a shell in which the installation is sourced."""
        return {
            **os.environ,
            "AMENT_PREFIX_PATH": f"{self.prefix}:{os.environ['AMENT_PREFIX_PATH']}",
            "PYTHONPATH": f"{self.site}:{os.environ.get('PYTHONPATH', '')}".rstrip(":"),
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        }


def run(*command: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command; its errors are in its output."""
    kept = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "timeout": 110}
    return subprocess.run(list(map(str, command)), **{**kept, **options})


def copy_sources(root: Path, target: Path) -> Path:
    """A copy, because both builders leave files beside what they build."""
    for name in SOURCES:
        copy = shutil.copytree if (root / name).is_dir() else shutil.copy2
        copy(root / name, target / name)
    return target


def install_with_pip(source: Path, folder: Path) -> Path:
    # Without --ignore-installed pip would first uninstall the package from this environment.
    options = ("--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--ignore-installed")
    pip = (sys.executable, "-m", "pip", "install", *options)
    done = run(*pip, "--prefix", folder / "prefix", source, cwd=folder)
    assert done.returncode == 0, done.stdout
    return folder / "prefix"


def install_with_colcon(source: Path, folder: Path) -> Path:
    colcon = shutil.which("colcon", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    assert colcon is not None, "colcon is missing: scripts/test installs it"
    done = run(colcon, "--log-base", "log", "build", "--base-paths", source, cwd=folder)
    assert done.returncode == 0, done.stdout
    return folder / "install" / PACKAGE


BUILDERS = {"pip": install_with_pip, "colcon": install_with_colcon}


@pytest.fixture(scope="module", params=sorted(BUILDERS))
def install(request, root_dir, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    prefix = BUILDERS[request.param](copy_sources(root_dir, folder / "source"), folder)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    return Install(prefix, prefix / "lib" / version / "site-packages")


def files_below(folder: Path) -> set[str]:
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_ros_finds_the_files_of_the_checkout_and_each_executable_once(
    install, root_dir, monkeypatch
):
    monkeypatch.setenv("AMENT_PREFIX_PATH", install.environment()["AMENT_PREFIX_PATH"])
    assert get_package_prefix(PACKAGE) == str(install.prefix)
    share = Path(get_package_share_directory(PACKAGE))
    assert (share / "package.xml").is_file()
    for folder in SHARED:
        wanted = files_below(root_dir / folder)
        if folder != "launch":
            wanted = {name for name in wanted if not name.endswith(".py")}
        assert wanted <= files_below(share / folder)
    assert files_below(share / "launch") == {"deworldsg.launch.py", "realsense.launch.py"}
    folder = install.prefix / "lib" / PACKAGE
    assert {path.name for path in folder.iterdir()} == EXECUTABLES >= {"graph_node", "replay_node"}
    assert all(os.access(path, os.X_OK) for path in folder.iterdir())
    assert {path.name for path in (install.prefix / "bin").iterdir()} == {"deworldsg"}


@pytest.mark.parametrize("executable", sorted(EXECUTABLES))
def test_executable_starts_its_node(install, tmp_path, executable):
    """A configuration that cannot be used ends a node at start-up, with status 2 and the reason."""
    command = (install.prefix / "lib" / PACKAGE / executable, "--ros-args", "-p", "no_such:=1")
    done = run(*command, cwd=tmp_path, env=install.environment())
    assert done.returncode == 2, done.stdout
    assert "no_such" in done.stdout


def test_the_package_is_complete_and_its_command_runs(install, root_dir, tmp_path):
    installed = files_below(install.site / PACKAGE)
    assert files_below(root_dir / PACKAGE) <= installed
    assert any(name.endswith(".onnx") for name in installed)
    command = install.prefix / "bin" / "deworldsg"
    text = run(command, "--help", cwd=tmp_path, env=install.environment()).stdout
    for name in ("run", "demo", "convert", "info", "config", "evaluate"):
        assert re.search(rf"^ +{name} +[A-Z]", text, re.M), text


@pytest.mark.parametrize("prefix_has_python", [True, False])
def test_executable_prefers_the_python_of_its_prefix(tmp_path, prefix_has_python):
    """`.venv/lib/deworldsg_ros/graph_node` works where .venv is not activated."""
    executable = tmp_path / "a prefix" / "lib" / PACKAGE / "graph_node"
    executable.parent.mkdir(parents=True)
    shutil.copy(SCRIPTS / "graph_node", executable)
    pythons = {"path": tmp_path / "elsewhere", "prefix": tmp_path / "a prefix" / "bin"}
    for name, folder in list(pythons.items())[: 1 + prefix_has_python]:
        folder.mkdir()
        (folder / "python3").write_text(f'#!/bin/sh\necho {name} "$2"\n')
        (folder / "python3").chmod(0o755)
    done = run(executable, "an argument", env={"PATH": f"{pythons['path']}:/usr/bin:/bin"})
    assert done.stdout == f"{'prefix' if prefix_has_python else 'path'} an argument\n"
