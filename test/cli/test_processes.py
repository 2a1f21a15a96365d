"""Processes of the demo: logs, exit codes, shutdown."""

from __future__ import annotations

import os
import signal
import sys
import time

import pytest

from deworldsg_ros.cli import demo, terminal
from deworldsg_ros.cli.demo import LoggedProcess, end_all
from deworldsg_ros.cli.terminal import dds_environment, find_shared, node_command

GENTLE = """
import signal, sys, time
signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
print("ready", flush=True)
time.sleep(60)
"""
STUBBORN = """
import signal, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("ready", flush=True)
time.sleep(60)
"""


def start(tmp_path, name, code, **options):
    command = [sys.executable, "-c", code]
    return LoggedProcess(name, command, os.environ, tmp_path / f"{name}.log", **options)


def wait_for_log(process, text):
    end_s = time.monotonic() + 20
    while text not in process.log.read_text():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_ending_no_process():
    assert end_all([]) == {}


def test_sigint_ends_a_process_and_sigkill_one_that_ignores_it(tmp_path, monkeypatch):
    monkeypatch.setattr(
        demo,
        "GRACE_S",
        ((signal.SIGINT, 5.0), (signal.SIGTERM, 0.3), (signal.SIGKILL, 5.0)),
    )
    gentle = start(tmp_path, "gentle", GENTLE)
    wait_for_log(gentle, "ready")
    assert gentle.exit_code is None
    assert end_all([gentle]) == {"gentle": 0}
    monkeypatch.setattr(
        demo,
        "GRACE_S",
        ((signal.SIGINT, 0.3), (signal.SIGTERM, 0.3), (signal.SIGKILL, 5.0)),
    )
    stubborn = start(tmp_path, "stubborn", STUBBORN)
    wait_for_log(stubborn, "ready")
    ended = start(tmp_path, "ended", "import sys; sys.exit(3)")
    assert ended.wait(20) == 3
    assert end_all([stubborn, ended]) == {"stubborn": -signal.SIGKILL, "ended": 3}


def test_the_log_contains_both_outputs(tmp_path):
    code = "import sys; [print(i, file=sys.stderr) for i in range(100)]; print('out')"
    process = start(tmp_path, "talker", code)
    assert process.wait(20) == 0
    assert process.last_lines(3).splitlines()[-1] in ("out", "99")
    assert len(process.last_lines(3).splitlines()) == 3


def test_output_for_the_parent_is_not_in_the_log(tmp_path):
    process = start(tmp_path, "teller", "print('hello')", read_output=True)
    assert process.output.read() == b"hello\n"
    assert process.wait(20) == 0
    assert process.log.read_text() == ""


def test_ctrl_c_in_the_terminal_does_not_reach_a_process(tmp_path):
    process = start(tmp_path, "apart", GENTLE)
    wait_for_log(process, "ready")
    assert os.getpgid(process.pid) != os.getpgid(0)
    end_all([process])


def test_files_of_the_package_are_found():
    assert find_shared("config/default.yaml").is_file()
    assert find_shared("config/fastdds.xml").is_file()
    assert find_shared("config/no_such_file.yaml") is None
    assert node_command("graph_node")[-1].endswith("graph_node")


@pytest.mark.parametrize("given", [{}, {"ROS_DOMAIN_ID": "77"}])
def test_the_demo_has_its_own_domain_unless_one_is_set(monkeypatch, given):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE", raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    environment = dds_environment()
    domain = int(environment["ROS_DOMAIN_ID"])
    assert domain == int(given.get("ROS_DOMAIN_ID", domain))
    assert 1 <= domain <= 101
    assert environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert environment["FASTRTPS_DEFAULT_PROFILES_FILE"].endswith("fastdds.xml")


def test_an_installation_runs_the_installed_executables(tmp_path, monkeypatch):
    executable = tmp_path / "lib" / "deworldsg_ros" / "graph_node"
    executable.parent.mkdir(parents=True)
    executable.write_text("#!/bin/sh\n")
    monkeypatch.setattr(terminal, "checkout", lambda: None)
    monkeypatch.setattr(terminal, "prefixes", lambda: [tmp_path])
    module = [sys.executable, "-m", "deworldsg_ros.nodes.graph_node"]
    assert node_command("graph_node") == module  # it cannot be executed
    executable.chmod(0o755)
    assert node_command("graph_node") == [str(executable)]
    assert node_command("lifting_node")[:2] == module[:2]


@pytest.mark.parametrize(
    ("program", "while_importing", "exit_code"),
    [
        ("from deworldsg_ros.cli import main; main()", "typer", 130),
        ("from deworldsg_ros.nodes.start import start; start('graph_node')", "rclpy", 0),
    ],
)
def test_ctrl_c_while_python_imports_is_quiet(tmp_path, program, while_importing, exit_code):
    """A placeholder module that is slow to import replaces the first import of each program."""
    (tmp_path / f"{while_importing}.py").write_text(
        "import time; print('ready', flush=True); time.sleep(60)"
    )
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {program}"
    process = start(tmp_path, "slow", code)
    wait_for_log(process, "ready")
    process.signal(signal.SIGINT)
    assert process.wait(20) == exit_code
    assert process.log.read_text() == "ready\n"
