"""Processes of the demo and of the compiler: logs, exit codes, shutdown."""

import os
import signal
import sys
import time

import pytest
from rich.console import Console

from deworldsg_ros.cli import demo, run, terminal
from deworldsg_ros.cli.demo import LoggedProcess, end_all
from deworldsg_ros.cli.terminal import dds_environment, find_shared, node_command
from deworldsg_ros.graph_builder import KERNEL_PARTS

WAITING = 'print("ready", flush=True); time.sleep(60)'
GENTLE = f"import signal, sys, time; signal.signal(2, lambda *_: sys.exit(0)); {WAITING}"
STUBBORN = f"import signal, time; [signal.signal(n, signal.SIG_IGN) for n in (2, 15)]; {WAITING}"


def start(tmp_path, code, name="x", **options):
    command = [sys.executable, "-c", code]
    return LoggedProcess(name, command, os.environ, tmp_path / f"{name}.log", **options)


def ready(process):
    """The process, after it has printed that it is ready."""
    end_s = time.monotonic() + 20
    while "ready" not in process.log.read_text():
        assert time.monotonic() < end_s
        time.sleep(0.02)
    time.sleep(0.2)  # now it sleeps: Python may drop an interrupt while it ends an import
    return process


def test_sigint_ends_a_process_and_sigkill_one_that_ignores_it(tmp_path, monkeypatch):
    gentle = ready(start(tmp_path, GENTLE, "gentle"))
    assert gentle.exit_code is None
    assert os.getpgid(gentle.pid) != os.getpgid(0), "Ctrl-C in the terminal does not reach it"
    assert end_all([gentle]) == {"gentle": 0}
    graces = ((signal.SIGINT, 0.3), (signal.SIGTERM, 0.3), (signal.SIGKILL, 5.0))
    monkeypatch.setattr(demo, "GRACE_S", graces)
    stubborn = ready(start(tmp_path, STUBBORN, "stubborn"))
    ended = start(tmp_path, "import sys; sys.exit(3)", "ended")
    assert ended.wait(20) == 3
    assert end_all([stubborn, ended]) == {"stubborn": -signal.SIGKILL, "ended": 3}
    assert end_all([]) == {}


@pytest.mark.parametrize("given", [{}, {"ROS_DOMAIN_ID": "77"}])
def test_the_demo_has_its_own_domain_unless_one_is_set(monkeypatch, given):
    for name in (
        "ROS_DOMAIN_ID",
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
    ):
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    environment = dds_environment()
    domain = int(environment["ROS_DOMAIN_ID"])
    assert domain == int(given.get("ROS_DOMAIN_ID", domain))
    assert 1 <= domain <= 101
    assert environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert environment["FASTRTPS_DEFAULT_PROFILES_FILE"].endswith("fastdds.xml")


def test_an_installation_runs_the_installed_executables(tmp_path, monkeypatch):
    assert find_shared("config/default.yaml").is_file()
    assert find_shared("config/no_such_file.yaml") is None
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
        ("from deworldsg_ros.nodes import start; start('graph_node')", "rclpy", 0),
    ],
)
def test_ctrl_c_while_python_imports_is_quiet(tmp_path, program, while_importing, exit_code):
    """A placeholder module that is slow to import replaces the first import of each program."""
    (tmp_path / f"{while_importing}.py").write_text(f"import time; {WAITING}")
    process = ready(
        start(tmp_path, f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {program}")
    )
    process.signal(signal.SIGINT)
    assert process.wait(20) == exit_code
    assert process.log.read_text() == "ready\n"


def test_kernels_are_compiled_in_other_processes_and_a_failure_is_told(monkeypatch):
    assert set(run.PARTS) == {"perception", "lifting", *KERNEL_PARTS}
    # Only here, not in the other process.
    monkeypatch.setattr(run, "PARTS", {"pairs": None})
    run.compile_kernels(Console(quiet=True))
    monkeypatch.setattr(run, "PARTS", {"nothing": None})
    with pytest.raises(run.CompilationFailed, match="KeyError: 'nothing'"):
        run.compile_kernels(Console(quiet=True))
