#!/usr/bin/env python3
"""Write locks/: the exact versions and hashes of all requirements, for each Python.

python tools/make_locks.py [--add] [PYTHON ...]

PYTHON is an interpreter (default: python3.10 to python3.13 on PATH) with pip 22.2 or newer. pip
resolves the requirements of pyproject.toml for Linux x86-64, without installing anything. With
--add, the files keep what they have, and get what they lack: minutes in place of a quarter of an
hour.
scripts/bootstrap.sh installs these files if DEWORLDSG_LOCKED is set.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

from requirements import requirements  # noqa: E402

PYTHONS = ("python3.10", "python3.11", "python3.12", "python3.13")
# Version and hash.
Line = tuple[str, str]
PINNED = re.compile(r"([^\s\[]+)(?:\[(\S+)\])?==(\S+) --hash=sha256:(\S+)")
NAME = re.compile(r"[<>=!~;\[ ]")
VERSION = "import sys; print('%d.%d' % sys.version_info[:2])"
# The extras of each profile of scripts/bootstrap.sh. `run` has the versions of `test`.
PROFILES = {"test": ["build", "run", "ros", "test"], "run": ["build", "run", "ros"]}


def lock(python: str, kept: dict[str, dict[str, Line]]) -> dict[str, dict[str, Line]]:
    """Version and hash by name, for each profile.

    Args:
        python: interpreter.
        kept: the same, of files that keep what they have; empty = nothing is kept.

    Raises:
        CalledProcessError: pip finds no solution.
    """
    found: dict[str, dict[str, Line]] = {}
    pinned: dict[str, Line] = {}
    with tempfile.TemporaryDirectory() as folder:
        constraints = Path(folder) / "constraints.txt"
        for profile, extras in PROFILES.items():
            have = kept.get(profile, {})
            pinned = {**have, **pinned}
            lines = [f"{name}=={version}\n" for name, (version, _) in pinned.items()]
            constraints.write_text("".join(lines))
            wanted = [
                line for line in requirements(extras) if _name(NAME.split(line)[0]) not in have
            ]
            items = _resolved(python, wanted, constraints) if wanted else []
            new = [item for item in items if _name(item["metadata"]["name"]) not in have]
            found[profile] = {**dict(map(_line, new)), **have}
            pinned = found[profile]
    return found


# Extras by the name of a package. pip asks for them in a lock, too: without, it refuses a lock as
# soon as there is a newer version than the pinned one.
_extras: dict[str, set[str]] = {}


def _note_extras(requirements: list[str]) -> None:
    for requirement in map(Requirement, requirements):
        is_used = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if requirement.extras and is_used:
            _extras.setdefault(_name(requirement.name), set()).update(requirement.extras)


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
    for item in items:
        _note_extras(item["metadata"].get("requires_dist", []))
    return items


def _line(item: dict[str, Any]) -> tuple[str, Line]:
    """Name, and version and hash. Only files of the package index are the same everywhere."""
    download = item["download_info"]
    if download["url"].startswith("file:"):
        raise SystemExit(f"{download['url']} is a local file; expected one of the package index")
    version, digest = item["metadata"]["version"], download["archive_info"]["hashes"]["sha256"]
    return _name(item["metadata"]["name"]), (version, digest)


def _name(text: str) -> str:
    return re.sub(r"[-_.]+", "-", text).lower()


def _read(path: Path) -> dict[str, Line]:
    lines = path.read_text(encoding="utf-8").splitlines()
    matches = [match for match in map(PINNED.fullmatch, lines) if match]
    _note_extras([f"{match[1]}[{match[2]}]" for match in matches if match[2]])
    return {match[1]: (match[3], match[4]) for match in matches}


def _with_extras(name: str) -> str:
    extras = ",".join(sorted(_extras.get(name, ())))
    return f"{name}[{extras}]" if extras else name


def main(arguments: list[str]) -> None:
    """Write the files of each Python."""
    add = "--add" in arguments
    for python in [name for name in arguments if name != "--add"] or PYTHONS:
        tag = subprocess.check_output([python, "-c", VERSION], text=True).strip()
        paths = {profile: ROOT / "locks" / f"{profile}-{tag}.txt" for profile in PROFILES}
        kept = {profile: _read(path) for profile, path in paths.items()} if add else {}
        for profile, items in lock(python, kept).items():
            lines = [
                f"{_with_extras(name)}=={version} --hash=sha256:{digest}\n"
                for name, (version, digest) in sorted(items.items())
            ]
            paths[profile].write_text("".join(lines), encoding="utf-8")
            print(f"{paths[profile]}: {len(lines)} packages", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
