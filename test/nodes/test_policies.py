"""SROS2: the policies are what the nodes use; without security, a secured node does not start."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import distributions
from xml.etree import ElementTree

import pytest
from support.nodes import run_to_end

WHEELS = any(item.metadata["Name"] == "ros-jazzy-rclpy" for item in distributions())
KEY_FILES = (
    *("identity_ca.cert.pem", "cert.pem", "key.pem"),
    *("permissions_ca.cert.pem", "governance.p7s", "permissions.p7s"),
)


@pytest.mark.timeout(600)  # kernels may have to be compiled
def test_policies_are_what_the_nodes_use(root_dir, tmp_path):
    made = tmp_path / "policies.xml"
    # Nodes of the tests before are remembered for a while where they were.
    domain = str((int(os.environ["ROS_DOMAIN_ID"]) + 50) % 101 + 1)
    done = subprocess.run(
        [sys.executable, root_dir / "tools" / "make_policies.py", made],
        env={**os.environ, "ROS_DOMAIN_ID": domain},
        capture_output=True,
        text=True,
        timeout=590,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    committed = root_dir / "config" / "sros2" / "policies.xml"
    assert committed.read_text() == made.read_text(), "run python tools/make_policies.py"


def test_there_is_one_enclave_for_each_node_and_no_wildcard(root_dir):
    policies = ElementTree.parse(root_dir / "config" / "sros2" / "policies.xml").getroot()
    enclaves = [enclave.get("path") for enclave in policies.iter("enclave")]
    nodes = {path.name for path in (root_dir / "scripts" / "ros").iterdir()}
    assert sorted(enclaves) == sorted(f"/{name}" for name in nodes)
    names = [element.text or "" for kind in ("topic", "service") for element in policies.iter(kind)]
    assert names and all(names)
    assert {name.partition("*")[0] for name in names if "*" in name} <= {"scene_graph_client_"}


@pytest.mark.skipif(not WHEELS, reason="a full ROS 2 has a Fast DDS with security")
@pytest.mark.parametrize("strategy", ["Enforce", "Permissive"])
def test_a_middleware_without_security_ends_the_node(tmp_path, monkeypatch, strategy):
    enclave = tmp_path / "enclaves" / "graph_node"
    enclave.mkdir(parents=True)
    for name in KEY_FILES:
        (enclave / name).write_text("no key")
    monkeypatch.setenv("ROS_SECURITY_ENABLE", "true")
    monkeypatch.setenv("ROS_SECURITY_STRATEGY", strategy)
    monkeypatch.setenv("ROS_SECURITY_KEYSTORE", str(tmp_path))
    words = ("--ros-args", "--enclave", "/graph_node")
    code, output = run_to_end("graph_node", tmp_path, *words)
    assert code == 2, output
    assert "error: ROS_SECURITY_ENABLE is true, but" in output
    assert "Traceback" not in output
