"""The lock files: complete, equal to what pyproject.toml asks for, and free of known advisories."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version
from support.requirements import required

PYTHONS = ("3.10", "3.11", "3.12", "3.13")
PROFILES = {"run": ("build", "run", "ros"), "test": ("build", "run", "ros", "test")}
PINNED = re.compile(r"([a-z0-9-]+)(?:\[[a-z,]+\])?==(\S+) --hash=sha256:([0-9a-f]{64})")
PRESENT = f"{sys.version_info[0]}.{sys.version_info[1]}"


def locked(root: Path, profile: str, python: str) -> dict[str, Version]:
    """Versions by name; every line is one package with the hash of one file."""
    lines = (root / "locks" / f"{profile}-{python}.txt").read_text(encoding="utf-8").splitlines()
    matches = [PINNED.fullmatch(line) for line in lines]
    assert all(matches), [line for line, match in zip(lines, matches) if not match]
    versions = {match[1]: Version(match[2]) for match in matches if match}
    assert len(versions) == len(lines)
    return versions


def known_problems(root: Path, versions: dict[str, Version]) -> list[str]:
    """Advisories that some versions are affected by, without those that are accepted."""
    content = json.loads((root / "locks" / "advisories.json").read_text(encoding="utf-8"))
    assert content["source"] and re.fullmatch(r"\d{4}-\d\d-\d\d", content["date"])
    return [
        f"{advisory['package']} {versions[advisory['package']]}: {advisory['id']}"
        for advisory in content["advisories"]
        if advisory["package"] in versions
        and versions[advisory["package"]] in SpecifierSet(advisory["affected"])
        and not advisory.get("accepted")
    ]


def name_of(requirement: Requirement) -> str:
    return re.sub(r"[-_.]+", "-", requirement.name).lower()


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("profile", PROFILES)
def test_a_lock_satisfies_pyproject_and_has_no_known_advisory(root_dir, profile, python):
    versions = locked(root_dir, profile, python)
    for requirement in required(root_dir, *PROFILES[profile]):
        assert requirement.specifier.contains(versions[name_of(requirement)]), requirement
    assert "torch" not in versions
    assert versions.items() <= locked(root_dir, "test", python).items()
    assert known_problems(root_dir, versions) == []


def test_no_lowest_version_of_pyproject_has_a_known_advisory(root_dir):
    extras = ("build", "run", "ros", "models", "cluster", "mcp", "networkx")
    lowest = {
        name_of(requirement): Version(spec.version)
        for requirement in required(root_dir, *extras)
        for spec in requirement.specifier
        if spec.operator == ">="
    }
    assert lowest["torch"] and lowest["numpy"]
    assert known_problems(root_dir, lowest) == []


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_pip_accepts_the_lock_of_this_python(root_dir):
    """It asks the package index, and installs nothing."""
    lock = root_dir / "locks" / f"test-{PRESENT}.txt"
    pip = (sys.executable, "-m", "pip", "install", "--no-input", "--disable-pip-version-check")
    dry = ("--dry-run", "--ignore-installed", "--no-build-isolation", "--require-hashes", "-r")
    done = subprocess.run([*pip, *dry, str(lock)], capture_output=True, text=True, timeout=880)
    assert done.returncode == 0, done.stderr[-3000:]
    planned = done.stdout.rpartition("Would install")[2].split()
    assert len(planned) == len(lock.read_text(encoding="utf-8").splitlines())
