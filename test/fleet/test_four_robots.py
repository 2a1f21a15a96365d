"""Four robots in four processes, each in a world of its own; the network fails in between."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from support.cut_link import CutLink
from support.fleet_robot import Plan, Result
from support.nodes import ROOT, NodeProcess, peer

from deworldsg_ros.client import SceneGraph, SceneGraphClient
from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.front_ends import FrontEndChoice, build_front_end
from deworldsg_ros.evaluation.recorded_room import SPELLINGS, open_annotations
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.scene.camera import invert_pose, rigid_motion
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.codec import local_graph_to_message

RECORDING = ROOT / "bags" / "demo_room"
EVERY = 2  # frames of the recording
PERIOD_S = 1.0  # between two frames of a robot
CUT_S = 20.0
MOST_NODES_PER_OBJECT = 1.05
NO_OBJECT = 1e6  # cost of a node that lies in no object of its class
ROUTER = (
    "import sys, time; from deworldsg_ros.fleet.zenoh_link import open_session; "
    "session = open_session(listen=sys.argv[1]); print('ready', flush=True); time.sleep(600)"
)


@pytest.fixture(scope="module")
def local_graphs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Local graphs of the shipped recording, a line each: true masks, a tenth of wrong labels."""
    source = open_source(RECORDING)
    annotations = open_annotations(RECORDING, "recording")
    choice = FrontEndChoice("ground-truth", flip=0.1)
    front_end = build_front_end(choice, annotations, "demo_room", source, Config())
    pipeline = Pipeline(Config(), front_end)
    path = tmp_path_factory.mktemp("locals") / "locals.jsonl"
    with path.open("w") as file:
        for _, result in pipeline.process_all(islice(Recording(source).frames(), 0, None, EVERY)):
            file.write(wire.encode(local_graph_to_message(result.local)) + "\n")
    return path


