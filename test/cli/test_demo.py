"""`deworldsg demo`: four node processes over DDS give the same graph as one process."""

import json
import os
import re
import signal
import subprocess
import time
from contextlib import closing
from itertools import chain, groupby, islice
from pathlib import Path

import numpy as np
import pytest
from support.cli import DEMO_ROOM, deworldsg, start

from deworldsg_ros.cli import demo
from deworldsg_ros.graph.extent import surface_points
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.replaying import write_mcap
from deworldsg_ros.recordings.source import Role
from deworldsg_ros.wire import messages as wire

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
FRAMES = 15
NODES = ("segmentation_node", "lifting_node", "relation_node", "graph_node")


def write_short(path: Path, poses: bool = True) -> Path:
    """The first frames of the shipped recording, with or without poses."""
    with closing(open_source(DEMO_ROOM)) as source:
        frames = groupby(source.raw_messages(), key=lambda message: message.stamp_ns)
        messages = chain.from_iterable(frame for _, frame in islice(frames, FRAMES))
        write_mcap((m for m in messages if poses or m.role is not Role.POSE), path)
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write_short(tmp_path_factory.mktemp("recording") / "short.mcap")


def read_graph(folder):
    return wire.decode((folder / "scene_graph.json").read_bytes(), wire.SceneGraphMessage)


@pytest.mark.parametrize("with_poses", [True, False])
def test_demo_and_run_end_with_the_same_graph(tmp_path, with_poses):
    arguments = [write_short(tmp_path / "short.mcap", with_poses)]
    arguments += [] if with_poses else ["--odometry"]
    ran = deworldsg(tmp_path, "run", *arguments, "--out", "ran", limit_s=400)
    assert ran.returncode == 0, ran.stderr
    shown = deworldsg(tmp_path, "demo", *arguments, "--out", "shown", "--rate", 0, limit_s=400)
    assert shown.returncode == 0, shown.stderr + shown.stdout
    ours, theirs = read_graph(tmp_path / "ran"), read_graph(tmp_path / "shown")
    assert ours.nodes
    assert [(n.id, n.label, n.observations) for n in ours.nodes] == [
        (n.id, n.label, n.observations) for n in theirs.nodes
    ]
    for a, b in zip(ours.nodes, theirs.nodes):  # one step of the last decimal
        np.testing.assert_allclose(a.mean_m, b.mean_m, rtol=0, atol=1.1e-4)
        np.testing.assert_allclose(a.covariance_m2, b.covariance_m2, rtol=0, atol=1.1e-7)
        np.testing.assert_allclose(surface_points(a), surface_points(b), rtol=0, atol=1.2e-3)
    assert [(e.subject, e.object, e.predicate, e.provenance) for e in ours.edges] == [
        (e.subject, e.object, e.predicate, e.provenance) for e in theirs.edges
    ]
    for a, b in zip(ours.edges, theirs.edges):
        assert a.probability == pytest.approx(b.probability, abs=1e-9)
    assert (ours.stamp, ours.frame_id) == (theirs.stamp, theirs.frame_id)

    report = json.loads((tmp_path / "shown" / "run.json").read_text())
    assert report["frames"]["published"] == report["frames"]["processed"] == FRAMES
    assert report["frames"]["without_result"] == 0
    assert set(NODES) <= set(report["diagnostics"])
    for name in ("scene_graph.png", "scene_graph.html", "config.yaml"):
        assert (tmp_path / "shown" / name).stat().st_size > 0
    for node in NODES:
        assert "ready" in (tmp_path / "shown" / "logs" / f"{node}.log").read_text()
    assert "live view: http://127.0.0.1:" in shown.stdout
    assert "ended with code" not in shown.stdout, "each node ends by itself"


def test_a_node_that_dies_is_named_with_the_end_of_its_log(recording, tmp_path):
    words = ("demo", recording, "--out", "out", "--set", "perception.detector=crystal_ball")
    failed = deworldsg(tmp_path, *words, limit_s=400)
    assert failed.returncode == 2
    assert "segmentation_node ended early" in failed.stderr
    assert "crystal_ball" in failed.stderr
    assert "Traceback" not in failed.stderr


def children(pid):
    listed = subprocess.run(
        ["ps", "--ppid", str(pid), "-o", "pid=,stat="], capture_output=True, text=True, check=True
    )
    rows = [line.split() for line in listed.stdout.splitlines()]
    return [int(pid) for pid, state in rows if not state.startswith("Z")]


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


def test_ctrl_c_during_the_replay_leaves_the_graph_so_far(tmp_path):
    process = start(tmp_path, "demo", DEMO_ROOM, "--out", "out")
    for line in process.stdout:
        if "live view: http" in line:
            break
    time.sleep(2.0)
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 130, out + errors
    assert "Traceback" not in errors
    published = int(re.search(r"those of (\d+) of 171 frames", out)[1])
    assert 0 < published < 171
    assert read_graph(tmp_path / "out").nodes and (tmp_path / "out" / "scene_graph.html").exists()


def test_a_process_that_starts_during_an_interrupt_is_listed(monkeypatch):
    monkeypatch.setattr(demo, "LoggedProcess", lambda *_: signal.raise_signal(signal.SIGTERM))
    processes = []
    with pytest.raises(KeyboardInterrupt), demo.one_interrupt():
        demo._start_process(processes, "a node")
    assert len(processes) == 1
