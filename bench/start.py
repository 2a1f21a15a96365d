"""Start times: compiling the kernels on a new machine, a node until it is ready, and scripts/demo.

python bench/start.py
"""

from __future__ import annotations

import os
import resource
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from bench.figures import Figure, Setup  # noqa: E402
from deworldsg_ros.cli.terminal import dds_environment  # noqa: E402
from deworldsg_ros.wire import messages as wire  # noqa: E402

NODES = ("graph_node", "lifting_node", "segmentation_node")
# The networks of the segmentation load before it is ready: it has no target.
WITHOUT_NETWORKS = ("graph_node", "lifting_node")


def compile_figures(setup: Setup) -> list[Figure]:
    """`deworldsg compile` with an empty cache, and with a full one."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        times = []
        for _ in range(2):
            before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            subprocess.run(
                [sys.executable, "-m", "deworldsg_ros.cli", "compile"],
                env=environment,
                check=True,
                stdout=subprocess.DEVNULL,
            )
            wall_s = time.perf_counter() - start
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            times.append(
                (wall_s, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
            )
    (cold_s, cold_cpu_s), (warm_s, _) = times
    note = "`deworldsg compile`; scripts/bootstrap.sh runs it when it installs the package"
    return [
        Figure("compile_cold", cold_s, "s", target=20, note=note + ", empty cache, by the clock"),
        Figure("compile_cold_processor", cold_cpu_s, "s", note=note + ", processor time"),
        Figure("compile_warm", warm_s, "s", note=note + ", everything is compiled"),
    ]


def ready_s(node: str) -> float:
    """Seconds from the start of a node's process until it reports that it is ready."""
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", "RCUTILS_LOGGING_BUFFERED_STREAM": "0"}
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", f"deworldsg_ros.nodes.{node}"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if "ready" in line:
                return time.perf_counter() - start
    finally:
        process.kill()
        process.wait()
    raise RuntimeError(f"{node} ended before it was ready")


def node_figures(setup: Setup) -> list[Figure]:
    """Each node until it is ready, with compiled kernels."""
    found = []
    for node in NODES:
        ready_s(node)  # compiles what is missing
        times = [ready_s(node) for _ in range(1 if setup.quick else 3)]
        target = 2.0 if node in WITHOUT_NETWORKS else None
        note = f"from the start of its process, median of {len(times)}"
        found.append(Figure(f"start_{node}", statistics.median(times), "s", target, note=note))
    return found


def first_frame_s(command: list[str], node: Any) -> float:
    """Seconds from the start of the demo until its first frame is in the graph.

    Args:
        command: the demo, without its options.
        node: ROS node of this process, in the same domain.
    """
    import rclpy
    from std_msgs.msg import String

    from deworldsg_ros.ros.qos import reliable

    arrived: list[float] = []

    def note(message: Any) -> None:
        if wire.decode(message.data, wire.SceneGraphUpdateMessage).associations:
            arrived.append(time.perf_counter())

    subscription = node.create_subscription(String, "/scene_graph/updates", note, reliable(10))
    with tempfile.TemporaryDirectory() as folder, Path(folder, "log").open("w+") as log:
        start = time.perf_counter()
        process = subprocess.Popen(
            [*command, "--out", f"{folder}/out"],
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            while not arrived and process.poll() is None:
                rclpy.spin_once(node, timeout_sec=0.5)
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            process.wait(timeout=30)
            node.destroy_subscription(subscription)
        if not arrived:
            raise RuntimeError(f"the demo ended early:\n{Path(log.name).read_text()[-2000:]}")
    return arrived[0] - start


def demo_figures(setup: Setup) -> list[Figure]:
    """Starts of `scripts/demo` after the first one; of `deworldsg demo` without its .venv."""
    os.environ.update(dds_environment())
    import rclpy

    installed = (ROOT / ".venv" / ".bootstrap" / "project").exists()
    script = [str(ROOT / "scripts" / "demo")]
    command = script if installed else [sys.executable, "-m", "deworldsg_ros.cli", "demo"]
    rclpy.init()
    node = rclpy.create_node("start_bench")
    try:
        first_frame_s(command, node)  # compiles what is missing
        times = [first_frame_s(command, node) for _ in range(1 if setup.quick else 3)]
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    name = "scripts/demo" if installed else "deworldsg demo (without scripts/bootstrap.sh)"
    note = f"{name}, from its start until its first frame is in the graph, median of {len(times)}"
    return [Figure("start_demo", statistics.median(times), "s", target=4, note=note)]


if __name__ == "__main__":
    for figure in [*node_figures(Setup()), *demo_figures(Setup())]:
        print(f"{figure.name}: {figure.value:.2f} {figure.unit} ({figure.note})")
