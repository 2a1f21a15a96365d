"""A node process: its parameters at the start, SROS2, and its heap."""

import os
import platform
import re
import shutil
import subprocess
import sys
from importlib.metadata import distributions
from xml.etree import ElementTree

import pytest
from support.nodes import NodeProcess, peer, run_to_end

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
    command = [sys.executable, root_dir / "tools" / "make_policies.py", made]
    subprocess.run(command, env={**os.environ, "ROS_DOMAIN_ID": domain}, check=True, timeout=590)
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


def can_make_keys() -> bool:
    ros2 = shutil.which("ros2")
    if WHEELS or ros2 is None:
        return False
    call = [ros2, "security", "create_keystore", "--help"]
    return subprocess.run(call, capture_output=True, timeout=60).returncode == 0


@pytest.mark.skipif(not can_make_keys(), reason="needs a ROS 2 of the system, with sros2")
def test_with_keys_only_nodes_with_keys_see_the_graph(root_dir, tmp_path, monkeypatch):
    keys, policies = tmp_path / "keys", root_dir / "config" / "sros2" / "policies.xml"
    for words in (
        ("create_keystore", keys),
        ("generate_artifacts", "-k", keys, "-p", policies),
        ("create_enclave", keys, "/stranger"),  # has a key, and no right to any topic
    ):
        subprocess.run(["ros2", "security", *words], check=True, timeout=120)

    def secure(patch: pytest.MonkeyPatch) -> None:
        patch.setenv("ROS_SECURITY_ENABLE", "true")
        patch.setenv("ROS_SECURITY_STRATEGY", "Enforce")
        patch.setenv("ROS_SECURITY_KEYSTORE", str(keys))

    def enclave(name: str) -> tuple[str, ...]:
        return ("--ros-args", "--enclave", f"/{name}")

    with monkeypatch.context() as patch:
        secure(patch)
        graph = NodeProcess("graph_node", tmp_path, *enclave("graph_node"))
        viewer = NodeProcess("viewer_node", tmp_path, *enclave("viewer_node"))
        code, output = run_to_end("lifting_node", tmp_path, *enclave("stranger"))
        assert code != 0, output
    with graph, viewer:
        graph.wait_ready()
        viewer.wait_ready()
        with peer() as me:  # without keys
            me.spin_for(5.0)
            assert not me.node.count_publishers("/scene_graph")
        for process in (graph, viewer):
            assert process.interrupt() == 0, process.log


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("-p", "lifting.tua:=0.1"), "error: .*lifting.tua .did you mean lifting.tau"),
        (("-p", "inputs.world_up:=y"), "error: .*put it in quotes"),
        (("--params-file", "missing.yaml"), "missing.yaml"),
    ],
)
def test_a_bad_parameter_ends_the_start_with_2(tmp_path, words, says):
    code, log = run_to_end("graph_node", tmp_path, "--ros-args", *words)
    assert code == 2
    assert len(re.findall(f"(?m)^.*{says}.*$", log)) == 1
    assert "Traceback" not in log


def test_parameters_come_from_a_file(tmp_path, root_dir):
    file = str(root_dir / "config" / "paper_rules.yaml")
    clock = {"use_sim_time": "true"}
    with NodeProcess("graph_node", tmp_path, "--params-file", file, parameters=clock) as process:
        process.wait_ready()
        with peer() as me:
            statuses = me.statuses()
            # Diagnostics do not wait for a /clock that never comes.
            me.spin_until(lambda: len(statuses) >= 2, 60.0, "diagnostics")
        assert process.interrupt() == 0, process.log


# A heap of a thread has 64 MB of addresses; most of them are not in use, up to a multiple of 64 MB.
PROGRAM = """
import threading
{first}
import numpy
def fill():
    kept = [bytearray(5000) for _ in range(200)]
    both.wait()
both = threading.Barrier(5)
for _ in range(4):
    threading.Thread(target=fill).start()
both.wait()
unused = [line.split()[0] for line in open("/proc/self/maps") if line.split()[1] == "---p"]
bounds = [[int(end, 16) for end in addresses.split("-")] for addresses in unused]
print(sum(end % (64 << 20) == 0 and end - start > 32 << 20 for start, end in bounds))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other heaps")
def test_all_threads_of_a_node_use_one_heap():
    def heaps(first: str) -> int:
        command = [sys.executable, "-c", PROGRAM.format(first=first)]
        return int(subprocess.run(command, capture_output=True, check=True, timeout=60).stdout)

    assert heaps("") >= 4
    assert heaps("import deworldsg_ros.nodes") == 0


PRODUCT = """
import os
import deworldsg_ros.nodes
import numpy
numbers = numpy.ones((300, 300))
numbers @ numbers
print(len(os.listdir("/proc/self/task")))
"""


@pytest.mark.skipif(platform.system() != "Linux", reason="threads are counted in /proc")
def test_products_of_matrices_start_no_thread():
    environment = {name: value for name, value in os.environ.items() if "_NUM_THREADS" not in name}
    command = [sys.executable, "-c", PRODUCT]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.split() == ["1"]