class Processes:
    """Python processes, ended by their own ids."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: list[subprocess.Popen[str]] = []

    def start(self, name: str, *words: str) -> subprocess.Popen[str]:
        """Start one, and wait until its first line."""
        python_path = os.pathsep.join(
            [str(ROOT), str(ROOT / "test"), os.environ.get("PYTHONPATH", "")]
        )
        log = (self._folder / f"{name}.log").open("w")
        process = subprocess.Popen(
            [sys.executable, *words],
            env={**os.environ, "PYTHONPATH": python_path},
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        self._running.append(process)
        return process

    def end(self) -> None:
        """End all of them."""
        for process in self._running:
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(15)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait(5)


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def nodes_of_objects(graph: SceneGraph, T_room_graph: np.ndarray) -> Counter[int]:
    """Number of nodes of each true object: of its class, with the centre in its box.

    Boxes of one class may lie side by side, as those of books do. So each object gets one node
    first, with the smallest sum of distances; then the other nodes go to the nearest object.
    """
    truth = json.loads(RECORDING.with_name("demo_room.gt.json").read_text(encoding="utf-8"))
    objects = truth["objects"]
    low, high = np.array([one["aabb"] for one in objects]).transpose(1, 0, 2)
    labels = [SPELLINGS.get(one["class"], one["class"]) for one in objects]
    places = np.array([item.position_m for item in graph]) @ T_room_graph[:3, :3].T
    places = (places + T_room_graph[:3, 3])[:, None]
    outside_m = np.linalg.norm(np.maximum(0, np.maximum(low - places, places - high)), axis=-1)
    same = np.array([[label == item.label for label in labels] for item in graph])
    costs = np.linalg.norm(places - (low + high) / 2, axis=-1)
    costs[~same | (outside_m > 0.1)] = NO_OBJECT
    found: Counter[int] = Counter()
    for node, column in zip(*linear_sum_assignment(costs), strict=True):
        if costs[node, column] < NO_OBJECT:
            found[objects[column]["id"]] += 1
            costs[node] = NO_OBJECT
    for row in costs[costs.min(axis=1) < NO_OBJECT]:
        found[objects[int(row.argmin())]["id"]] += 1
    return found


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_four_robots_become_one_graph(local_graphs: Path, tmp_path: Path) -> None:
    pytest.importorskip("zenoh", reason="needs the extra fleet: eclipse-zenoh")
    count = len(local_graphs.read_bytes().splitlines())
    length = 2 * count // 5
    rng = np.random.default_rng(0)
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    link = CutLink(port)
    plans = [
        Plan(
            name,
            f"tcp/127.0.0.1:{link.port}" if name == "carl" else endpoint,
            str(local_graphs),
            (index * count // 5, index * count // 5 + length),
            PERIOD_S,
            rigid_motion(
                rng.uniform(-30, 30, 3), rng.uniform(-3, 3) * np.array([0, 0, 1.0])
            ).tolist(),
            str(tmp_path / f"{name}.result.json"),
        )
        for index, name in enumerate(("ada", "bert", "carl", "dora"))
    ]
    processes = Processes(tmp_path)
    started: dict[str, subprocess.Popen[str]] = {}

    def start_robot(plan: Plan) -> None:
        path = tmp_path / f"{plan.name}.json"
        path.write_bytes(msgspec.json.encode(plan))
        started[plan.name] = processes.start(plan.name, "-m", "support.fleet_robot", str(path))

    def start_router() -> subprocess.Popen[str]:
        router = processes.start("router", "-c", ROUTER, endpoint)
        assert router.stdout is not None and router.stdout.readline() == "ready\n"
        return router

    fleet = NodeProcess("fleet_node", tmp_path, "--ros-args", "-p", f"connect:={endpoint}")
    try:
        router = start_router()
        fleet.wait_ready()
        start_robot(plans[0])
        time.sleep(3.0)
        start_robot(plans[1])
        start_robot(plans[2])
        time.sleep(8.0)
        link.is_cut.set()  # carl is cut off
        cut_s = time.monotonic()
        time.sleep(3.0)
        router.send_signal(signal.SIGKILL)
        router.wait(5)
        time.sleep(3.0)
        start_router()
        start_robot(plans[3])  # joins late
        time.sleep(max(0.0, CUT_S - (time.monotonic() - cut_s)))
        link.is_cut.clear()
        for process in started.values():
            assert process.stdout is not None
            assert process.stdout.readline() == "replayed\n"
        with SceneGraphClient("/fleet") as client, peer() as listener:
            robots = listener.collect("/fleet/robots", latched=True)
            expected = len(started)

            def is_settled() -> bool:
                listener.spin_for(0.2)
                known = json.loads(robots[-1]) if robots else []
                return sum(item["located"] for item in known) == expected

            end_s = time.monotonic() + 60
            while not is_settled():
                assert time.monotonic() < end_s, robots[-1:]
            time.sleep(5.0)  # questions and answers in both directions
            whole = client.graph
            status = {item["name"]: item for item in json.loads(robots[-1])}
        for process in started.values():
            process.terminate()
            process.wait(15)
    finally:
        fleet.end()
        processes.end()
        link.close()
    results = {
        plan.name: msgspec.json.decode(Path(plan.result_path).read_bytes(), type=Result)
        for plan in plans
    }
    # Nothing is lost: the fleet has each robot's last graph.
    assert {name: item["objects"] for name, item in status.items()} == {
        name: len(result.graph.nodes) for name, result in results.items()
    }
    first = next(plan for plan in plans if status[plan.name]["confidence"] == 1.0)
    T_room_fleet = invert_pose(np.array(first.T_world_room)) @ invert_pose(
        np.reshape(status[first.name]["T_fleet_world"], (4, 4))
    )
    objects = nodes_of_objects(whole, T_room_fleet)
    seen = set()
    for plan in plans:
        own = SceneGraph(results[plan.name].graph)
        seen |= nodes_of_objects(own, invert_pose(np.array(plan.T_world_room))).keys()
        mine = {node.label for node in results[plan.name].part.nodes}
        assert mine, f"{plan.name} was told nothing"
        error = (
            T_room_fleet
            @ np.reshape(status[plan.name]["T_fleet_world"], (4, 4))
            @ plan.T_world_room
        )
        places = np.array([item.position_m for item in whole]) @ T_room_fleet[:3, :3].T
        places += T_room_fleet[:3, 3]
        moved = places @ error[:3, :3].T + error[:3, 3]
        assert np.abs(moved - places).max() < 0.2, plan.name
    images = (RECORDING / "demo_room.mcap").stat().st_size / 171 * 4 * length
    figures = {
        "nodes": len(whole),
        "true objects": len(objects),
        "nodes an object": round(objects.total() / len(objects), 3),
        "bytes sent": sum(result.sent_bytes for result in results.values()),
        "bytes of whole graphs": sum(result.whole_bytes for result in results.values()),
        "bytes of images": int(images),
    }
    print(figures)
    assert len(objects) >= 0.95 * len(seen)
    assert objects.total() <= MOST_NODES_PER_OBJECT * len(objects)
    assert figures["bytes sent"] < 0.5 * figures["bytes of whole graphs"]
    assert figures["bytes sent"] < 0.1 * figures["bytes of images"]
