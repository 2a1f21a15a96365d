"""Build of the ROS 2 package `deworldsg_ros`, for `colcon build` and for `pip install`."""

from __future__ import annotations

import re
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "deworldsg_ros"
ROOT = Path(__file__).resolve().parent


def read_version() -> str:
    """Return the version in `deworldsg_ros/__init__.py`, without importing the package."""
    text = (ROOT / PACKAGE / "__init__.py").read_text(encoding="utf-8")
    found = re.search(r'^__version__ = "([^"]+)"', text, re.MULTILINE)
    if found is None:
        raise RuntimeError(f'{PACKAGE}/__init__.py has no line __version__ = "…"')
    return found.group(1)


def read_requirements() -> list[str]:
    """Return the run-time requirements, which have one home: requirements.txt."""
    lines = (ROOT / "requirements.txt").read_text(encoding="utf-8").splitlines()
    return [line.strip() for line in lines if line.strip() and not line.startswith(("#", "-"))]


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
    version=read_version(),
    description="Live 3D semantic scene graphs from an RGB-D camera, with world-model relations",
    maintainer="deworldsg_ros maintainers",
    maintainer_email="maintainers@deworldsg-ros.invalid",
    license="Apache-2.0",
    python_requires=">=3.10,<3.14",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed", "**/weights/*", "**/assets/*"]},
    install_requires=read_requirements(),
    extras_require={
        "models": ["torch>=2.5,<3", "transformers>=5.0,<6", "safetensors>=0.4.5,<1"],
        "cluster": ["distributed>=2024.8,<2027"],
    },
    # Executables: see the shim itself for how it finds its Python.
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", sorted(str(path) for path in Path("launch").glob("*.py"))),
        *files_below("config", f"share/{PACKAGE}/config"),
        *files_below("msg_schemas", f"share/{PACKAGE}/msg_schemas"),
        *files_below("bags", f"share/{PACKAGE}/bags"),
        *files_below("scripts/ros", f"lib/{PACKAGE}"),
    ],
    entry_points={"console_scripts": [f"deworldsg = {PACKAGE}.cli:main"]},
    zip_safe=False,
)
