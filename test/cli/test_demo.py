"""`deworldsg demo`: four node processes over DDS give the same graph as one process."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import time
from functools import partial

import numpy as np
import pytest
from rich.console import Console
from support.cli import DEMO_ROOM, deworldsg, first_frames, start

from deworldsg_ros.cli import demo
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.source import Role
from deworldsg_ros.wire import messages as wire

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
FRAMES = 15
NODES = ("segmentation_node", "lifting_node", "relation_node", "graph_node")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "short.mcap"
    return first_frames(open_source(DEMO_ROOM), FRAMES, path)


def read_graph(folder):
    return wire.decode((folder / "scene_graph.json").read_bytes(), wire.SceneGraphMessage)


@pytest.fixture(scope="module")
def unposed(tmp_path_factory):
    """The same recording without poses."""
    source = open_source(DEMO_ROOM)
    source.raw_messages = partial(without_poses, source.raw_messages)
    return first_frames(source, FRAMES, tmp_path_factory.mktemp("unposed") / "short.mcap")


def without_poses(messages):
    return (message for message in messages() if message.role is not Role.POSE)


@pytest.mark.parametrize("poses", ["recorded", "--odometry"])
def test_demo_and_run_end_with_the_same_graph(recording, unposed, tmp_path, poses):
    arguments = [unposed, poses] if poses == "--odometry" else [recording]
    ran = deworldsg(tmp_path, "run", *arguments, "--out", "ran", limit_s=400)
    assert ran.returncode == 0, ran.stderr
    shown = deworldsg(tmp_path, "demo", *arguments, "--out", "shown", "--rate", 0, limit_s=400)
    assert shown.returncode == 0, shown.stderr + shown.stdout
    ours, theirs = read_graph(tmp_path / "ran"), read_graph(tmp_path / "shown")
    assert ours.nodes
    assert [(n.id, n.label, n.observations) for n in ours.nodes] == [
        (n.id, n.label, n.observations) for n in theirs.nodes
    ]
    # One step of the last decimal.
    for name, limit in (("mean_m", 1.1e-4), ("covariance_m2", 1.1e-7)):
        for a, b in zip(ours.nodes, theirs.nodes):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=limit)
    for a, b in zip(ours.nodes, theirs.nodes):
        np.testing.assert_allclose(surface_points(a), surface_points(b), rtol=0, atol=1.2e-3)
    assert [(e.subject, e.object, e.predicate, e.provenance) for e in ours.edges] == [
        (e.subject, e.object, e.predicate, e.provenance) for e in theirs.edges
    ]
    for a, b in zip(ours.edges, theirs.edges):
        assert a.probability == pytest.approx(b.probability, abs=1e-9)
    assert (ours.stamp, ours.frame_id) == (theirs.stamp, theirs.frame_id)

    report = json.loads((tmp_path / "shown" / "run.json").read_text(encoding="utf-8"))
    assert report["frames"]["published"] == report["frames"]["processed"] == FRAMES
    assert report["frames"]["without_result"] == 0
    assert set(NODES) <= set(report["diagnostics"])
    for name in ("scene_graph.png", "scene_graph.html", "config.yaml"):
        assert (tmp_path / "shown" / name).stat().st_size > 0
    for node in NODES:
        assert "ready" in (tmp_path / "shown" / "logs" / f"{node}.log").read_text()
    assert "live view: http://127.0.0.1:" in shown.stdout
    # Every node ended by itself.
    assert "ended with code" not in shown.stdout


def test_a_node_that_dies_is_named_with_the_end_of_its_log(recording, tmp_path):
    failed = deworldsg(
        tmp_path,
        *("demo", recording, "--out", "out", "--set", "perception.detector=crystal_ball"),
        limit_s=400,
    )
    assert failed.returncode == 2
    assert "segmentation_node ended early" in failed.stderr
    assert "crystal_ball" in failed.stderr
    assert "Traceback" not in failed.stderr


def children(pid):
    listed = subprocess.run(
        ["ps", "-eo", "pid=,ppid=,stat="], capture_output=True, text=True, check=True
    )
    rows = [line.split() for line in listed.stdout.splitlines()]
    return [int(row[0]) for row in rows if int(row[1]) == pid and not row[2].startswith("Z")]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_leaves_no_node_behind(recording, tmp_path, number):
    process = start(tmp_path, "demo", recording, "--out", "out")
    end_s = time.monotonic() + 300
    log = tmp_path / "out" / "logs" / "graph_node.log"
    while not (log.exists() and "ready" in log.read_text()):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end_s
        time.sleep(0.1)
    nodes = children(process.pid)
    assert len(nodes) in (5, 6), "viewer_node starts when the others are ready"
    process.send_signal(number)
    process.send_signal(number)  # a user who presses Ctrl-C twice
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in errors
    for pid in nodes:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_the_demo_goes_on_without_the_viewer(tmp_path, monkeypatch):
    console = Console(file=io.StringIO(), width=200)
    monkeypatch.setattr(demo, "find_spec", lambda name: None)
    processes = []
    view = demo.DemoView(processes, tmp_path / "config.yaml", tmp_path, console)
    view.start()
    view.stay_open()
    assert processes == []
    assert "pip install 'deworldsg_ros[view]'" in console.file.getvalue()
