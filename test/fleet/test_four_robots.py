"""Four robots in four processes, each in a world of its own; the network fails in between."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections import Counter
from itertools import islice

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
def local_graphs(tmp_path_factory):
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


@pytest.fixture
def start(tmp_path):
    """Starts Python processes; `start.said` waits for a line."""
    running = []
    path = os.pathsep.join([str(ROOT), str(ROOT / "test"), os.environ.get("PYTHONPATH", "")])

    def start(*words, said=None):
        with (tmp_path / f"{len(running)}.log").open("w") as log:
            process = subprocess.Popen(
                [sys.executable, *words],
                env={**os.environ, "PYTHONPATH": path},
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        running.append(process)
        if said is not None:
            assert process.stdout.readline() == said
        return process

    yield start
    for process in running:
        process.kill()
        process.wait(15)


def moved(T, places):
    return places @ T[:3, :3].T + T[:3, 3]


def nodes_of_objects(graph: SceneGraph, T_room_graph: np.ndarray) -> Counter[int]:
    """Number of nodes of each true object: of its class, with the centre in its box.

    Boxes of one class may lie side by side, as those of books do. So each object gets one node
    first, with the smallest sum of distances; then the other nodes go to the nearest object.
    """
    truth = json.loads(RECORDING.with_name("demo_room.gt.json").read_text(encoding="utf-8"))
    objects = truth["objects"]
    low, high = np.array([one["aabb"] for one in objects]).transpose(1, 0, 2)
    labels = [SPELLINGS.get(one["class"], one["class"]) for one in objects]
    places = moved(T_room_graph, np.array([item.position_m for item in graph]))[:, None]
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
def test_four_robots_become_one_graph(local_graphs, tmp_path, endpoint, start):
    pytest.importorskip("zenoh", reason="needs the extra fleet: eclipse-zenoh")
    count = len(local_graphs.read_bytes().splitlines())
    length = 2 * count // 5
    rng = np.random.default_rng(0)
    link = CutLink(int(endpoint.rpartition(":")[2]))
    plans, worlds = {}, {}
    for index, name in enumerate(("ada", "bert", "carl", "dora")):
        worlds[name] = rigid_motion(
            rng.uniform(-30, 30, 3), rng.uniform(-3, 3) * np.array([0, 0, 1.0])
        )
        plans[name] = Plan(
            name,
            f"tcp/127.0.0.1:{link.port}" if name == "carl" else endpoint,
            str(local_graphs),
            (index * count // 5, index * count // 5 + length),
            PERIOD_S,
            worlds[name].tolist(),
            str(tmp_path / f"{name}.result.json"),
        )
    started = []

    def start_robot(name: str) -> None:
        path = tmp_path / f"{name}.json"
        path.write_bytes(msgspec.json.encode(plans[name]))
        started.append(start("-m", "support.fleet_robot", str(path)))

    with NodeProcess("fleet_node", tmp_path, parameters={"connect": endpoint}) as fleet:
        router = start("-c", ROUTER, endpoint, said="ready\n")
        fleet.wait_ready()
        start_robot("ada")
        time.sleep(3.0)
        start_robot("bert")
        start_robot("carl")
        time.sleep(8.0)
        link.is_cut.set()  # carl is cut off
        cut_s = time.monotonic()
        time.sleep(3.0)
        router.kill()
        router.wait(5)
        time.sleep(3.0)
        start("-c", ROUTER, endpoint, said="ready\n")
        start_robot("dora")  # joins late
        time.sleep(max(0.0, CUT_S - (time.monotonic() - cut_s)))
        link.is_cut.clear()
        for process in started:
            assert process.stdout.readline() == "replayed\n"
        with SceneGraphClient("/fleet") as client, peer() as listener:
            robots = listener.collect("/fleet/robots", latched=True)

            def is_settled() -> bool:
                known = json.loads(robots[-1]) if robots else []
                return sum(item["located"] for item in known) == len(plans)

            listener.spin_until(is_settled, 60.0, "the robots to be located")
            time.sleep(5.0)  # questions and answers in both directions
            whole = client.graph
            status = {item["name"]: item for item in json.loads(robots[-1])}
        for process in started:
            process.terminate()
            process.wait(15)
    link.close()
    results = {
        name: msgspec.json.decode((tmp_path / f"{name}.result.json").read_bytes(), type=Result)
        for name in plans
    }
    # Nothing is lost: the fleet has each robot's last graph.
    assert {name: item["objects"] for name, item in status.items()} == {
        name: len(result.graph.nodes) for name, result in results.items()
    }
    T_fleet_worlds = {
        name: np.reshape(item["T_fleet_world"], (4, 4)) for name, item in status.items()
    }
    first = next(name for name in plans if status[name]["confidence"] == 1.0)
    T_room_fleet = invert_pose(worlds[first]) @ invert_pose(T_fleet_worlds[first])
    places = moved(T_room_fleet, np.array([item.position_m for item in whole]))
    objects, seen = nodes_of_objects(whole, T_room_fleet), set()
    for name, result in results.items():
        seen |= nodes_of_objects(SceneGraph(result.graph), invert_pose(worlds[name])).keys()
        assert result.part.nodes, f"{name} was told nothing"
        error = T_room_fleet @ T_fleet_worlds[name] @ worlds[name]
        assert np.abs(moved(error, places) - places).max() < 0.2, name
    sent = sum(result.sent_bytes for result in results.values())
    of_whole_graphs = sum(result.whole_bytes for result in results.values())
    of_images = (RECORDING / "demo_room.mcap").stat().st_size / 171 * len(plans) * length
    print(
        f"{len(whole)} nodes of {len(objects)} objects; {sent} bytes were sent, of whole graphs it "
        f"were {of_whole_graphs}, of images {of_images:.0f}"
    )
    assert len(objects) >= 0.95 * len(seen)
    assert objects.total() <= MOST_NODES_PER_OBJECT * len(objects)
    assert sent < 0.5 * of_whole_graphs
    assert sent < 0.1 * of_images
