"""What can be said of the Dockerfiles without Docker: form, files, rights, shell."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

FILES = ("Dockerfile", "Dockerfile.wheels")
KNOWN = {"FROM", "RUN", "ENV", "USER", "WORKDIR", "COPY", "ENTRYPOINT", "CMD"}


def instructions(root: Path, name: str) -> list[tuple[str, str]]:
    """Keyword and arguments of each instruction."""
    text = (root / "docker" / name).read_text(encoding="utf-8")
    text = re.sub(r"^#.*\n", "", text, flags=re.M).replace("\\\n", " ")
    pairs = [line.split(maxsplit=1) for line in text.splitlines() if line.strip()]
    return [(keyword, arguments) for keyword, arguments in pairs]


def of_kind(root: Path, name: str, kind: str) -> list[str]:
    return [arguments for keyword, arguments in instructions(root, name) if keyword == kind]


@pytest.mark.parametrize("name", FILES)
def test_the_instructions_are_known_and_their_lines_are_shell(root_dir: Path, name: str) -> None:
    listed = instructions(root_dir, name)
    assert {keyword for keyword, _ in listed} <= KNOWN
    assert listed[0][0] == "FROM" and re.fullmatch(r"[\w/]+:[\w.-]+", listed[0][1])
    assert not listed[0][1].endswith(":latest")
    for line in of_kind(root_dir, name, "RUN"):
        subprocess.run(["sh", "-n", "-c", line], check=True, timeout=20)
        if "apt-get" in line:
            assert "apt-get update" in line and "--no-install-recommends" in line
            assert line.rstrip().endswith("rm -rf /var/lib/apt/lists/*")


@pytest.mark.parametrize("name", FILES)
def test_programs_run_without_rights_of_root(root_dir: Path, name: str) -> None:
    listed = instructions(root_dir, name)
    users = [index for index, (keyword, _) in enumerate(listed) if keyword == "USER"]
    assert [listed[index][1] for index in users] == ["robot"]
    assert all("--chown=robot" in line for line in of_kind(root_dir, name, "COPY"))
    installs = [index for index, pair in enumerate(listed) if "entrypoint.sh" in pair[1]]
    assert min(installs) > users[0]


@pytest.mark.parametrize("name", FILES)
def test_the_image_starts_the_entry_point(root_dir: Path, name: str) -> None:
    (folder,) = of_kind(root_dir, name, "WORKDIR")
    (entry,) = of_kind(root_dir, name, "ENTRYPOINT")
    assert entry == f'["bash", "{folder}/docker/entrypoint.sh"]'
    assert "bash docker/entrypoint.sh true" in of_kind(root_dir, name, "RUN")


def test_the_context_has_all_that_is_installed(root_dir: Path) -> None:
    lines = (root_dir / ".dockerignore").read_text(encoding="utf-8").splitlines()
    kept = {line[1:] for line in lines if line.startswith("!")}
    assert all((root_dir / name).exists() for name in kept)
    script = (root_dir / "scripts" / "bootstrap.sh").read_text(encoding="utf-8")
    match = re.search(r"for name in (package\.xml .*?); do", script, re.S)
    assert match
    installed = {name.split("/")[0] for name in match[1].replace("\\", " ").split()}
    assert installed | {"docker", "locks", "scripts"} == kept


def test_the_entry_point_runs_a_command_in_the_environment(root_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "docker").mkdir()
    (tmp_path / "scripts").mkdir()
    entry = shutil.copy(root_dir / "docker" / "entrypoint.sh", tmp_path / "docker")
    stub = 'bootstrap() { export PROFILE="$1"; }\n'
    (tmp_path / "scripts" / "bootstrap.sh").write_text(stub, encoding="utf-8")
    done = subprocess.run(
        ["bash", entry, "sh", "-c", 'echo "$PROFILE $1"; exit 7', "x", "a b"],
        capture_output=True,
        text=True,
        timeout=20,
    )
    assert (done.returncode, done.stdout) == (7, "run a b\n")
