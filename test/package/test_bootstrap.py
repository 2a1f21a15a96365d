"""The choices that scripts/bootstrap.sh makes before it installs anything."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest


@pytest.fixture()
def checkout(tmp_path: Path, root_dir: Path) -> Path:
    """A folder with nothing but the script."""
    (tmp_path / "checkout" / "scripts").mkdir(parents=True)
    shutil.copy(root_dir / "scripts" / "bootstrap.sh", tmp_path / "checkout" / "scripts")
    return tmp_path / "checkout"


def bash(checkout: Path, code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code after sourcing the script, in an environment of its own."""
    return subprocess.run(
        ["bash", "-euo", "pipefail", "-c", f". scripts/bootstrap.sh; {code}"],
        cwd=checkout,
        env={"PATH": os.defpath, "HOME": str(checkout), **environment},
        capture_output=True,
        text=True,
        timeout=60,
    )


def fake_python(path: Path, version: str, *, has_venv: bool = True) -> None:
    """A Python that knows its version and, perhaps, venv."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f"""#!/bin/sh
case "$*" in
  *version_info*) echo {version} ;;
  *ensurepip*) exit {0 if has_venv else 1} ;;
  *sys.executable*) echo {path} ;;
esac
"""
    )
    path.chmod(0o755)


@pytest.mark.parametrize(
    ("versions", "taken", "refused"),
    [
        # python3 is preferred, then the newest that is suitable.
        ({"python3": "3.12", "python3.13": "3.13"}, "python3", ()),
        ({"python3": "3.14", "python3.10": "3.10", "python3.11": "3.11"}, "python3.11", ()),
        (
            {"python3": "3.8", "python3.12": "3.12"},
            None,
            (
                *("expected Python 3.10, 3.11, 3.12 or 3.13", "python3 is 3.8"),
                "apt install python3.12-venv",
            ),
        ),
    ],
)
def test_a_suitable_python_is_found(checkout, tmp_path, versions, taken, refused):
    """The PATH has nothing else but tools."""
    folder = tmp_path / "pythons"
    folder.mkdir()
    for tool in ("sed", "bash", "dirname"):
        (folder / tool).symlink_to(f"/usr/bin/{tool}")
    for name, version in versions.items():
        fake_python(folder / name, version, has_venv=taken is not None)
    done = bash(checkout, "find_python", PATH=str(folder))
    assert done.stdout == (f"{folder}/{taken}\n" if taken else "")
    assert all(words in done.stderr for words in refused)
    assert (done.returncode == 0) is (taken is not None)


def test_a_virtual_environment_of_the_user_is_left_alone(checkout):
    (checkout / ".venv" / "bin").mkdir(parents=True)
    done = bash(checkout, "bootstrap run")
    assert done.returncode != 0
    assert "another program made .venv" in done.stderr
    assert [path.name for path in (checkout / ".venv").iterdir()] == ["bin"]


def test_hash_follows_content_and_names_and_not_compiled_files(checkout):
    def hash_of_package() -> str:
        return bash(checkout, "hash_of package").stdout

    (checkout / "package").mkdir()
    (checkout / "package" / "a b.py").write_text("1")
    first = hash_of_package()
    assert len(first.strip()) == 64
    (checkout / "package" / "a b.pyc").write_text("compiled")
    assert hash_of_package() == first
    (checkout / "package" / "a b.py").write_text("2")
    second = hash_of_package()
    (checkout / "package" / "a b.py").rename(checkout / "package" / "c.py")
    assert len({first, second, hash_of_package()}) == 3


def test_failing_step_shows_its_output_and_ends_the_start(checkout):
    code = 'mkdir -p "$stamps"; quietly "a step" sh -c "echo the reason; exit 3"; echo not reached'
    done = bash(checkout, code)
    assert done.returncode != 0
    assert "the reason" in done.stderr
    assert "a step failed with status 3" in done.stderr
    assert done.stdout == ""


def test_another_ros_is_put_aside(checkout):
    code = 'forget_other_ros; echo "${ROS_DISTRO-}${PYTHONPATH-}${LD_LIBRARY_PATH-}"'
    done = bash(checkout, code, ROS_DISTRO="humble", PYTHONPATH="/old", LD_LIBRARY_PATH="/old")
    assert done.stdout == "\n"
    assert "ROS 2 humble is sourced" in done.stderr


@pytest.mark.parametrize("profile", ["run", "test"])
def test_a_locked_install_takes_the_lock_of_the_python_once(checkout, profile):
    (checkout / "locks").mkdir()
    for name in ("run-3.12.txt", "test-3.12.txt", "run-3.11.txt"):
        (checkout / "locks" / name).write_text("numpy==1\nsetuptools==79\n")
    fake_python(checkout / ".venv" / "bin" / "python", "3.12")
    code = (
        'mkdir -p "$stamps"; quietly() { shift; "$@"; }; pip_install() { echo "$@"; }; '
        f"install_requirements wheels {profile}; install_requirements wheels {profile}"
    )
    lines = bash(checkout, code, DEWORLDSG_LOCKED="1").stdout.splitlines()
    # What builds a package without a wheel comes first.
    assert [Path(line.split()[-1]).stem for line in lines] == ["build", f"{profile}-3.12"]
    assert (checkout / ".venv/.bootstrap/build.txt").read_text() == "setuptools==79\n"
    assert all(line.startswith("--require-hashes ") for line in lines)


@pytest.mark.parametrize(
    ("ros", "profile", "reason"),
    [("sourced", "run", "ROS 2 is sourced"), ("wheels", "test", "no torch")],
)
def test_locks_are_refused_where_they_do_not_fit(checkout, ros, profile, reason):
    code = f"install_requirements {ros} {profile}"
    done = bash(checkout, code, DEWORLDSG_LOCKED="1", DEWORLDSG_TEST_MODELS="1")
    assert done.returncode != 0 and reason in done.stderr
