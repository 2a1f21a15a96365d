"""Does the steps of newcomer.md, and checks what each one prints: newcomer.py [PART ...].

scripts/newcomer starts it in a new clone, the tests in parts. Commands run in the present folder.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

STEPS = Path(__file__).with_name("newcomer.md")
# Parts that install everything, in a new clone. The others need its environment.
INSTALLING = ("The clone", "An image, without Docker")
# A step is given this time.
LIMIT_S, INSTALLING_LIMIT_S = 180.0, 1800.0
CODE = re.compile(r"\[exit (\d+)\]")


class StepError(Exception):
    """A step that did not print what it must."""


@dataclass
class Step:
    """A command, and regular expressions of its output.

    A command that ends with ``&`` goes on to the end of its part.
    """

    command: str
    expected: list[str] = field(default_factory=list)
    code: int = 0


def read_parts(path: Path = STEPS) -> dict[str, list[Step]]:
    """The steps of each part, by its title."""
    parts: dict[str, list[Step]] = {}
    inside = False
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            steps = parts.setdefault(line[3:], [])
        elif line.startswith("```"):
            inside = not inside
        elif inside and line.startswith("$ "):
            steps.append(Step(line[2:]))
        elif inside and line.startswith("> "):
            steps[-1].command += "\n" + line[2:]
        elif inside and (code := CODE.fullmatch(line)):
            steps[-1].code = int(code[1])
        elif inside:
            steps[-1].expected.append(line)
    return parts


def run_part(steps: list[Step], environment: dict[str, str], limit_s: float = LIMIT_S) -> None:
    """Do the steps of a part in the present folder.

    Raises:
        StepError: with the command and its output, for the first step that prints something else,
            or needs longer.
    """
    running: list[subprocess.Popen[bytes]] = []
    try:
        for step in steps:
            print(f"\n$ {step.command}", flush=True)
            if step.command.startswith("cd "):
                os.chdir(step.command[3:])
            elif step.command.endswith("&"):
                running.append(_started(step, environment, limit_s))
            else:
                _run(step, environment, limit_s)
    finally:
        for process in reversed(running):
            os.killpg(process.pid, signal.SIGINT)
        for process in running:
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def _shell(command: str) -> list[str]:
    if shutil.which("ros2") is None:  # with ROS 2 from wheels
        command = re.sub(
            r"ros2 run deworldsg_ros (\w+)", r"python -m deworldsg_ros.nodes.\1", command
        )
    return ["bash", "-c", command]


def _run(step: Step, environment: dict[str, str], limit_s: float) -> None:
    try:
        done = subprocess.run(
            _shell(step.command),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=limit_s,
        )
    except subprocess.TimeoutExpired as error:
        raise StepError(f"{step.command}: no end within {limit_s:g} s") from error
    output = done.stdout.decode(errors="replace")
    print(output, end="", flush=True)
    if done.returncode != step.code:
        raise StepError(
            f"{step.command}: exit code {done.returncode}, expected {step.code}\n{output}"
        )
    _check(step, output)


def _started(step: Step, environment: dict[str, str], limit_s: float) -> subprocess.Popen[bytes]:
    """Start a command in the background, and wait until it has printed what it must."""
    with tempfile.TemporaryFile() as printed:
        process = subprocess.Popen(
            _shell(f"exec {step.command[:-1]}"),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=printed,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        end_s = time.monotonic() + limit_s
        while True:
            output = os.pread(printed.fileno(), 1 << 20, 0).decode(errors="replace")
            try:
                _check(step, output)
                return process
            except StepError:
                if process.poll() is not None or time.monotonic() > end_s:
                    process.kill()
                    process.wait()
                    raise
            time.sleep(0.1)


def _check(step: Step, output: str) -> None:
    for pattern in step.expected:
        if not re.search(pattern, output):
            raise StepError(f"{step.command}: {pattern!r} is not in its output:\n{output}")


def main() -> None:
    """Do the named parts, or all but those that install, one after the other."""
    parts = read_parts()
    titles = sys.argv[1:] or [title for title in parts if title not in INSTALLING]
    environment = {**os.environ, "COLUMNS": "140"}
    number = 0
    for title in titles:
        print(f"\n## {title}")
        limit_s = INSTALLING_LIMIT_S if title in INSTALLING else LIMIT_S
        run_part(parts[title], environment, limit_s)
        number += len(parts[title])
    print(f"\n{number} steps printed what they must")


if __name__ == "__main__":
    try:
        main()
    except StepError as error:
        sys.exit(f"error: {error}")
