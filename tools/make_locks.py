#!/usr/bin/env python3
"""Write locks/: the exact versions and hashes of all requirements, for each Python.

python tools/make_locks.py [PYTHON ...]

PYTHON is an interpreter (default: python3.10 to python3.13 on PATH) with pip 22.2 or newer. pip
resolves the requirements of pyproject.toml for Linux x86-64, without installing anything.
scripts/bootstrap.sh installs these files if DEWORLDSG_LOCKED is set.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

from requirements import requirements  # noqa: E402

PYTHONS = ("python3.10", "python3.11", "python3.12", "python3.13")
VERSION = "import sys; print('%d.%d' % sys.version_info[:2])"
# The extras of each profile of scripts/bootstrap.sh. `run` has the versions of `test`.
PROFILES = {"test": ["build", "run", "ros", "test"], "run": ["build", "run", "ros"]}


def lock(python: str) -> dict[str, str]:
    """Text of the lock file of each profile. Raises CalledProcessError if pip finds no solution."""
    texts: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        constraints = Path(folder) / "constraints.txt"
        constraints.touch()
        for profile, extras in PROFILES.items():
            items = sorted(map(_line, _resolved(python, requirements(extras), constraints)))
            constraints.write_text("".join(f"{name}=={version}\n" for name, version, _ in items))
            texts[profile] = "".join(
                f"{name}=={version} --hash=sha256:{digest}\n" for name, version, digest in items
            )
    return texts


def _resolved(python: str, wanted: list[str], constraints: Path) -> list[dict[str, Any]]:
    # empy, of colcon, has no wheel.
    options = ["--only-binary=:all:", "--no-binary=empy", "--dry-run", "--ignore-installed"]
    command = [
        python,
        "-m",
        "pip",
        "install",
        *options,
        "--quiet",
        "--report=-",
        "-c",
        str(constraints),
        *wanted,
    ]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    items: list[dict[str, Any]] = json.loads(done.stdout)["install"]
    return items


def _line(item: dict[str, Any]) -> tuple[str, str, str]:
    """Name, version and hash. Only files of the package index are the same everywhere."""
    download = item["download_info"]
    if download["url"].startswith("file:"):
        raise SystemExit(f"{download['url']} is a local file; expected one of the package index")
    name = item["metadata"]["name"].lower().replace("_", "-").replace(".", "-")
    return name, item["metadata"]["version"], download["archive_info"]["hashes"]["sha256"]


if __name__ == "__main__":
    for interpreter in sys.argv[1:] or PYTHONS:
        tag = subprocess.check_output([interpreter, "-c", VERSION], text=True).strip()
        for profile, text in lock(interpreter).items():
            path = ROOT / "locks" / f"{profile}-{tag}.txt"
            path.write_text(text, encoding="utf-8")
            print(f"{path}: {text.count('==')} packages")
