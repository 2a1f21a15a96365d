#!/usr/bin/env python3
"""Print what the project needs, one requirement a line, as pyproject.toml has it.

python3 scripts/requirements.py [EXTRA ...]

Without an extra: the run-time dependencies. With extras: those of the extras, and `run` for the
run-time dependencies. Used by scripts/bootstrap.sh, and for a ROS workspace:

    python3 -m pip install $(python3 scripts/requirements.py)
"""

from __future__ import annotations

import sys
from pathlib import Path

try:
    import tomllib
except ImportError:  # Python 3.10: pip carries a copy
    from pip._vendor import tomli as tomllib  # type: ignore[no-redef]

PYPROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def requirements(extras: list[str]) -> list[str]:
    """The requirements of `run` and of extras, in order; raises KeyError for an unknown extra."""
    project = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    known = {"run": project["dependencies"], **project["optional-dependencies"]}
    return [line for extra in extras or ["run"] for line in known[extra]]


if __name__ == "__main__":
    try:
        print("\n".join(requirements(sys.argv[1:])))
    except KeyError as error:
        sys.exit(f"scripts/requirements.py: pyproject.toml has no extra {error}")
