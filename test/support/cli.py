"""Runs the command line in its own process, as a user does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from deworldsg_ros.recordings.source import Source
from deworldsg_ros.recordings.writer import write_mcap

ROOT = Path(__file__).resolve().parents[2]
DEMO_ROOM = ROOT / "bags" / "demo_room"
COMMAND = [sys.executable, "-m", "deworldsg_ros.cli"]


def environment(folder: Path) -> dict[str, str]:
    """Environment variables of the command. ROS logs go to `folder`."""
    return {
        **os.environ,
        "PYTHONPATH": str(ROOT),
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
    """Start a command in `folder`."""
    return subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        cwd=folder,
        env=environment(folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def first_frames(source: Source, count: int, path: Path) -> Path:
    """Write the first frames of a recording to an MCAP file and return its path."""

    def messages():
        last_ns = None
        stamps = set()
        for message in source.raw_messages():
            stamps.add(message.stamp_ns)
            if len(stamps) > count:
                last_ns = message.stamp_ns
                break
            yield message
        assert last_ns is not None

    write_mcap(messages(), path)
    source.close()
    return path
