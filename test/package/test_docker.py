"""What can be said of the Dockerfiles without Docker: form, files, rights, shell."""

import os
import re
import shutil
import subprocess

import pytest


@pytest.mark.parametrize("name", ["Dockerfile", "Dockerfile.wheels"])
def test_a_file_ends_without_rights_of_root_and_its_commands_are_shell(root_dir, name):
    text = (root_dir / "docker" / name).read_text(encoding="utf-8")
    text = re.sub(r"^#.*\n", "", text, flags=re.M).replace("\\\n", " ")
    listed = [line.split(maxsplit=1) for line in text.splitlines() if line.strip()]
    for keyword, arguments in listed:
        if keyword == "RUN":
            subprocess.run(["sh", "-n", "-c", arguments], check=True, timeout=20)
        assert keyword != "COPY" or "--chown=robot" in arguments
    assert [arguments for keyword, arguments in listed if keyword == "USER"] == ["robot"]
    assert ["RUN", "bash docker/entrypoint.sh true"] in listed


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


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(
    "DEWORLDSG_TEST_DOCKER" not in os.environ, reason="DEWORLDSG_TEST_DOCKER=1 builds"
)
@pytest.mark.parametrize("name", ["Dockerfile", "Dockerfile.wheels"])
def test_an_image_is_built_and_runs_the_command(root_dir, name):
    tag = f"deworldsg_ros_test:{name.lower()}"
    build = ["docker", "build", "-q", "-f", f"docker/{name}", "-t", tag, "."]
    subprocess.run(build, cwd=root_dir, check=True, timeout=3000)
    command = ["docker", "run", "--rm", tag, "deworldsg", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and done.stdout.strip(), done.stderr
    subprocess.run(["docker", "rmi", tag], timeout=300)
