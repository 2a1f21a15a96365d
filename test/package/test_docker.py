"""What can be said of the Dockerfiles without Docker: form, files, rights, shell."""

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


@pytest.mark.parametrize("name", FILES)
def test_a_file_has_known_instructions_no_rights_of_root_and_the_entry_point(root_dir, name):
    listed = instructions(root_dir, name)
    of_kind = {kind: [text for keyword, text in listed if keyword == kind] for kind in KNOWN}
    assert sum(map(len, of_kind.values())) == len(listed)
    assert listed[0][0] == "FROM" and re.fullmatch(r"[\w/]+:(?!latest)[\w.-]+", listed[0][1])
    for line in of_kind["RUN"]:
        subprocess.run(["sh", "-n", "-c", line], check=True, timeout=20)
        if "apt-get" in line:
            assert "apt-get update" in line and "--no-install-recommends" in line
            assert line.rstrip().endswith("rm -rf /var/lib/apt/lists/*")
    assert of_kind["USER"] == ["robot"]
    assert all("--chown=robot" in line for line in of_kind["COPY"])
    (folder,) = of_kind["WORKDIR"]
    assert of_kind["ENTRYPOINT"] == [f'["bash", "{folder}/docker/entrypoint.sh"]']
    assert "bash docker/entrypoint.sh true" in of_kind["RUN"]


def test_the_context_has_all_that_is_installed(root_dir):
    lines = (root_dir / ".dockerignore").read_text(encoding="utf-8").splitlines()
    kept = {line[1:] for line in lines if line.startswith("!")}
    assert all((root_dir / name).exists() for name in kept)
    script = (root_dir / "scripts" / "bootstrap.sh").read_text(encoding="utf-8")
    match = re.search(r"for name in (package\.xml .*?); do", script, re.S)
    assert match
    installed = {name.split("/")[0] for name in match[1].replace("\\", " ").split()}
    assert installed | {"docker", "locks", "scripts"} == kept


def test_the_entry_point_runs_a_command_in_the_environment(root_dir, tmp_path):
    for name in ("docker", "scripts"):
        (tmp_path / name).mkdir()
    entry = shutil.copy(root_dir / "docker" / "entrypoint.sh", tmp_path / "docker")
    (tmp_path / "scripts" / "bootstrap.sh").write_text('bootstrap() { export PROFILE="$1"; }\n')
    command = ["bash", entry, "sh", "-c", 'echo "$PROFILE $1"; exit 7', "x", "a b"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    assert (done.returncode, done.stdout) == (7, "run a b\n")
