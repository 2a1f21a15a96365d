"""The files that ROS 2 expects beside the Python package; pyproject.toml has most of the rest."""

from __future__ import annotations

from pathlib import Path

from setuptools import setup

PACKAGE = "deworldsg_ros"
ROOT = Path(__file__).resolve().parent


def files_below(folder: str, target: str) -> list[tuple[str, list[str]]]:
    """Return `data_files` entries that put the data files below `folder` under `target`."""
    entries: dict[str, list[str]] = {}
    for path in sorted((ROOT / folder).rglob("*")):
        if path.is_file() and path.suffix not in (".py", ".pyc"):
            relative = path.relative_to(ROOT)
            inside = relative.parent.relative_to(folder)
            entries.setdefault((Path(target) / inside).as_posix(), []).append(relative.as_posix())
    return list(entries.items())


setup(
    name=PACKAGE,
    license="Apache-2.0",
    python_requires=">=3.10,<3.14",
    # The nodes' executables (scripts/ros) go to lib/deworldsg_ros, where `ros2 run` looks, with
    # `colcon build` and with `pip install` alike. Each is a shim that finds its Python.
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", sorted(str(path) for path in Path("launch").glob("*.py"))),
        *files_below("config", f"share/{PACKAGE}/config"),
        *files_below("msg_schemas", f"share/{PACKAGE}/msg_schemas"),
        *files_below("bags", f"share/{PACKAGE}/bags"),
        *files_below("scripts/ros", f"lib/{PACKAGE}"),
    ],
)
