#!/usr/bin/env python3
"""Print the requirements in pyproject.toml, one per line.

python3 scripts/requirements.py [EXTRA ...]

EXTRA is an optional dependency group, or `run` for the run-time dependencies (the default).
scripts/bootstrap.sh calls this file. In a ROS workspace, install the requirements with:

    python3 -m pip install $(python3 scripts/requirements.py)
"""

from __future__ import annotations

import sys
from pathlib import Path

try:
    import tomllib
except ImportError:  # Python 3.10; pip contains a copy
    from pip._vendor import tomli as tomllib  # type: ignore[no-redef]

PYPROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def requirements(extras: list[str]) -> list[str]:
    """The requirements of the extras, in order. Raises KeyError for an unknown extra."""
    project = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    known = {"run": project["dependencies"], **project["optional-dependencies"]}
    return [line for extra in extras or ["run"] for line in known[extra]]


if __name__ == "__main__":
    try:
        print("\n".join(requirements(sys.argv[1:])))
    except KeyError as error:
        sys.exit(f"scripts/requirements.py: no extra {error} in pyproject.toml")
