"""Runs commands: in a process of their own, as a user does, or in this one."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from typer.testing import CliRunner, Result

from deworldsg_ros.cli.app import app

ROOT = Path(__file__).resolve().parents[2]
DEMO_ROOM = ROOT / "bags" / "demo_room"
COMMAND = [sys.executable, "-m", "deworldsg_ros.cli"]


def environment(folder: Path) -> dict[str, str]:
    """Environment variables of the command. ROS logs go to `folder`."""
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        "COLUMNS": "120",
        "ROS_LOG_DIR": str(folder / "ros"),
    }


def deworldsg(
    folder: Path, *arguments: object, limit_s: float = 60.0
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end. At the time limit, SIGINT lets the demo end its nodes."""
    process = start(folder, *arguments)
    try:
        out, err = process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
        raise AssertionError(f"took more than {limit_s:g} s:\n{out}\n{err}") from None
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def start(folder: Path, *arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        cwd=folder,
        env=environment(folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def invoke(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def printed(*words: object) -> str:
    """What a command prints that ends well."""
    result = invoke(*words)
    assert result.exit_code == 0, result.output
    return result.stdout


def refusal(*words: object) -> str:
    """The error of a command that ends with code 2, without a traceback."""
    result = invoke(*words)
    assert result.exit_code == 2, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.stderr
