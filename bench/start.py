"""Start times: compiling the kernels on a new machine, and a node until it is ready."""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time

from bench.figures import Figure, Setup

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
        Figure("compile_cold", cold_s, "s", target=8, note=note + ", empty cache, by the clock"),
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
        note = "from the start of its process, median of 3"
        found.append(Figure(f"start_{node}", statistics.median(times), "s", target, note=note))
    return found
